"""The inference process as workers and the driver see it."""

from collections.abc import Mapping
from typing import Any

from slotfilm_dist.cluster.actors import InferenceActor
from slotfilm_dist.cluster.clients import ANSWER_S, ActorLink, is_ready
from slotfilm_dist.cluster.failures import RoleLostError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.messages import InferenceAnswer, InferenceRequest, InferenceStatus
from slotfilm_dist.cluster.placement import Placement
from slotfilm_dist.config import RunConfig

INFER_S = 10.0
"""Longest wait for one answer before it is asked for again; a process being started builds its encoder first."""
RESTARTS = 100
"""How often Ray replaces the process in one run."""


class InferenceClient:
    """The inference process; Ray starts it again when it dies, and it fetches the newest weights by itself."""

    def __init__(self, link: ActorLink) -> None:
        self._link = link
        self._question: Any = None
        self._last: InferenceStatus | None = None
        self._starts = ""
        self.num_restarts = 0

    @classmethod
    def launch(
        cls, config: RunConfig, hub: HubClient, placement: Placement, labels: Mapping[str, str]
    ) -> "InferenceClient":
        """Start the process; does not wait for it. `labels` are those of its metrics; empty for none."""
        link = ActorLink.launch(
            *(InferenceActor, "inference", config, hub, labels),
            keywords={"gpu": placement.gpu},
            num_cpus=placement.share_cpus,
            num_gpus=placement.inference_gpus,
            resources=dict(placement.state_resources),
            max_restarts=RESTARTS,
            max_task_retries=0,
        )
        return cls(link)

    def infer(self, request: InferenceRequest) -> InferenceAnswer:
        """Tokens and actions."""
        return self._link.answer(self._link.begin("infer", request), "actions", INFER_S)

    def has_weights(self, timeout_s: float) -> bool:
        """Whether it has weights to act with; raises `RoleSilentError` while it is being started."""
        return self._link.answer(self._link.begin("policy_version"), "its weights' version", timeout_s) >= 0

    def poll(self) -> InferenceStatus | None:
        """The last status, None before the first and while it is being started again; never waits."""
        if self._question is None:
            self._question = self._link.begin("status")
        if is_ready(self._question):
            question, self._question = self._question, None
            try:
                status = self._link.answer(question, "how it does", ANSWER_S)
            except RoleLostError:
                self._last = None
                return None
            self.num_restarts += self._starts not in ("", status.starts)
            self._starts, self._last = status.starts, status
        return self._last

    def process_id(self) -> int:
        """Of its process now."""
        return self._link.answer(self._link.begin("process_id"), "its process id", ANSWER_S)

    def kill(self) -> None:
        """End the process for good."""
        self._link.kill()
