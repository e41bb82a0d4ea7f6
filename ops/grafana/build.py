"""Writes the Grafana dashboards: `python ops/grafana/build.py [FOLDER]`; without a folder, those beside this file."""

import json
import sys
from pathlib import Path
from typing import Any

from panels import HEIGHT, RUNS, SOURCE, WIDTH, Panel, gauge, lines, quantile, recorded, stat, total

OVERVIEW = [
    stat("Phase (0 collect, 1 pretrain, 2 train, 3 evaluate)", "none", recorded("run:slotfilm_phase:max")),
    stat("Environment steps", "short", gauge("env_steps")),
    stat("Updates", "short", gauge("updates")),
    stat("Time", "s", gauge("time_s")),
    stat("Workers", "none", gauge("worker_alive_count")),
    Panel(
        title="Alerts",
        unit="none",
        queries={"{{alertname}} {{run}}": 'sum by (alertname, run) (ALERTS{alertstate="firing"})'},
        kind="stat",
        width=4,
        help="Empty when nothing is wrong.",
    ),
    lines("Return", "none", {"{{run}} training": gauge("episode_return"), "{{run}} evaluation": gauge("eval_return")}),
    lines(
        "Success",
        "percentunit",
        {"{{run}} training": gauge("episode_success"), "{{run}} evaluation": gauge("eval_success_rate")},
    ),
    lines("Return by reward component", "none", {"{{run}} {{term}}": gauge("episode_reward_term", "by (run, term)")}),
    lines("Environment steps a second", "short", {"{{run}}": recorded("run:slotfilm_env_steps:rate1m")}),
    lines("Updates a second", "short", {"{{run}}": recorded("run:slotfilm_updates:rate1m")}),
    lines(
        "Updates per environment step",
        "none",
        {"{{run}}": gauge("limiter_ratio"), "{{run}} asked for": gauge("limiter_target_ratio")},
    ),
    lines(
        "Who waits",
        "percentunit",
        {
            "{{run}} learner": recorded("run:slotfilm_learner_wait_share:avg5m"),
            "{{run}} workers": recorded("run:slotfilm_worker_wait_share:avg5m"),
        },
        "Both near 0: the machines are the limit. Only one of the two is ever high.",
    ),
    lines(
        "Checkpoints",
        "s",
        {"{{run}} age": gauge("checkpoint_age_s"), "{{run}} write": quantile(0.5, "checkpoint_write_s")},
    ),
    lines("Checkpoint size", "bytes", {"{{run}}": gauge("checkpoint_bytes")}),
]

LEARNER = [
    lines(
        "Losses of critics and value",
        "none",
        {"{{run}} critic": gauge("learner_critic_loss"), "{{run}} value": gauge("learner_value_loss")},
    ),
    lines("Loss of the actor", "none", {"{{run}}": gauge("learner_actor_loss")}),
    lines(
        "Q and its target",
        "none",
        {"{{run}} Q": gauge("learner_q_mean"), "{{run}} target": gauge("learner_target_mean")},
        "In units of the scaled return. Growth without bound is divergence.",
    ),
    lines(
        "Gradient norms",
        "none",
        {f"{{{{run}}}} {part}": gauge(f"learner_{part}_gradient_norm") for part in ("critic", "actor", "encoder")},
    ),
    lines("Entropy", "none", {"{{run}}": gauge("learner_entropy_nats")}, "In nats."),
    lines("Temperature", "none", {"{{run}}": gauge("learner_temperature")}),
    lines(
        "Time of one update",
        "s",
        {"{{run}} median": quantile(0.5, "learner_update_s"), "{{run}} 95 %": quantile(0.95, "learner_update_s")},
    ),
    lines(
        "Time waited for a batch",
        "s",
        {
            "{{run}} median": quantile(0.5, "learner_batch_wait_s"),
            "{{run}} 95 %": quantile(0.95, "learner_batch_wait_s"),
        },
    ),
    lines("Age of the workers' weights", "s", {"{{run}}": gauge("weights_age_s")}),
    lines("Age of the workers' weights in updates", "short", {"{{run}}": gauge("weights_age_updates")}),
    lines("Updates skipped, not finite", "short", {"{{run}}": total("learner_nonfinite_total")}),
    lines(
        "GPU",
        "percent",
        {"{{node}} {{GpuIndex}}": "max by (node, GpuIndex) (node:ray_gpu_utilization_percent:avg15m)"},
        "Only where there is one.",
    ),
    lines(
        "Pre-training losses",
        "none",
        {f"{{{{run}}}} {part}": gauge(f"pretrain_{part}_loss") for part in ("position", "visibility", "attention")},
    ),
    lines(
        "Pre-training: error on held-out frames",
        "none",
        {
            "{{run}}": gauge("pretrain_position_error_px"),
            "{{run}} constant prediction": gauge("pretrain_baseline_error_px"),
        },
        "In pixels.",
    ),
    lines("Pre-training: attention on the objects", "percentunit", {"{{run}}": gauge("pretrain_attention_share")}),
]

