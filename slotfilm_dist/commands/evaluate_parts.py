"""The parts of `slotfilm evaluate RUN --what PART` beside plain episodes. Each writes one folder of the run.

perception      perception/<frames>-<checkpoint>/  quality.json quality.csv frames.csv attention.png positions.png
                                                   corruptions.png
                perception/pretraining.csv         losses and held-out errors over gradient steps (Figure 3)
robustness      robustness/                        policy.json policy.csv
film_strips     film_strips/                       <player>-<seed>.png <player>-<seed>.csv
reward_windows  reward_windows/                    table.csv components.csv components.png summary.json
"""

import argparse
import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from slotfilm_dist.commands.heldout_frames import FrameRequest, acting_policy, heldout_frames
from slotfilm_dist.commands.options import episode_seeds, placed_on
from slotfilm_dist.commands.trained_agent import TrainedAgent, load_trained_agent
from slotfilm_dist.envs.tasks import task_named
from slotfilm_dist.evaluation.result_files import write_csv, write_json
from slotfilm_dist.local import learner_device
from slotfilm_dist.machine import usable_cores
from slotfilm_dist.progress import Progress

SHOWN_FRAMES = 8
"""Frames in the pictures of attention and positions."""
PERCEPTION_EPISODES, PERCEPTION_STEPS = 20, 50
"""Held-out frames that perception is measured on: many scenes, as random-policy data shows them."""


def measure(part: str, options: argparse.Namespace) -> dict[str, Any]:
    """Measure a part and write its files; gives what `--json` prints."""
    return _PARTS[part](options, Progress())


