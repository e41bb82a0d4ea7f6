"""Plays whole episodes with a frozen policy, on seeds that training never sees."""

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from slotfilm_dist.contracts import VectorEnv
from slotfilm_dist.episodes import EpisodeTracker
from slotfilm_dist.evaluation.video import RolloutFrame
from slotfilm_dist.messages import EpisodeSummary, Observation, StepResult
from slotfilm_dist.nets.encoder import SlotFusionEncoder
from slotfilm_dist.nets.interface import Encoder
from slotfilm_dist.policy import Policy
from slotfilm_dist.rejection import BrokenEnvironmentError, StepCheck

Watch = Callable[[Observation, np.ndarray, StepResult], None]
"""Called with what was seen, as stored, and what the action led to."""


def play_episodes(
    env: VectorEnv, policy: Policy, seeds: Sequence[int], watch: Watch | None = None
) -> Iterator[EpisodeSummary]:
    """Play one episode for each seed, from its own reset, to its end; nothing of it enters replay.

    Args:
        env: a single environment of its own.
        policy: acts; give a deterministic one for evaluation.
        seeds: of the episodes.
        watch: sees every step.

    Raises:
        BrokenEnvironmentError: a step or a first picture that is not finite or all black: no episode to judge by.
    """
    check = StepCheck()
    for seed in seeds:
        observation = env.reset([seed])
        if not check.accepts_start(observation):
            raise BrokenEnvironmentError(f"the episode of seed {seed} began with what is not finite or a black picture")
        tracker = EpisodeTracker([seed], len(env.reward_term_names))
        finished: list[EpisodeSummary] = []
        while not finished:
            visual = policy.visual(observation)
            step = env.step(policy.act(observation, visual), [seed])
            if not check.accepted(step).all():
                raise BrokenEnvironmentError(
                    f"a step of the episode of seed {seed} was not finite or had a black picture"
                )
            if watch is not None:
                watch(observation, visual, step)
            finished = tracker.add(step, [seed])
            observation = step.observation
        yield finished[0]


class Recorder:
    """Collects the frames of an episode for a video, with what the agent attends to.

    Args:
        encoder: whose slots' attention is drawn; of one without slots, or of None, the picture alone.
    """

    def __init__(self, encoder: Encoder | None) -> None:
        slots = encoder if isinstance(encoder, SlotFusionEncoder) else None
        self._encoder = slots if slots is not None and slots.perception is not None else None
        self.frames: list[RolloutFrame] = []

    @torch.inference_mode()
    def __call__(self, observation: Observation, visual: np.ndarray, step: StepResult) -> None:
        """Take one step in."""
        if observation.rgb is None:
            return
        attention, uv = np.zeros((0, 64), np.float32), np.zeros((0, 2), np.float32)
        if self._encoder is not None:
            device = self._encoder.proprio_mean.device
            tensor = torch.from_numpy(visual).to(device)
            tokens = self._encoder.tokens(tensor) if tensor.dtype == torch.uint8 else tensor
            seen = self._encoder.perceive(tokens)
            attention, uv = seen.attention[0].cpu().numpy(), seen.uv[0].cpu().numpy()
        self.frames.append(
            RolloutFrame(
                rgb=observation.rgb[0],
                attention=attention,
                uv_predicted=uv,
                uv=observation.uv[0],
                visible=observation.visible[0],
                reward=float(step.reward[0]),
                success=bool(step.success[0]),
            )
        )
