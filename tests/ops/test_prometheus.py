"""A real Prometheus with the project's configuration sees every metric of a run, and its rules do what they say."""

import math
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from slotfilm_dist.metrics import METRICS, RESTART_REASONS, Metric

OPS = Path(__file__).parents[2] / "ops"
RULES = OPS / "prometheus" / "rules"

NOT_IN_THIS_RUN = {
    "run_gpu_memory_bytes": "the learner computes on a CPU",
    "learner_goal_gate": "the variant has no goal slot",
    "learner_temperature_loss": "the temperature is fixed",
    "learner_policy_std": "of DrQ-v2's noise schedule",
    "pretrain_visibility_auroc": "every object is always in view of the toy environment",
    "inference_steps_total": "workers act by themselves on a CPU",
    "inference_batch_steps": "workers act by themselves on a CPU",
    "inference_busy_s_total": "workers act by themselves on a CPU",
}
"""Metrics that a healthy run of the proposed agent on a CPU does not have, each with the reason."""

SILENT_RULES = {
    "node:ray_gpu_utilization_percent:avg15m": "Ray reports a GPU's load where there is one",
}
"""Recorded series that a healthy run on a CPU does not have, each with the reason."""

MOST_STEPS = 4032
"""The watched run's steps and two blocks: the worker ends the one it is at, and may have begun another."""
MOST_UPDATES = 2000
LATE_S = 5.0
"""How long after a run has written a value Prometheus surely has it, at one report and one question a second."""

EXACT = {
    "limiter_target_ratio": 0.5,
    "replay_capacity_steps": 1000.0,
    "learner_nonfinite_total": 0.0,
    "worker_nonfinite_total": 0.0,
    "worker_restarts_total": 0.0,
    "replay_restarts_total": 0.0,
    "learner_restarts_total": 0.0,
    "inference_restarts_total": 0.0,
    "checkpoint_failed_total": 0.0,
    "sink_failures_total": 0.0,
    "replay_missing_blocks_total": 0.0,
    "episode_length_steps": 20.0,
}
"""Values that follow from the run's config."""
RANGES = {
    "env_steps": (16, MOST_STEPS),
    "updates": (0, MOST_UPDATES),
    "learner_updates_total": (0, MOST_UPDATES),
    "limiter_ratio": (0.0, 0.55),
    "phase": (0, 3),
    "worker_alive_count": (0, 1),
    "replay_shards_alive_count": (0, 1),
    "replay_stored_steps": (0, 1000),
    "learner_entropy_nats": (-20, 10),
    "episode_return": (0, 20),
    "eval_return": (0, 20),
    "pretrain_steps_total": (1, 10),
    "pretrain_position_error_px": (0, 128),
    "run_memory_bytes": (1e8, 1e11),
}
"""Where values must lie beyond what their unit says."""


def rules(kind: str) -> dict[str, dict[str, Any]]:
    """Rules of a kind, `record` or `alert`, by name."""
    groups = [group for path in sorted(RULES.glob("*.yml")) for group in yaml.safe_load(path.read_text())["groups"]]
    return {rule[kind]: rule for group in groups for rule in group["rules"] if kind in rule}


def limits(metric: Metric) -> tuple[float, float]:
    """Where a metric's values can lie at all."""
    if metric.name in EXACT:
        return EXACT[metric.name], EXACT[metric.name]
    if metric.name in RANGES:
        return RANGES[metric.name]
    if metric.unit == "share":
        return 0.0, 1.0
    counted = metric.kind == "counter" or metric.unit in {
        "s",
        "bytes",
        "steps",
        "updates",
        "workers",
        "updates/s",
        "px",
    }
    return (0.0 if counted else -1e4), math.inf


def exported(metric: Metric) -> str:
    """A metric's values in Prometheus, added up over the workers' processes."""
    return f"sum by (run, reason, term) ({metric.exported_name}{'_count' if metric.kind == 'histogram' else ''})"


@pytest.fixture
def promtool(program: Callable[[str], str]) -> Callable[..., subprocess.CompletedProcess[str]]:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        words = [program("promtool"), *arguments]
        return subprocess.run(words, cwd=OPS, capture_output=True, text=True, timeout=60)

    return run


