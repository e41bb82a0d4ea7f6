"""Soft Actor-Critic whose whole update is one CUDA graph: hundreds of small kernels at the price of one launch.

It never waits for the GPU within an update. So a loss or gradient that is not finite is found there: the optimisers
then change nothing, a counter goes up, and the host reads the counters now and then and takes those updates back.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from slotfilm_dist.config import RunConfig
from slotfilm_dist.learning.lean_adam import LeanAdam, pieces
from slotfilm_dist.learning.off_policy import MAX_SKIPPED, METRICS_EVERY, TrainingDivergedError, gradient_norm
from slotfilm_dist.learning.sac import ADVICE, BATCH_FIELDS, SacLearner, annealed_temperature
from slotfilm_dist.messages import SampleBatch
from slotfilm_dist.nets.agent import AgentEncoder
from slotfilm_dist.nets.capture import Aside, Capture, Feed

SETTLE_EVERY = 32
"""Updates between readings of the counters."""


class GraphedSac(SacLearner):
    """`SacLearner` for a GPU and an encoder that works on tokens or on the state alone; the same updates.

    `updates` counts those under way as made until `settle`.
    """

    def __init__(
        self,
        config: RunConfig,
        encoder: AgentEncoder,
        action_dim: int,
        seed: np.random.SeedSequence,
        device: torch.device,
    ) -> None:
        super().__init__(config, encoder, action_dim, seed, device)
        assert encoder.visual_kind != "rgb", "pictures are updated without a graph"
        self._aside = Aside(device)
        shape = config.sac.batch_size, action_dim
        self._action_noise = torch.zeros(shape, device=device)
        self._failures = torch.zeros(3, dtype=torch.int64, device=device)
        """Updates skipped in all, in a row up to now, and at most in a row, since the last reading."""
        self._unread = self._worst = 0
        self._feed: Feed | None = None
        if config.runtime.compiled:
            for network in (encoder, self.actor, self.critic, self.value, self.target_value):
                network.compile()
        self._record_anew()

    def _record_anew(self) -> None:
        """Forget the graphs: they hold rates as numbers, and the optimisers' tensors."""
        self._plain = Capture(self._step, self.device)
        self._measured = Capture(self._step_and_measure, self.device)

    def update(self, batch: SampleBatch) -> None:
        """See `SacLearner.update`; that it diverged is raised up to `SETTLE_EVERY` updates later."""
        arrays = {name: getattr(batch, name) for name in BATCH_FIELDS}
        if self._feed is None:
            self._feed = Feed(arrays, self.device)
        self._feed.fill(arrays)
        self._action_noise.normal_(generator=self._noise)
        self.updates += 1
        if self.updates % METRICS_EVERY == 0:
            self._metrics = self._measured()
        else:
            self._plain()
        if self.config.sac.temperature_mode == "annealed":
            self._set_temperature(annealed_temperature(self.config.sac, self.updates))
        self._unread += 1
        if self._unread >= SETTLE_EVERY:
            self.settle()
        if self._worst >= MAX_SKIPPED:
            self._worst = 0
            raise TrainingDivergedError(
                f"loss or gradient was not finite {MAX_SKIPPED} times in a row at update {self.updates}; {ADVICE}"
            )

    def settle(self) -> None:
        """Wait for the updates under way and count as made only those that were."""
        if not self._unread:
            return
        skipped, in_a_row, worst = self._failures.tolist()
        self._unread = 0
        if skipped:
            self.updates -= skipped
            self.skipped_updates += skipped
            self._worst = max(self._worst, worst)
            in_a_row = 0 if worst >= MAX_SKIPPED else in_a_row
            self._failures.copy_(torch.tensor([0, in_a_row, in_a_row]))

    def metrics(self) -> dict[str, float]:
        """The latest measurements, by the metric catalogue's names."""
        self.settle()
        return super().metrics()

    def acting_arrays(self) -> dict[str, np.ndarray]:
        """What a worker needs to act."""
        self.settle()
        return super().acting_arrays()

    def save(self) -> dict[str, Any]:
        """Everything that the next update depends on."""
        self.settle()
        return super().save()

    def load(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
        super().load(state)
        self._failures.zero_()
        self._unread = self._worst = 0
        self._record_anew()

    def scale_rates(self, factor: float) -> None:
        """Multiply every optimiser's rate."""
        super().scale_rates(factor)
        self._record_anew()

    def _step(self) -> None:
        self._step_and_measure(measure=False)

    def _step_and_measure(self, *, measure: bool = True) -> dict[str, Tensor]:
        """What `SacLearner.update` does, without a look at any result."""
        assert self._feed is not None
        sac, batch, noise = self.config.sac, self._feed.tensors, self._action_noise
        critics = self._critic_terms(batch)
        failed = torch.zeros((), dtype=torch.bool, device=self.device)
        failed = self._descend_unless(failed, self._critic_optimiser, critics.loss, sac.grad_clip)
        policy = self._policy_terms(critics.latent.detach(), noise)
        failed = self._descend_unless(failed, self._policy_optimiser, policy.loss, 0.0)
        if sac.temperature_mode == "auto":
            self._descend_unless(failed, self._temperature_optimiser, self._temperature_loss(policy.log_prob), 0.0)
        self._follow_unless(failed)
        self._count(failed)
        return self._measure(batch, critics, policy) if measure else {}

    def _descend_unless(
        self, failed: Bool[Tensor, ""], optimiser: LeanAdam, loss: Float[Tensor, ""], clip: float
    ) -> Bool[Tensor, ""]:
        """A gradient step, unless something failed before or does here; gives whether it did."""
        optimiser.zero_grad()
        loss.backward()
        parameters = [p for group in optimiser.param_groups for p in group["params"]]
        norm = torch.nn.utils.clip_grad_norm_(parameters, clip) if clip else gradient_norm(parameters, cut=pieces)
        failed = failed | ~torch.isfinite(loss.detach() + norm)
        optimiser.found_inf = failed.float()
        optimiser.step()
        return failed

    @torch.no_grad()
    def _follow_unless(self, failed: Bool[Tensor, ""]) -> None:
        """`losses.polyak`, with a rate of 0 where something failed."""
        rate = self.config.sac.tau * (1.0 - failed.float())
        online, targets = pieces(self._online), pieces(self._targets)
        ways = torch._foreach_sub(online, targets)  # pyright: ignore[reportPrivateImportUsage]
        torch._foreach_mul_(ways, rate)  # pyright: ignore[reportPrivateImportUsage]
        torch._foreach_add_(targets, ways)  # pyright: ignore[reportPrivateImportUsage]

    def _count(self, failed: Bool[Tensor, ""]) -> None:
        one = failed.long()
        in_a_row = (self._failures[1] + 1) * one
        worst = torch.maximum(self._failures[2], in_a_row)
        self._failures.copy_(torch.stack((self._failures[0] + one, in_a_row, worst)))
