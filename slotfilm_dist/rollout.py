"""Steps environments with a policy and packs what happened into blocks."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.episodes import EpisodeTracker
from slotfilm_dist.messages import EpisodeSummary, Observation, StepResult, TransitionBlock
from slotfilm_dist.policy import Policy
from slotfilm_dist.rejection import StepCheck

TRAINING_SEEDS = 10_000_000
"""Training episodes are seeded below this; evaluation from here on."""


class RolloutLoop:
    """Steps environments with a policy.

    Consumes observations and the policy's actions; produces one `TransitionBlock` a call; waits for nothing; stops
    when it is no longer called. A step that is not finite or shows nothing is left out, its episode cut short, and a
    new one begun; see `StepCheck`.

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
        self._check = StepCheck()
        self.num_cut_episodes = 0
        """Episodes that ended with a rejected step; no summary is made of them."""
        self._rng = np.random.default_rng(seed)
        first, self._next_seeds = ([self._draw_seed() for _ in range(env.num_envs)] for _ in range(2))
        self._begin(first)

    @property
    def policy(self) -> Policy:
        """Who acts."""
        return self._policy

    @property
    def incarnation(self) -> int:
        """How often this worker had been restarted."""
        return self._incarnation

    @property
    def sequence(self) -> int:
        """Number of the next block."""
        return self._sequence

    @property
    def num_rejected(self) -> int:
        """Steps left out so far."""
        return self._check.num_rejected

    def collect(self, num_steps: int) -> TransitionBlock:
        """Take `num_steps` steps in every environment; a single environment stops early where its episode ends.

        A block thus ends where the simulator's state follows from a seed alone, and `save` is exact there.

        Raises:
            BrokenEnvironmentError: too many steps had to be left out.
        """
        lanes = [_Lane() for _ in range(self.env.num_envs)]
        episodes: list[EpisodeSummary] = []
        num_tried, version = 0, self._policy.version
        while num_tried < num_steps or not any(lane.rows for lane in lanes):
            episodes += self._step(lanes)
            num_tried += 1
            if self.env.num_envs == 1 and self.at_episode_start and lanes[0].rows:
                break
        for i, lane in enumerate(lanes):
            if lane.open:
                lane.add_frame(self._observation, self._visual, i)
        return self._pack(lanes, version, tuple(episodes))

    def _step(self, lanes: list["_Lane"]) -> list[EpisodeSummary]:
        """One step of every environment; gives the episodes that ended."""
        action = self._policy.act(self._observation, self._visual)
        step = self.env.step(action, self._next_seeds)
        over = step.terminated | step.truncated
        accepted = self._check.accepted(step)
        if not accepted.all():
            return self._cut(lanes, action, step, accepted)
        for i, lane in enumerate(lanes):
            lane.add_step(self._observation, self._visual, action, step, i)
        if over.any():
            final_visual = self._policy.visual(step.final)
            for i in np.flatnonzero(over):
                lanes[i].add_frame(step.final, final_visual, int(i))
        ended = self._tracker.add(step, self._next_seeds)
        self._next_seeds = [
            self._draw_seed() if done else seed for done, seed in zip(over, self._next_seeds, strict=True)
        ]
        self._observation = step.observation
        self._visual = self._policy.visual(step.observation)
        return ended

    def _cut(
        self, lanes: list["_Lane"], action: np.ndarray, step: StepResult, accepted: np.ndarray
    ) -> list[EpisodeSummary]:
        """Keep the accepted steps of a step that is rejected in part, and begin new episodes everywhere."""
        final_visual = self._policy.visual(step.final) if accepted.any() else self._visual
        for i, lane in enumerate(lanes):
            if accepted[i]:
                lane.add_step(self._observation, self._visual, action, step, i)
                lane.add_frame(step.final, final_visual, i)
            elif lane.open:
                lane.add_frame(self._observation, self._visual, i)
        over = np.flatnonzero(step.terminated | step.truncated)
        summaries = zip(over, self._tracker.add(step, self._next_seeds), strict=True)
        ended = [summary for i, summary in summaries if accepted[i]]
        self.num_cut_episodes += self.env.num_envs - len(ended)
        first, self._next_seeds = self._next_seeds, [self._draw_seed() for _ in lanes]
        self._begin(first)
        return ended

    @property
    def at_episode_start(self) -> bool:
        """Every environment has just been reset."""
        return self._tracker.num_running_steps == 0

    def save(self) -> dict[str, Any]:
        """Where the loop stands, as plain values; exact where `at_episode_start` holds, else the episode restarts."""
        return {
            "sequence": self._sequence,
            "incarnation": self._incarnation,
            "running_seeds": self._tracker.running_seeds,
            "next_seeds": list(self._next_seeds),
            "rng": self._rng.bit_generator.state,
        }

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue: the running episodes start again from their seeds, and the same ones follow."""
        self._sequence = int(state["sequence"])
        self._incarnation = int(state["incarnation"])
        self._rng.bit_generator.state = dict(state["rng"])
        self._next_seeds = [int(seed) for seed in state["next_seeds"]]
        self._begin([int(seed) for seed in state["running_seeds"]])

    def _begin(self, seeds: list[int]) -> None:
        self._observation = self.env.reset(seeds)
        while not self._check.accepts_start(self._observation):
            seeds = [self._draw_seed() for _ in seeds]
            self._observation = self.env.reset(seeds)
        self._visual = self._policy.visual(self._observation)
        self._tracker = EpisodeTracker(seeds, len(self.env.reward_term_names))

    def _draw_seed(self) -> int:
        return int(self._rng.integers(TRAINING_SEEDS))

    def _pack(self, lanes: list["_Lane"], version: int, episodes: tuple[EpisodeSummary, ...]) -> TransitionBlock:
        rows = [row for lane in lanes for row in lane.rows]
        columns: dict[str, np.ndarray] = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        block = TransitionBlock(
            worker_id=self._worker_id,
            incarnation=self._incarnation,
            sequence=self._sequence,
            policy_version=version,
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
            | ({} if step.reward_inputs is None else {"reward_inputs": step.reward_inputs[i]})
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
            | ({"reward_inputs": np.zeros_like(last["reward_inputs"])} if "reward_inputs" in last else {})
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