def test_configuration_and_rules_are_valid(promtool: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    answer = promtool("check", "config", "prometheus.yml")
    assert answer.returncode == 0, answer.stdout + answer.stderr


def test_every_alert_fires_and_stays_quiet_when_it_should(
    promtool: Callable[..., subprocess.CompletedProcess[str]],
) -> None:
    answer = promtool("test", "rules", "prometheus/tests/alerts.yml")
    assert answer.returncode == 0, answer.stdout + answer.stderr


def test_every_alert_has_a_case_that_fires_and_one_that_does_not() -> None:
    cases: dict[str, set[bool]] = {name: set() for name in rules("alert")}
    for group in yaml.safe_load((OPS / "prometheus" / "tests" / "alerts.yml").read_text())["tests"]:
        for case in group["alert_rule_test"]:
            cases[case["alertname"]].add(bool(case.get("exp_alerts")))
    assert {name: found for name, found in cases.items() if found != {True, False}} == {}


def test_every_metric_of_the_catalogue_arrives_with_plausible_values(watched: Any) -> None:
    missing, implausible = [], []
    for metric in METRICS.values():
        series = watched.values(exported(metric))
        if not series:
            missing.append(metric.name)
        low, high = (0.0, math.inf) if metric.kind == "histogram" else limits(metric)
        for labels, values in series.items():
            if not all(low <= value <= high for value in values):
                implausible.append(
                    f"{metric.name} {labels}: {min(values):g} to {max(values):g}, not {low:g} to {high:g}"
                )
    assert set(missing) <= NOT_IN_THIS_RUN.keys()
    assert not implausible


def test_run_is_told_by_its_labels(watched: Any) -> None:
    (labels,) = watched.values("run:slotfilm_phase:max")
    assert dict(labels) == {"__name__": "run:slotfilm_phase:max", "run": "watched", "variant": "slotfilm", "seed": "0"}


def test_counts_of_prometheus_are_those_of_the_run(watched: Any) -> None:
    """A report or two behind, since Ray sends the values once a second, and Prometheus asks for them once a second."""
    recorded = watched.training("env_steps")
    in_time = max(steps for at, steps in recorded if at < recorded[-1][0] - LATE_S)
    assert in_time > watched.config.schedule.random_steps
    for name in ("env_steps", "worker_env_steps_total"):
        (values,) = watched.values(f"sum by (run) (ray_slotfilm_{name})").values()
        assert max(values) >= in_time
        assert values == sorted(values)


def test_restarts_are_counted_from_zero_by_every_reason(watched: Any) -> None:
    series = watched.values("sum by (reason) (ray_slotfilm_worker_restarts_total)")
    assert {dict(labels)["reason"] for labels in series} == set(RESTART_REASONS)
    assert {value for values in series.values() for value in values} == {0.0}


def test_every_recorded_rule_gives_data(watched: Any) -> None:
    assert set(watched.without_data(rules("record"))) <= SILENT_RULES.keys()


def test_every_alert_is_evaluated_and_none_fires_in_a_healthy_run(watched: Any) -> None:
    groups = watched.prometheus.get("rules")["groups"]
    states = {rule["name"]: rule for group in groups for rule in group["rules"]}
    assert states.keys() == rules("alert").keys() | rules("record").keys()
    assert {name: rule.get("lastError") for name, rule in states.items() if rule["health"] != "ok"} == {}
    assert watched.values('ALERTS{alertstate="firing"}') == {}


def test_every_metric_in_an_alert_is_there_or_its_absence_is_explained(watched: Any) -> None:
    """The comparison of an alert gives nothing while all is well; what it compares must be there."""
    known = {metric.exported_name for metric in METRICS.values()} | rules("record").keys()
    silent = {METRICS[name].exported_name for name in NOT_IN_THIS_RUN} | SILENT_RULES.keys()
    for name, rule in rules("alert").items():
        read = {word for word in known if word in rule["expr"]} - silent
        assert watched.without_data(sorted(read)) == [], name


def test_endpoints_of_ray_are_scraped(watched: Any) -> None:
    (values,) = watched.values('sum(up{job="ray"})').values()
    assert max(values) >= 1
    assert watched.values('ray_node_mem_total{job="ray"}')
