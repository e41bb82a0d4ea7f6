"""The hub as the other roles see it."""

from collections.abc import Iterable, Mapping
from typing import Any

from slotfilm_dist.cluster.actors import HubActor
from slotfilm_dist.cluster.clients import ANSWER_S, ActorLink
from slotfilm_dist.cluster.messages import AgentSetup, BlockKey, BlockNotice, HubStatus, StepGrant, UpdateGrant
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import TrainingEpisode, WeightSnapshot


class HubClient:
    """The hub as other roles see it."""

    def __init__(self, link: ActorLink) -> None:
        self._link = link

    @classmethod
    def launch(cls, config: RunConfig, namespace: str, resources: Mapping[str, float]) -> "HubClient":
        """Start the hub under its name, so that `slotfilm scale` finds it, where there are these Ray resources."""
        link = ActorLink.launch(
            *(HubActor, "hub", config), registered="hub", namespace=namespace, num_cpus=0, resources=dict(resources)
        )
        return cls(link)

    @classmethod
    def find(cls, namespace: str) -> "HubClient":
        """The hub of a live run; raises ``ValueError`` if there is none."""
        return cls(ActorLink.find("hub", namespace))

    def admit_steps(self, notice: BlockNotice, stored: Iterable[BlockKey], timeout_s: float) -> StepGrant:
        """Wait until a block's steps fit."""
        reference = self._link.begin("admit_steps", notice, list(stored), timeout_s)
        return self._link.answer(reference, "admission of a block", timeout_s + ANSWER_S)

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until updates are due."""
        reference = self._link.begin("admit_updates", max_updates, timeout_s)
        return self._link.answer(reference, "admission of updates", timeout_s + ANSWER_S)

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Send the newest weights; does not wait."""
        self._link.begin("publish", snapshot)

    def await_newer(self, newer_than: int, timeout_s: float) -> WeightSnapshot | None:
        """The newest weights, as soon as there are some newer than a version; None when time runs out."""
        shared = self._link.answer(
            self._link.begin("await_newer", newer_than, timeout_s), "newer weights", timeout_s + ANSWER_S
        )
        return self._link.answer(shared[0], "published weights", ANSWER_S) if shared else None

    def confirm(self, stored: Iterable[BlockKey]) -> None:
        """Note that blocks are in replay."""
        self._call("confirm", list(stored))

    def pending(self, worker_id: int, incarnation: int) -> list[BlockKey]:
        """Blocks of a worker that were granted and not confirmed."""
        return self._call("pending", worker_id, incarnation)

    def settle(self, worker_id: int, incarnation: int, stored: Iterable[BlockKey]) -> int:
        """Confirm what a lost worker had stored, take back the rest."""
        return self._call("settle", worker_id, incarnation, list(stored))

    def refund_updates(self, num_updates: int) -> None:
        """Take back updates that did not happen."""
        self._call("refund_updates", num_updates)

    def count_random_steps(self, num_steps: int) -> None:
        """Note the random policy's steps and let learning begin after them."""
        self._call("count_random_steps", num_steps)

    def start_over(self, missing_steps: int) -> None:
        """After a loss of stored steps: no updates until so many new ones have come."""
        self._call("start_over", missing_steps)

    def load(self, limiter: dict[str, Any]) -> None:
        """Continue a run's counters."""
        self._call("load", limiter)

    def save(self, updates: int) -> dict[str, Any]:
        """The counters."""
        return self._call("save", updates)

    def latest(self, newer_than: int) -> WeightSnapshot | None:
        """The newest weights."""
        return self._call("latest", newer_than)

    def newest_version(self) -> int:
        """Version of the newest weights."""
        return self._call("newest_version")

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Give what every policy needs besides the weights."""
        self._call("set_up_agents", setup)

    def agent_setup(self) -> AgentSetup:
        """What every policy needs besides the weights."""
        return self._call("agent_setup")

    def want_workers(self, num_workers: int) -> None:
        """Ask for a number of workers, kept from now on."""
        self._call("want_workers", num_workers)

    def want_auto_workers(self) -> None:
        """Let the run decide from now on how many workers it needs."""
        self._call("want_auto_workers")

    def adapt_workers(self, num_workers: int) -> None:
        """The run's own decision."""
        self._call("adapt_workers", num_workers)

    def note_alive(self, num_workers: int) -> None:
        """Say how many workers run."""
        self._call("note_alive", num_workers)

    def take_episodes(self) -> list[TrainingEpisode]:
        """Episodes that ended since the last call."""
        return self._call("take_episodes")

    def status(self) -> HubStatus:
        """The counters."""
        return self._call("status")

    def process_id(self) -> int:
        """Of its process."""
        return self._link.answer(self._link.begin("process_id"), "its process id", ANSWER_S)

    def close(self) -> None:
        """Send everyone who waits home."""
        self._call("close")

    def kill(self) -> None:
        """End the process."""
        self._link.kill()

    def _call(self, method: str, *arguments: Any) -> Any:
        return self._link.answer(self._link.begin("call", method, *arguments), method.replace("_", " "), ANSWER_S)
