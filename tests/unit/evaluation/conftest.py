"""A run directory as the system leaves it: real files with generated numbers."""

import dataclasses
import json

import numpy as np
import pytest

from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import save_config
from slotfilm_dist.evaluation.record import save_evaluation, summarize
from slotfilm_dist.evaluation.video import RolloutFrame, write_film_strip, write_video
from slotfilm_dist.messages import EpisodeSummary
from slotfilm_dist.metrics import phase_index
from slotfilm_dist.sinks import JsonLinesSink

TERMS = ("reach", "grasp", "place", "post_grasp", "static")
EPISODE_STEPS = 400


def make_episode(skill, seed, rng):
    """An episode of a policy whose skill lies between 0 (random) and 1."""
    grasped = bool(rng.random() < min(1.0, 1.6 * skill))
    solved = grasped and bool(rng.random() < skill**2)
    share = np.array([0.05 + 0.1 * skill, 0.13 * grasped * skill, 0.3 * solved * skill, 0.03 * grasped, 0.02])
    terms = tuple(float(t) for t in EPISODE_STEPS * share * rng.uniform(0.85, 1.1, 5))
    return EpisodeSummary(
        seed=seed,
        length=EPISODE_STEPS,
        episode_return=sum(terms),
        success_once=solved,
        success_at_end=solved and bool(rng.random() < 0.95),
        placed_at_end=solved,
        grasped_once=grasped,
        reward_terms=terms,
    )


def make_evaluation(name, env_steps, skill, count, rng):
    episodes = tuple(make_episode(skill, 10_000_000 + i, rng) for i in range(count))
    policy = "random" if name == "random" else "trained, deterministic"
    return summarize(name, policy, env_steps, episodes, TERMS)


def skill_at(env_steps):
    return float(1 / (1 + np.exp(-(env_steps - 90_000) / 15_000)))


def write_training(run_dir, last_step, rng):
    """`metrics.jsonl` and `episodes.jsonl` up to that step: 20,000 random steps, pre-training, then learning."""
    sink = JsonLinesSink(run_dir / "metrics.jsonl")
    for step in range(0, 3001, 50):
        decay = np.exp(-step / 500)
        sink.write(
            {
                "time_s": 300.0 + step / 10,
                "env_steps": 20_000,
                "phase": phase_index("pretrain"),
                "pretrain_steps_total": step,
                "pretrain_position_loss": 0.02 + 0.3 * decay * rng.uniform(0.8, 1.2),
                "pretrain_visibility_loss": 0.05 + 0.6 * decay * rng.uniform(0.8, 1.2),
                "pretrain_attention_loss": 0.3 + 3.5 * decay * rng.uniform(0.8, 1.2),
                "pretrain_position_error_px": 2.4 + 26 * decay,
                "pretrain_baseline_error_px": 27.5,
                "pretrain_visibility_auroc": 0.99 - 0.4 * decay,
            }
        )
    for step in range(20_400, last_step + 1, 400):
        skill, noise = skill_at(step), rng.uniform(0.9, 1.1)
        sink.write(
            {
                "time_s": 600.0 + step / 25,
                "env_steps": step,
                "updates": step - 20_000,
                "phase": phase_index("train"),
                "learner_critic_loss": (0.3 + 2 * skill) * noise,
                "learner_value_loss": (0.1 + skill) * noise,
                "learner_actor_loss": -60 * skill * noise,
                "learner_q_mean": 70 * skill * noise,
                "learner_value_mean": 68 * skill * noise,
                "learner_target_mean": 69 * skill * noise,
                "learner_entropy_nats": 4 - 6 * skill * noise,
                "learner_temperature": 0.2,
                "learner_critic_gradient_norm": 3 * noise,
                "learner_actor_gradient_norm": 0.4 * noise,
                "learner_encoder_gradient_norm": 0.2 * noise,
                "learner_film_gain": 0.35 * skill,
                "weights_age_updates": 60 * noise,
                "worker_env_steps_per_s": 25 * noise,
                "learner_updates_per_s": 25 * noise,
                "limiter_ratio": 1 + 0.02 * (noise - 1),
                "limiter_target_ratio": 1.0,
                "worker_wait_share": 0.2 * noise,
                "learner_wait_share": 0.05 * noise,
                "run_memory_bytes": 2.1e9,
                "replay_stored_steps": step,
            }
        )
    sink.close()
    lines = []
    for step in range(400, last_step + 1, 400):
        episode = make_episode(skill_at(step) if step > 20_000 else 0.0, step // 400, rng)
        version = step - 20_000 if step > 20_000 else -1
        lines.append(json.dumps(dataclasses.asdict(episode) | {"env_steps": step, "policy_version": version}))
    (run_dir / "episodes.jsonl").write_text("\n".join(lines) + "\n")


def write_recordings(run_dir, num_steps):
    grid = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), axis=-1) + 0.5) / 8
    frames = []
    for step in range(num_steps):
        done = step / num_steps
        uv = np.array([[0.2 + 0.4 * done, 0.35], [0.7 - 0.2 * done, 0.7]])
        heat = np.exp(-90 * ((grid[None] - uv[:, None, None]) ** 2).sum(axis=-1)).reshape(2, 64)
        rgb = np.full((128, 128, 3), (150, 120, 90), dtype=np.uint8)
        for (u, v), color in zip(uv, ((240, 220, 60), (180, 40, 40)), strict=True):
            rgb[int(128 * v) - 8 : int(128 * v) + 8, int(128 * u) - 12 : int(128 * u) + 12] = color
        frames.append(
            RolloutFrame(
                rgb=rgb,
                attention=heat / heat.sum(axis=1, keepdims=True),
                uv_predicted=uv + 0.01,
                uv=uv,
                visible=np.array([True, True]),
                reward=0.1 + 0.8 * done,
                success=done > 0.8,
            )
        )
    write_video(frames, run_dir / "videos" / "final-seed-10000000.mp4")
    write_film_strip(frames, run_dir / "videos" / "final-seed-10000000.png")


