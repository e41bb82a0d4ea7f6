"""Central inference: one encoder and actor, on a GPU where there is one, act for many workers. Plain, without Ray."""

import math
import threading
import time
import uuid
from collections import deque
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field

import numpy as np
import torch

from slotfilm_dist.cluster.acting import WeightFollower, WeightLink
from slotfilm_dist.cluster.failures import RoleSilentError
from slotfilm_dist.cluster.messages import InferenceAnswer, InferenceRequest, InferenceStatus
from slotfilm_dist.nets.capture import SizedCaptures
from slotfilm_dist.policy import AgentPolicy

DEADLINE_S = 0.005
"""Longest wait of a request for others to be computed with it."""
MAX_BATCH_STEPS = 256
"""Observations computed at once."""
ACTIVE_S = 1.0
"""A worker that asked within this time is expected to ask again, so a batch waits for it."""
ANSWER_S = 8.0
"""Longest wait for the first weights and for a batch to be computed."""


@dataclass(kw_only=True, slots=True)
class _Pending:
    """A request that waits for its batch."""

    request: InferenceRequest
    arrived_at: float
    answer: Future[InferenceAnswer] = field(default_factory=Future)


class InferenceServer:
    """Answers workers' observations with tokens and actions. `infer` may be called by many threads.

    One thread consumes requests and produces answers, batch by batch. It waits for the first request, then for others:
    until every worker that was active lately has asked, until the batch is full, or until the deadline of the oldest
    request. Another thread keeps the weights at the newest published ones. Both end with `close`.

    Args:
        policy: the agent's encoder and actor, on the device that computes.
        weights: where its weights come from.
        deadline_s: longest wait of a request for others.
        max_batch: observations computed at once.
        max_staleness_s: see `WeightFollower`.
        cuda_graphs: on a GPU, record the passes.
    """

    def __init__(
        self,
        policy: AgentPolicy,
        weights: WeightLink,
        *,
        deadline_s: float = DEADLINE_S,
        max_batch: int = MAX_BATCH_STEPS,
        max_staleness_s: float = math.inf,
        cuda_graphs: bool = True,
    ) -> None:
        self._policy = policy
        self._device = next(policy.actor.parameters()).device
        self._deadline_s, self._max_batch = deadline_s, max_batch
        self._follower = WeightFollower(policy, weights, max_staleness_s)
        self._changed = threading.Condition()
        self._pending: deque[_Pending] = deque()
        self._active: dict[int, float] = {}
        self._closing = False
        self._num_requests = self._num_steps = self._num_batches = 0
        self._busy_s = 0.0
        self._starts = uuid.uuid4().hex
        graphed = cuda_graphs and self._device.type == "cuda"
        self._run_batch = SizedCaptures(self._see_and_act, self._device) if graphed else self._run_plainly
        threading.Thread(target=self._run, name="inference", daemon=True).start()

    def infer(self, request: InferenceRequest) -> InferenceAnswer:
        """Tokens of the pictures and actions of the newest weights.

        Raises:
            RoleSilentError: the learner has published no weights, they are stale, or no batch was computed, in time.
        """
        if not self._follower.await_first(ANSWER_S):
            raise RoleSilentError("learner", "its first weights", ANSWER_S)
        if not self._follower.await_fresh(ANSWER_S):
            raise RoleSilentError("hub", "whether there are newer weights", self._follower.silence_s)
        pending = _Pending(request=request, arrived_at=time.monotonic())
        with self._changed:
            self._active[request.worker_id] = pending.arrived_at
            self._pending.append(pending)
            self._changed.notify_all()
        try:
            return pending.answer.result(ANSWER_S)
        except FutureTimeoutError:
            raise RoleSilentError("inference", "a batch to be computed", ANSWER_S) from None

    def status(self) -> InferenceStatus:
        """How it does."""
        return InferenceStatus(
            policy_version=self._follower.version,
            num_requests=self._num_requests,
            num_steps=self._num_steps,
            num_batches=self._num_batches,
            busy_s=self._busy_s,
            weights_lags_s=self._follower.take_lags_s(),
            starts=self._starts,
        )

    @property
    def policy_version(self) -> int:
        """Version of the weights that act; -1 before the first."""
        return self._follower.version

    def close(self) -> None:
        """Stop computing; nobody may ask any more."""
        self._follower.close()
        with self._changed:
            self._closing = True
            self._changed.notify_all()

    def _run(self) -> None:
        while batch := self._next_batch():
            began = time.monotonic()
            try:
                answers = self._compute([pending.request for pending in batch])
            except Exception as error:  # raised again in the threads that wait for these answers
                for pending in batch:
                    pending.answer.set_exception(error)
                continue
            self._busy_s += time.monotonic() - began
            self._num_requests += len(batch)
            self._num_batches += 1
            self._num_steps += sum(len(pending.request.proprio) for pending in batch)
            for pending, answer in zip(batch, answers, strict=True):
                pending.answer.set_result(answer)

    def _next_batch(self) -> list[_Pending]:
        """Requests of one kind to compute together, oldest first; none once closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._pending or self._closing)
            while not (self._closing or self._is_due()):
                oldest = self._pending[0].arrived_at
                self._changed.wait(max(0.0, oldest + self._deadline_s - time.monotonic()))
            if self._closing:
                return []
            batch, num_steps = [self._pending.popleft()], 0
            num_steps = len(batch[0].request.proprio)
            while self._pending and _fits(self._pending[0].request, batch[0].request):
                num_steps += len(self._pending[0].request.proprio)
                if num_steps > self._max_batch:
                    break
                batch.append(self._pending.popleft())
            return batch

    def _is_due(self) -> bool:
        now = time.monotonic()
        self._active = {worker: at for worker, at in self._active.items() if now - at <= ACTIVE_S}
        num_steps = sum(len(pending.request.proprio) for pending in self._pending)
        asking = {pending.request.worker_id for pending in self._pending}
        late = now - self._pending[0].arrived_at >= self._deadline_s
        return late or num_steps >= self._max_batch or asking >= self._active.keys()

    def _compute(self, requests: Sequence[InferenceRequest]) -> list[InferenceAnswer]:
        """One pass through encoder and actor, cut into the requests' answers."""
        policy, first = self._policy, requests[0]
        told = "visual" if first.visual is not None else "rgb" if first.rgb is not None else None
        names = ("proprio", "goal", "noise") + ((told,) if told else ())
        arrays = {name: np.concatenate([getattr(r, name) for r in requests]) for name in names}
        with self._follower.steady:
            action, visual = self._run_batch(arrays)
            version = self._follower.version
        # Pictures are kept where they are, only tokens have to be told.
        tokens = visual if policy.encoder.visual_kind == "tokens" and told == "rgb" else None
        ends = np.cumsum([len(r.proprio) for r in requests])
        return [
            InferenceAnswer(
                tokens=None if tokens is None else tokens[end - len(r.proprio) : end],
                action=action[end - len(r.proprio) : end],
                policy_version=version,
                backbone_hash=policy.backbone_hash,
            )
            for r, end in zip(requests, ends, strict=True)
        ]

    @torch.no_grad()
    def _see_and_act(self, batch: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """Actions, and what the encoder makes of the pictures."""
        policy, proprio = self._policy, batch["proprio"]
        if "visual" in batch:
            visual = batch["visual"]
        elif "rgb" in batch:
            visual = policy.encoder.to_visual(batch["rgb"])
        else:
            visual = torch.empty((len(proprio), 0), dtype=torch.uint8, device=self._device)
        return policy.actor.explore(policy.encoder(visual, proprio, batch["goal"]), batch["noise"]), visual

    def _run_plainly(self, arrays: Mapping[str, np.ndarray]) -> tuple[np.ndarray, ...]:
        tensors = {name: torch.from_numpy(array).to(self._device) for name, array in arrays.items()}
        return tuple(result.cpu().numpy() for result in self._see_and_act(tensors))


def _fits(request: InferenceRequest, first: InferenceRequest) -> bool:
    """Both bring pictures, tokens, or neither, so that they can be computed together."""
    return (request.visual is None, request.rgb is None) == (first.visual is None, first.rgb is None)