def load(options: argparse.Namespace) -> TrainedAgent:
    """The run's networks, with torch on half of the cores: threads that wait for each other on a busy machine spin."""
    from slotfilm_dist.config_files import load_config

    config = load_config(Path(options.run) / "config.json")
    torch.set_num_threads(config.runtime.learner_threads or max(1, int(usable_cores()) // 2))
    device = learner_device(placed_on(config, options.device), "--device")
    return load_trained_agent(Path(options.run), options.checkpoint, device, Path(options.artifacts))


def describe(agent: TrainedAgent) -> dict[str, Any]:
    """Which networks were measured, for the head of a result."""
    return {
        "run": agent.run_dir.name,
        "variant": agent.config.variant,
        "seed": agent.config.seed,
        "checkpoint": agent.which,
        "env_steps": agent.env_steps,
        "updates": agent.updates,
        "weights": agent.weights,
        "has_trained_heads": agent.has_trained_heads,
    }


def _perception(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from slotfilm_dist.evaluation import perception_figures as figures
    from slotfilm_dist.evaluation.perception import frame_rows, measure_perception, summary

    agent = load(options)
    encoder = agent.slots("measuring perception")
    request = FrameRequest(
        source=options.frames or "random",
        first_seed=options.seed,
        episodes=options.episodes or PERCEPTION_EPISODES,
        steps=PERCEPTION_STEPS if options.steps is None else options.steps,
    )
    frames = heldout_frames(request, agent, Path(options.artifacts), progress)
    progress.begin("evaluate", f"perception in {len(frames.rgb)} frames, clean and corrupted")
    result = measure_perception(
        encoder, frames, seed=options.seed, shown=lambda name: progress.say(f"          {name}")
    )
    folder = Path(options.run) / "perception" / f"{request.label}-{agent.which}"
    objects = task_named(agent.config.env.task).objects
    values = describe(agent) | {
        "frames": dataclasses.asdict(request) | {"num_frames": len(frames.rgb)},
        "objects": list(objects),
        **summary(result),
    }
    write_json(folder / "quality.json", values)
    write_csv(folder / "quality.csv", _quality_rows(values))
    matched = agent.config.encoder.vis_head == "matched"
    write_csv(folder / "frames.csv", frame_rows(frames, result, objects, matched_visibility=matched))
    chosen = figures.spread_frames(frames, SHOWN_FRAMES, options.seed)
    figures.draw_attention(frames, result, chosen, folder / "attention.png", len(objects))
    figures.draw_positions(frames, result, chosen, objects, folder / "positions.png", len(objects))
    figures.draw_corruptions(result, folder / "corruptions.png")
    _write_curves(Path(options.run))
    clean = result.quality["clean"]
    progress.end(
        f"position error {clean.position_error_px:.1f} px (predicting the mean {clean.baseline_error_px:.1f}), "
        f"attention NLL {clean.attention_nll:.2f}, visibility AUROC {clean.visibility_auroc:.3f}, "
        f"slots swap in {result.swaps_by_position['clean'].rate:.1%} of the steps: {folder}"
    )
    return values


def _write_curves(run_dir: Path) -> None:
    """What the run logged during pre-training; nothing where it took an encoder that another run had made."""
    from slotfilm_dist.evaluation.record import read_run

    lines = read_run(run_dir).lines
    keys = dict.fromkeys(key for line in lines for key in line if key.startswith("pretrain_"))
    rows = [{key: line.get(key) for key in keys} for line in lines if keys.keys() & line.keys()]
    if rows:
        write_csv(run_dir / "perception" / "pretraining.csv", rows)


def _quality_rows(values: dict[str, Any]) -> list[dict[str, Any]]:
    """One row for each corruption."""
    rows = []
    for name, quality in values["quality"].items():
        row = {"corruption": name} | dict(quality)
        for key, (low, high) in values["intervals_95"][name].items():
            row |= {f"{key}_low": low, f"{key}_high": high}
        row |= {f"swap_rate_{kind}": values["swaps"][kind][name]["rate"] for kind in values["swaps"]}
        rows.append(row)
    return rows


def _robustness(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from slotfilm_dist.envs.wrist_env import WristEnv
    from slotfilm_dist.evaluation.corruptions import CORRUPTIONS
    from slotfilm_dist.evaluation.record import Evaluation, summarize
    from slotfilm_dist.evaluation.robustness import play_corrupted, robustness_rows

    agent = load(options)
    if not agent.config.encoder.uses_image:
        raise ValueError(f"{options.run}: variant {agent.config.variant!r} has no camera, so nothing can corrupt it")
    seeds = episode_seeds(options.seed, options.episodes or 50)
    policy = acting_policy(agent)
    evaluations: dict[str, Evaluation] = {}
    env = WristEnv(agent.config, camera=True)
    try:
        for name in CORRUPTIONS:
            progress.begin("evaluate", f"{len(seeds)} episodes, pictures: {name}")
            episodes = []
            for episode in play_corrupted(env, policy, seeds, name, options.hold):
                episodes.append(episode)
                solved = sum(e.success_at_end for e in episodes) / len(episodes)
                progress.show(len(episodes), len(seeds), {"success": f"{solved:.0%}"})
            evaluations[name] = summarize(name, name, agent.env_steps, tuple(episodes), env.reward_term_names)
            progress.end(f"{name}: success {evaluations[name].success_rate:.0%}")
    finally:
        progress.end()
        env.close()
    rows = robustness_rows(evaluations, np.random.default_rng(options.seed))
    values = describe(agent) | {"hold": options.hold, "first_seed": options.seed, "rows": rows}
    folder = Path(options.run) / "robustness"
    stem = "policy" if options.hold == "frame" else "policy-episode"
    write_csv(folder / f"{stem}.csv", rows)
    played = {name: [dataclasses.asdict(e) for e in evaluation.episodes] for name, evaluation in evaluations.items()}
    write_json(folder / f"{stem}.json", values | {"episodes": played})
    progress.say(f"  wrote  {folder / stem}.json and .csv")
    return values


def _film_strips(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from slotfilm_dist.envs.expert import ExpertPolicy
    from slotfilm_dist.envs.wrist_env import WristEnv
    from slotfilm_dist.evaluation.film_strip import MomentRecorder, key_steps, moment_rows, write_moments
    from slotfilm_dist.evaluation.rollouts import play_episodes
    from slotfilm_dist.policy import RandomPolicy
    from slotfilm_dist.seeds import Role, role_seed

    agent = load(options)
    player = options.policy or "agent"
    folder = Path(options.run) / "film_strips"
    strips = []
    env = WristEnv(agent.config, camera=True)
    try:
        policies = {
            "agent": lambda: acting_policy(agent),
            "expert": lambda: ExpertPolicy(env),
            "random": lambda: RandomPolicy(env.action_dim, role_seed(agent.config.seed, Role.EVALUATION)),
        }
        policy = policies[player]()
        progress.begin("evaluate", f"film strips of the {player} policy")
        for seed in episode_seeds(options.seed, options.episodes or 2):
            recorder = MomentRecorder()
            episode = next(play_episodes(env, policy, [seed], recorder))
            path = write_moments(recorder.moments, folder / f"{player}-{seed}.png")
            write_csv(path.with_suffix(".csv"), moment_rows(recorder.moments))
            panels = {name: step for step, name in key_steps(recorder.moments)}
            strips.append({"file": path.name, "panels": panels} | dataclasses.asdict(episode))
            progress.say(f"          {path}: {', '.join(panels)}")
    finally:
        progress.end()
        env.close()
    return describe(agent) | {"policy": player, "strips": strips}


def _reward_windows(options: argparse.Namespace, progress: Progress) -> dict[str, Any]:
    from slotfilm_dist.evaluation.record import read_run
    from slotfilm_dist.evaluation.reward_windows import WINDOWS, component_rows, draw_components, window_rows

    record = read_run(Path(options.run))
    table, components = window_rows(record), component_rows(record)
    folder = Path(options.run) / "reward_windows"
    write_csv(folder / "table.csv", table)
    write_csv(folder / "components.csv", components)
    draw_components(components, folder / "components.png")
    seen = {row["window"] for row in table}
    values = {
        "run": record.run_dir.name,
        "num_episodes": len(record.episodes),
        "last_env_steps": record.episodes[-1].env_steps,
        "windows_without_episodes": [window for window in WINDOWS if window not in seen],
        "table": table,
    }
    write_json(folder / "summary.json", values)
    for window in (w for w in WINDOWS if w in seen):
        rows = [row for row in table if row["window"] == window and row["share_of"] == "table_2"]
        text = ", ".join(f"{r['component']} {r['mean_percent']:.1f} ± {r['std_percent']:.1f} %" for r in rows)
        progress.say(f"{window:>8}  {text}")
    progress.say(f"  wrote  {folder}")
    return values


_PARTS: dict[str, Callable[[argparse.Namespace, Progress], dict[str, Any]]] = {
    "perception": _perception,
    "robustness": _robustness,
    "film_strips": _film_strips,
    "reward_windows": _reward_windows,
}
