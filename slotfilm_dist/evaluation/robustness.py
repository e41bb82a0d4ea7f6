"""Success of a policy whose camera's picture is corrupted, which the paper did not measure.

The simulator, its seeds and everything that the policy is told beside the picture stay as they are: the state, and for
`slotfilm_goal` the goal's projection, which comes from the robot's calibration and not from the picture.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float32, Shaped

from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.evaluation.corruptions import check_corruption, corrupt
from slotfilm_dist.evaluation.record import Evaluation
from slotfilm_dist.evaluation.rollouts import Watch, play_episodes
from slotfilm_dist.evaluation.statistics import paired_difference
from slotfilm_dist.messages import EpisodeSummary, Observation
from slotfilm_dist.policy import Policy

Hold = Literal["frame", "episode"]
"""How long a drawn corruption lasts: one picture, as the paper's; or an episode, as dirt on a lens would."""


class CorruptedPolicy:
    """A policy that sees corrupted pictures; implements `Policy`.

    Args:
        policy: who acts.
        name: one of `CORRUPTIONS`.
        seed: of the corruption; the same seed gives the same sequence of corruptions.
        hold: draw anew for every picture, or once for all pictures of this object.
    """

    def __init__(self, policy: Policy, name: str, seed: int, hold: Hold = "frame") -> None:
        check_corruption(name)
        self._policy = policy
        self._name = name
        self._seed = seed
        self._hold = hold
        self._generator = torch.Generator().manual_seed(seed)
        self.version = policy.version
        self.backbone_hash = policy.backbone_hash

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """What the policy sees of the corrupted pictures."""
        if observation.rgb is None:
            return self._policy.visual(observation)
        if self._hold == "episode":
            self._generator.manual_seed(self._seed)
        rgb = torch.from_numpy(observation.rgb)
        corrupted, _ = corrupt(rgb, torch.from_numpy(observation.uv), self._name, self._generator)
        return self._policy.visual(dataclasses.replace(observation, rgb=corrupted.numpy()))

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """The policy's actions on what it saw."""
        return self._policy.act(observation, visual)


def play_corrupted(
    env: VectorEnv, policy: Policy, seeds: Sequence[int], name: str, hold: Hold = "frame", watch: Watch | None = None
) -> Iterator[EpisodeSummary]:
    """Play one episode for each seed under a corruption, which is drawn from the episode's seed."""
    for seed in seeds:
        yield from play_episodes(env, CorruptedPolicy(policy, name, seed, hold), [seed], watch)


def robustness_rows(evaluations: Mapping[str, Evaluation], rng: np.random.Generator) -> list[dict[str, Any]]:
    """One row for each corruption: success with its Wilson interval, return, and the difference from `clean`.

    The difference is taken seed by seed, with a 95 % bootstrap interval over seeds.
    """
    clean = evaluations["clean"]
    rows = []
    for name, evaluation in evaluations.items():
        difference = paired_difference(evaluation.returns_by_seed, clean.returns_by_seed, rng)
        share = {field: np.mean([getattr(e, field) for e in evaluation.episodes]) for field in _SHARES}
        rows.append(
            {
                "corruption": name,
                "num_episodes": len(evaluation.episodes),
                "success_at_end": evaluation.success_rate,
                "success_low": evaluation.success_interval[0],
                "success_high": evaluation.success_interval[1],
                **share,
                "return_mean": evaluation.mean_return,
                "return_std": evaluation.std_return,
                "return_change": difference.mean,
                "return_change_low": difference.interval[0],
                "return_change_high": difference.interval[1],
                "success_change": evaluation.success_rate - clean.success_rate,
            }
        )
    return rows


_SHARES = ("success_once", "placed_at_end", "grasped_once")
