"""Small run directories, written by the system's own writers."""

import dataclasses
import json

import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.evaluation.record import save_evaluation, summarize
from slotfilm_dist.messages import EpisodeSummary, TrainingEpisode
from slotfilm_dist.runs import RunDirectory
from slotfilm_dist.sinks import JsonLinesSink
from slotfilm_dist.variants import apply_variant

TERMS = ("reach", "grasp", "place", "post_grasp", "static")
EPISODE_STEPS = 50


def small_base():
    base = RunConfig()
    return dataclasses.replace(
        base,
        env=dataclasses.replace(base.env, max_steps=EPISODE_STEPS),
        schedule=dataclasses.replace(base.schedule, total_steps=1500, random_steps=300),
        replay=dataclasses.replace(base.replay, min_steps=100),
    )


def make_episode(episode_return, seed, *, solved=False):
    terms = (0.6 * episode_return, 0.1 * episode_return, 0.2 * episode_return, 0.1 * episode_return, 0.0)
    return EpisodeSummary(
        seed=seed,
        length=EPISODE_STEPS,
        episode_return=episode_return,
        success_once=solved,
        success_at_end=solved,
        placed_at_end=solved,
        grasped_once=True,
        reward_terms=terms,
    )


def write_small_run(folder, variant, seed, *, level=10.0, num_solved=3, over=True, base=None, pretrained=False):
    """A run whose learning policy's returns rise by steps of 0.1 to `level` and whose random policy's are 0.5."""
    config = dataclasses.replace(apply_variant(variant, base or small_base()), seed=seed)
    path = folder / f"{variant}-s{seed}"
    path.mkdir(parents=True)
    save_config(config, path / "config.json")
    command = f"slotfilm train smoke --variant {variant} --seed {seed} --runs {folder.name}"
    versions = {"command": command, "platform": "Linux-6", "cpu": "2 cores", "gpu": "none", "torch": "2.14.1"}
    (path / "versions.json").write_text(json.dumps(versions))
    run, total = RunDirectory(path, config), config.schedule.total_steps if over else 900
    ends = range(EPISODE_STEPS, total + 1, EPISODE_STEPS)
    for index, steps in enumerate(ends):
        learning = steps > config.schedule.random_steps
        value = level - 0.1 * (len(ends) - 1 - index) if learning else 0.5
        version = steps if learning else -1
        episode = TrainingEpisode(summary=make_episode(value, steps), policy_version=version, env_steps=steps)
        run.log_episodes([episode])
    sink = JsonLinesSink(run.metrics)
    for step in range(0, 101, 10) if pretrained else ():
        losses = dict.fromkeys(
            ("pretrain_position_loss", "pretrain_attention_loss", "pretrain_visibility_loss"), 1.0 - step / 200
        )
        sink.write({"time_s": 1.0, "env_steps": 300, "pretrain_steps_total": step, **losses})
    sink.write({"time_s": 2.0, "env_steps": total})
    sink.close()
    if over:
        episodes = tuple(make_episode(level, 10_000_000 + i, solved=i < num_solved) for i in range(10))
        final = summarize("final", "trained, deterministic", config.schedule.total_steps, episodes, TERMS)
        save_evaluation(final, path)
    return path


@pytest.fixture(scope="session", name="write_small_run")
def _write_small_run():
    """Function that writes a run of a variant and seed into a folder and gives its directory."""
    return write_small_run


@pytest.fixture(scope="session", name="small_base")
def _small_base():
    """The proposed agent's config of those runs."""
    return small_base()
