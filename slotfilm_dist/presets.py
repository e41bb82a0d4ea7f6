"""Budgets for a run: from seconds to the paper's 1.2 million steps."""

import difflib
from collections.abc import Callable
from dataclasses import replace

from slotfilm_dist.config import RunConfig


def paper() -> RunConfig:
    """The paper's numbers (Table A1, Section 5.1): 1.2 M steps, for a GPU host."""
    return RunConfig()


def steady() -> RunConfig:
    """The paper's lengths, with the values by which `oracle_state` came to solve the task (`ops/results/learning.md`).

    The reward is smooth up to the target and pays for standing still from a few rad/s down, the discount is short, and
    the temperature falls from exploring to standing still. Ablations of the reward as printed belong to `paper`.
    """
    base = paper()
    weights = replace(base.reward.weights, static=3.0)
    return replace(
        base,
        obs=replace(base.obs, normalize_state=True),
        pretrain=replace(base.pretrain, precision="auto"),
        reward=replace(base.reward, near_form="exp_only", pg_form="exp_alpha", varpi=0.7, weights=weights),
        sac=replace(
            base.sac,
            gamma=0.9,
            temperature_mode="annealed",
            temperature=0.1,
            final_temperature=0.005,
            annealing_updates=400_000,
            critic_norm="layer",
        ),
        lr=replace(base.lr, actor=3e-4),
    )


def cluster() -> RunConfig:
    """`steady` with many workers and shards."""
    base = steady()
    return replace(
        base,
        replay=replace(base.replay, num_shards=2),
        runtime=replace(base.runtime, num_workers=14, mode="ray"),
    )


def laptop() -> RunConfig:
    """A night on a CPU without a GPU: 300 k steps of short episodes, a small pre-training, random initial backbone."""
    base = steady()
    return replace(
        base,
        env=replace(base.env, max_steps=100),
        sac=replace(base.sac, annealing_updates=100_000),
        encoder=replace(base.encoder, backbone="random", frozen_precision="auto"),
        pretrain=replace(base.pretrain, steps=6_000, batch_size=64, lr=1e-3, train_backbone="none"),
        schedule=replace(base.schedule, total_steps=300_000, random_steps=20_000, updates_per_step=0.5),
        replay=replace(base.replay, capacity=300_000),
        evaluation=replace(base.evaluation, every_steps=50_000, during_episodes=5, episodes=50),
        checkpoint=replace(base.checkpoint, every_updates=5_000),
    )


def quick() -> RunConfig:
    """About ten minutes on two cores: learns to see the objects and to approach the banana."""
    base = laptop()
    return replace(
        base,
        env=replace(base.env, max_steps=200),
        pretrain=replace(base.pretrain, steps=1_500, eval_every=100),
        schedule=replace(base.schedule, total_steps=14_000, random_steps=4_000, random_episode_steps=32),
        replay=replace(base.replay, capacity=20_000, min_steps=1_000),
        evaluation=replace(base.evaluation, episodes=6, every_steps=0, videos=1),
        checkpoint=replace(base.checkpoint, every_updates=1_000),
    )


def smoke() -> RunConfig:
    """Seconds: every phase once, to see that it runs; learns nothing."""
    base = quick()
    return replace(
        base,
        env=replace(base.env, max_steps=40),
        pretrain=replace(base.pretrain, steps=20, batch_size=8, eval_every=10),
        schedule=replace(base.schedule, total_steps=400, random_steps=160),
        replay=replace(base.replay, capacity=1_000, min_steps=100),
        evaluation=replace(base.evaluation, episodes=2, videos=1),
        checkpoint=replace(base.checkpoint, every_updates=50),
        sac=replace(base.sac, batch_size=32),
        runtime=replace(base.runtime, publish_every=10),
    )


PRESETS: dict[str, Callable[[], RunConfig]] = {f.__name__: f for f in (smoke, quick, laptop, paper, steady, cluster)}


def preset_named(name: str) -> RunConfig:
    """The config of a preset; raises ``ValueError`` with the nearest known name."""
    if name not in PRESETS:
        near = difflib.get_close_matches(name, PRESETS, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"known: {', '.join(PRESETS)}"
        raise ValueError(f"preset = {name!r}: no such preset; {hint}")
    return PRESETS[name]()
