"""A worker's policy whose encoder and actor run elsewhere: it sends what it sees and gets tokens and actions."""

import time
from collections.abc import Callable
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float32, Shaped

from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.messages import InferenceAnswer, InferenceRequest
from slotfilm_dist.messages import Observation
from slotfilm_dist.policy import stored_pictures

PATIENCE_S = 120.0
"""Time that a worker puts up with an inference process that is gone or silent; Ray starts another one meanwhile."""
RETRY_S = 0.2
"""Pause before a process that is gone is asked again."""


@runtime_checkable
class InferenceLink(Protocol):
    """What a worker asks of the inference process."""

    def infer(self, request: InferenceRequest) -> InferenceAnswer:
        """Tokens and actions."""
        ...

    def has_weights(self, timeout_s: float) -> bool:
        """Whether it has weights to act with."""
        ...


class CentralPolicy:
    """Implements `ActingPolicy` on an `InferenceLink`; gives the same actions as `AgentPolicy` for the same seed.

    A new observation is sent once: the answer brings its tokens and, already, its action. The noise of an action is
    drawn here, so it does not matter who else is computed in the same batch, nor whether a request is repeated.

    Args:
        link: the inference process.
        worker_id: who asks.
        action_dim: size of an action.
        seed: of the action noise.
        note: called with what is waited for before every attempt; may raise to end the wait.
        patience_s: time that a gone or silent process is put up with.
    """

    def __init__(
        self,
        link: InferenceLink,
        worker_id: int,
        action_dim: int,
        seed: np.random.SeedSequence,
        note: Callable[[str], None],
        patience_s: float = PATIENCE_S,
    ) -> None:
        self._link, self._worker_id, self._action_dim = link, worker_id, action_dim
        self._note, self._patience_s = note, patience_s
        self._generator = torch.Generator().manual_seed(int(seed.generate_state(1)[0]))
        self._noise: Float32[np.ndarray, "envs action"] | None = None
        self._seen: Observation | None = None
        self._action: Float32[np.ndarray, "envs action"] | None = None
        self._heard_at = time.monotonic()
        self.version = -1
        self.backbone_hash = ""

    def await_weights(self, timeout_s: float) -> bool:
        """Whether the inference process has weights to act with.

        Raises:
            RoleSilentError: it has not answered for `patience_s`.
        """
        try:
            has_weights = self._link.has_weights(timeout_s)
        except (RoleLostError, RoleSilentError) as error:
            if time.monotonic() - self._heard_at > self._patience_s:
                raise RoleSilentError("inference", f"its start; last: {error}", self._patience_s) from error
            time.sleep(min(RETRY_S, timeout_s))  # it is being started
            return False
        self._heard_at = time.monotonic()
        return has_weights

    def take_lags_s(self) -> tuple[float, ...]:
        """None of its own: the inference process follows the weights, and tells."""
        return ()

    def visual(self, observation: Observation) -> Shaped[np.ndarray, "envs *visual"]:
        """Tokens, pictures, or nothing, as the encoder over there wants them."""
        answer = self._ask(observation, None)
        self._seen, self._action = observation, answer.action
        return stored_pictures(observation) if answer.tokens is None else answer.tokens

    def act(
        self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"]
    ) -> Float32[np.ndarray, "envs action"]:
        """The action that came with the observation's tokens."""
        if self._seen is not observation or self._action is None:
            self._action = self._ask(observation, visual).action
        action, self._action, self._noise = self._action, None, None
        return action

    def close(self) -> None:
        """Nothing to end here."""

    def _ask(self, observation: Observation, visual: Shaped[np.ndarray, "envs *visual"] | None) -> InferenceAnswer:
        request = InferenceRequest(
            worker_id=self._worker_id,
            rgb=observation.rgb if visual is None else None,
            visual=visual if visual is not None and visual.size else None,
            proprio=observation.proprio,
            goal=observation.goal,
            noise=self._next_noise(len(observation.proprio)),
        )
        began = time.monotonic()
        while True:
            self._note("actions of the inference process")
            try:
                answer = self._link.infer(request)
            except (RoleLostError, RoleSilentError) as error:
                if time.monotonic() - began > self._patience_s:
                    raise RoleSilentError("inference", f"actions; last: {error}", self._patience_s) from error
                time.sleep(RETRY_S)
                continue
            self.version, self.backbone_hash = answer.policy_version, answer.backbone_hash
            return answer

    def _next_noise(self, num_envs: int) -> Float32[np.ndarray, "envs action"]:
        """The noise of the next action: the same one until that action is taken."""
        if self._noise is None:
            self._noise = torch.randn(num_envs, self._action_dim, generator=self._generator).numpy()
        return self._noise
