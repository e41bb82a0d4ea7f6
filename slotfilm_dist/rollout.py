"""Steps environments with a policy and packs what happened into blocks."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.messages import EpisodeSummary, Observation, StepResult, TransitionBlock
from slotfilm_dist.policy import Policy

TRAINING_SEEDS = 10_000_000
"""Training episodes are seeded below this; evaluation from here on."""


def episode_seeds(seed: np.random.SeedSequence) -> Iterator[int]:
    """Endless episode seeds below `TRAINING_SEEDS`, drawn from a worker's own stream."""
    rng = np.random.default_rng(seed)
    while True:
        yield int(rng.integers(TRAINING_SEEDS))


class EpisodeTracker:
    """Sums up the running episode of every environment.

    Args:
        seeds: of the episodes that have just begun.
        num_terms: components of the reward.
    """

    def __init__(self, seeds: list[int], num_terms: int) -> None:
        self._seeds = list(seeds)
        count = len(seeds)
        self._length = np.zeros(count, np.int64)
        self._return = np.zeros(count)
        self._success = np.zeros(count, bool)
        self._grasped = np.zeros(count, bool)
        self._terms = np.zeros((count, num_terms))

    def add(self, step: StepResult, next_seeds: list[int]) -> list[EpisodeSummary]:
        """Take one `StepResult` in; gives the summaries of the episodes that it ended."""
        self._length += 1
        self._return += step.reward
        self._success |= step.success
        self._grasped |= step.grasped
        self._terms += step.reward_terms
        ended = np.flatnonzero(step.terminated | step.truncated)
        return [self._finish(int(i), step, next_seeds[i]) for i in ended]

    def _finish(self, i: int, step: StepResult, next_seed: int) -> EpisodeSummary:
        summary = EpisodeSummary(
            seed=self._seeds[i],
            length=int(self._length[i]),
            episode_return=float(self._return[i]),
            success_once=bool(self._success[i]),
            success_at_end=bool(step.success[i]),
            placed_at_end=bool(step.placed[i]),
            grasped_once=bool(self._grasped[i]),
            reward_terms=tuple(float(x) for x in self._terms[i]),
        )
        self._seeds[i] = next_seed
        self._length[i] = 0
        self._return[i] = 0
        self._success[i] = self._grasped[i] = False
        self._terms[i] = 0
        return summary


class RolloutLoop:
    """Steps environments with a policy.

    Consumes observations and the policy's actions; produces one `TransitionBlock` a call; waits for nothing; stops
    when it is no longer called.

    Args:
        env: the environments.
        policy: chooses the actions.
        seed: of the episodes.
        worker_id: who collects.
        incarnation: how often this worker had been restarted.
    """

    def __init__(
        self, env: VectorEnv, policy: Policy, seed: np.random.SeedSequence, worker_id: int = 0, incarnation: int = 0
    ) -> None:
        self.env = env
        self._policy = policy
        self._worker_id = worker_id
        self._incarnation = incarnation
        self._sequence = 0
        self._seeds = episode_seeds(seed)
        self._next_seeds = self._draw_seeds()
        first = self._draw_seeds()
        self._observation = env.reset(first)
        self._visual = policy.visual(self._observation)
        self._tracker = EpisodeTracker(first, len(env.reward_term_names))

    @property
    def policy(self) -> Policy:
        """Who acts."""
        return self._policy

    def collect(self, num_steps: int) -> TransitionBlock:
        """Take `num_steps` steps in every environment."""
        lanes = [_Lane() for _ in range(self.env.num_envs)]
        episodes: list[EpisodeSummary] = []
        for _ in range(num_steps):
            episodes += self._step(lanes)
        for i, lane in enumerate(lanes):
            if lane.open:
                lane.add_frame(self._observation, self._visual, i)
        return self._pack(lanes, tuple(episodes))

    def _step(self, lanes: list["_Lane"]) -> list[EpisodeSummary]:
        """One step of every environment; gives the episodes that ended."""
        action = self._policy.act(self._observation, self._visual)
        step = self.env.step(action, self._next_seeds)
        over = step.terminated | step.truncated
        for i, lane in enumerate(lanes):
            lane.add_step(self._observation, self._visual, action, step, i)
        if over.any():
            final_visual = self._policy.visual(step.final)
            for i in np.flatnonzero(over):
                lanes[i].add_frame(step.final, final_visual, i)
        ended = self._tracker.add(step, self._next_seeds)
        self._next_seeds = [
            next(self._seeds) if done else seed for done, seed in zip(over, self._next_seeds, strict=True)
        ]
        self._observation = step.observation
        self._visual = self._policy.visual(step.observation)
        return ended

    def _draw_seeds(self) -> list[int]:
        return [next(self._seeds) for _ in range(self.env.num_envs)]

    def _pack(self, lanes: list["_Lane"], episodes: tuple[EpisodeSummary, ...]) -> TransitionBlock:
        columns: dict[str, np.ndarray] = {
            name: np.stack([row[name] for lane in lanes for row in lane.rows]) for name in lanes[0].rows[0]
        }
        block = TransitionBlock(
            worker_id=self._worker_id,
            incarnation=self._incarnation,
            sequence=self._sequence,
            policy_version=self._policy.version,
            backbone_hash=self._policy.backbone_hash,
            episodes=episodes,
            **columns,
        )
        self._sequence += 1
        return block


class _Lane:
    """Rows of one environment; `open` while the last step's next frame is still missing."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self.open = False

    def add_step(
        self, observation: Observation, visual: np.ndarray, action: np.ndarray, step: StepResult, i: int
    ) -> None:
        self.rows.append(
            self._frame(observation, visual, i)
            | {
                "action": action[i],
                "reward": step.reward[i],
                "terminated": step.terminated[i],
                "truncated": step.truncated[i],
                "is_step": np.True_,
            }
        )
        self.open = True

    def add_frame(self, observation: Observation, visual: np.ndarray, i: int) -> None:
        last = self.rows[-1]
        self.rows.append(
            self._frame(observation, visual, i)
            | {
                "action": np.zeros_like(last["action"]),
                "reward": np.float32(0),
                "terminated": np.False_,
                "truncated": np.False_,
                "is_step": np.False_,
            }
        )
        self.open = False

    @staticmethod
    def _frame(observation: Observation, visual: np.ndarray, i: int) -> dict[str, Any]:
        return {
            "visual": visual[i],
            "proprio": observation.proprio[i],
            "goal": observation.goal[i],
            "uv": observation.uv[i],
            "visible": observation.visible[i],
        }