WORKERS = [
    lines("Workers", "none", {"{{run}}": gauge("worker_alive_count"), "{{run}} wanted": gauge("worker_wanted_count")}),
    lines(
        "Share of the slowest worker", "percentunit", {"{{run}}": gauge("worker_least_share")}, "1 if all are alike."
    ),
    lines(
        "Workers replaced",
        "short",
        {"{{run}} {{reason}}": total("worker_restarts_total", "by (run, reason)")},
        "Since this start of the run.",
    ),
    lines(
        "Time of one environment step",
        "s",
        {"{{run}} median": quantile(0.5, "worker_sim_s"), "{{run}} 95 %": quantile(0.95, "worker_sim_s")},
    ),
    lines("Workers held back by the limiter", "none", {"{{run}}": gauge("limiter_waiting_workers_count")}),
    lines(
        "Blocks a second", "short", {"{{run}}": f"sum by (run) (rate(ray_slotfilm_worker_blocks_total{{{RUNS}}}[1m]))"}
    ),
    lines("Replay is full to", "percentunit", {"{{run}}": recorded("run:slotfilm_replay_fill:share")}),
    lines(
        "Memory of the stored steps",
        "bytes",
        {
            "{{run}}": gauge("replay_stored_bytes"),
            "{{run}} still to come": recorded("run:slotfilm_replay_growth_bytes:prediction"),
        },
    ),
    lines("Age of the sampled steps", "short", {"{{run}}": gauge("replay_sample_age_steps")}, "In environment steps."),
    lines(
        "Blocks lost or doubled",
        "short",
        {
            "{{run}} missing": gauge("replay_missing_blocks_total"),
            "{{run}} doubled": gauge("replay_duplicate_blocks_total"),
        },
    ),
    lines("Shards", "none", {"{{run}}": gauge("replay_shards_alive_count")}),
    lines("Shards replaced", "short", {"{{run}} {{reason}}": total("replay_restarts_total", "by (run, reason)")}),
    lines("Memory of the nodes", "percentunit", {"{{node}}": "max by (node) (node:ray_memory_used:share)"}),
    lines("Processors of the nodes", "percent", {"{{ip}}": "max by (ip) (ray_node_cpu_utilization)"}),
    lines(
        "Object store",
        "bytes",
        {"{{NodeAddress}} {{Location}}": "sum by (NodeAddress, Location) (ray_object_store_memory)"},
    ),
]

BY_VARIANT = "by (variant)"


def mean_over_seeds(title: str, unit: str, metric: str) -> Panel:
    """A curve a variant."""
    return lines(title, unit, {"{{variant}}": f"avg {BY_VARIANT} ({gauge(metric, 'by (variant, seed, run)')})"})


GRID = [
    stat("Runs", "none", f"count (run:slotfilm_phase:max{{{RUNS}}})"),
    Panel(
        title="Every run",
        unit="short",
        kind="table",
        width=20,
        queries={
            name: gauge(metric, "by (variant, seed, run)")
            for name, metric in {
                "steps": "env_steps",
                "updates": "updates",
                "return": "episode_return",
                "success": "episode_success",
                "evaluated return": "eval_return",
            }.items()
        },
        merged=True,
    ),
    mean_over_seeds("Return in training", "none", "episode_return"),
    mean_over_seeds("Success in training", "percentunit", "episode_success"),
    mean_over_seeds("Return in evaluation", "none", "eval_return"),
    mean_over_seeds("Success in evaluation", "percentunit", "eval_success_rate"),
    mean_over_seeds("Critic loss", "none", "learner_critic_loss"),
    mean_over_seeds("Entropy", "none", "learner_entropy_nats"),
    mean_over_seeds("Environment steps", "short", "env_steps"),
    lines("Updates a second", "short", {"{{variant}}": f"avg {BY_VARIANT} (run:slotfilm_updates:rate1m{{{RUNS}}})"}),
    lines("Seeds that report", "none", {"{{variant}}": f"count {BY_VARIANT} (run:slotfilm_phase:max{{{RUNS}}})"}),
]

DASHBOARDS = {
    "overview": ("Slotfilm: runs", OVERVIEW),
    "learner": ("Slotfilm: learner", LEARNER),
    "workers": ("Slotfilm: workers and replay", WORKERS),
    "grid": ("Slotfilm: grid, variants side by side", GRID),
}


def variables() -> list[dict[str, Any]]:
    """What a reader chooses at the top: where the data comes from, and which runs are shown."""
    source = {"name": "datasource", "label": "Source", "type": "datasource", "query": "prometheus", "current": {}}
    run = {
        "name": "run",
        "label": "Run",
        "type": "query",
        "datasource": SOURCE,
        "query": {"query": "label_values(run:slotfilm_phase:max, run)", "refId": "run"},
        "refresh": 2,
        "multi": True,
        "includeAll": True,
        "allValue": ".*",
        "current": {"text": "All", "value": "$__all"},
    }
    return [source, run]


def placed(panels: list[Panel]) -> list[dict[str, Any]]:
    """The panels from left to right and top to bottom."""
    x = y = 0
    out = []
    for number, panel in enumerate(panels, start=1):
        if x + panel.width > WIDTH:
            x, y = 0, y + HEIGHT
        out.append(panel.to_json(number, x, y))
        x += panel.width
    return out


def dashboard(name: str) -> dict[str, Any]:
    """One dashboard as Grafana reads it."""
    title, panels = DASHBOARDS[name]
    return {
        "uid": f"slotfilm-{name}",
        "title": title,
        "tags": ["slotfilm"],
        "schemaVersion": 39,
        "editable": False,
        "refresh": "10s",
        "time": {"from": "now-1h", "to": "now"},
        "links": [
            {"type": "dashboards", "tags": ["slotfilm"], "title": "Slotfilm", "keepTime": True, "includeVars": True}
        ],
        "templating": {"list": variables()},
        "panels": placed(panels),
    }


def text_of(name: str) -> str:
    """The file's text."""
    return json.dumps(dashboard(name), indent=1) + "\n"


if __name__ == "__main__":
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent / "dashboards"
    for name in DASHBOARDS:
        (folder / f"{name}.json").write_text(text_of(name), encoding="utf-8")