def write_run(run_dir, *, finished, video_steps=8):
    """A run as the system leaves it: of 160,000 steps, or cut off after 60,000."""
    rng = np.random.default_rng(0)
    (run_dir / "evaluation").mkdir(parents=True)
    base = RunConfig()
    schedule = dataclasses.replace(base.schedule, total_steps=160_000, random_steps=20_000)
    sac = dataclasses.replace(base.sac, temperature=0.2, critic_norm="layer")
    save_config(dataclasses.replace(base, schedule=schedule, sac=sac, seed=3), run_dir / "config.json")
    versions = {"torch": "2.9.1", "ray": "2.51.0", "slotfilm-dist": "0.1.0", "python": "3.11.9", "gpu": ""}
    machine = {
        "platform": "Linux-6.1-x86_64",
        "cpu": "2 cores",
        "command": "slotfilm train laptop --seed 3",
        "started_at": "2026-01-05T10:00:00Z",
    }
    (run_dir / "versions.json").write_text(json.dumps(versions | machine))
    write_training(run_dir, 160_000 if finished else 60_000, rng)
    save_evaluation(make_evaluation("step-50000", 50_000, 0.1, 10, rng), run_dir)
    if finished:
        save_evaluation(make_evaluation("random", 0, 0.0, 50, rng), run_dir)
        save_evaluation(make_evaluation("step-100000", 100_000, 0.7, 10, rng), run_dir)
        save_evaluation(make_evaluation("step-150000", 150_000, 0.95, 10, rng), run_dir)
        save_evaluation(make_evaluation("final", 160_000, 0.97, 50, rng), run_dir)
        write_recordings(run_dir, video_steps)
    return run_dir


@pytest.fixture(scope="session", name="write_run")
def _write_run():
    """Function that writes a run into a directory and gives the directory."""
    return write_run


@pytest.fixture(scope="session", name="make_evaluation")
def _make_evaluation():
    """Function that plays an evaluation of given name, steps, skill and number of episodes."""
    return make_evaluation
