"""Workers, learner and evaluation players as the driver sees them."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import Player
from slotfilm_dist.cluster.actors import LearnerActor, PlayerActor, WorkerActor
from slotfilm_dist.cluster.clients import ANSWER_S, ActorLink, is_ready
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError, RoleUnreachableError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.inference_client import InferenceClient
from slotfilm_dist.cluster.messages import AgentSetup, LearnerStatus, WorkerBeat
from slotfilm_dist.cluster.replay_client import ReplayClient
from slotfilm_dist.config import RunConfig
from slotfilm_dist.messages import TransitionBlock, WeightSnapshot

UNREACHABLE_S = 40.0
"""Longest wait for Ray to say why a worker takes no calls: a lost node shows after some missed health checks."""


class WorkerClient:
    """One worker as the supervisor sees it."""

    def __init__(self, link: ActorLink, worker_id: int) -> None:
        self._link, self.worker_id = link, worker_id
        self._question: Any = None
        self._last: WorkerBeat | None = None
        self._heard_at = time.monotonic()
        self._unreachable = False

    @classmethod
    def launch(
        cls,
        config: RunConfig,
        worker_id: int,
        make_env: Callable[..., Any],
        limits: Any,
        num_cpus: float,
        resources: Mapping[str, float],
        labels: Mapping[str, str],
    ) -> "WorkerClient":
        """Start a worker's process where there are these Ray resources; it does nothing yet.

        `labels` are those of its metrics; empty for none.
        """
        name = f"worker {worker_id}"
        arguments = (config, worker_id, make_env, limits, labels)
        link = ActorLink.launch(
            *(WorkerActor, name, *arguments), num_cpus=num_cpus, resources=dict(resources), max_restarts=0
        )
        return cls(link, worker_id)

    def train(self, incarnation: int, hub: HubClient, store: ReplayClient, agent: AgentSetup | InferenceClient) -> None:
        """Start collecting for replay, acting with an agent here or where one acts for all; does not wait."""
        self._last = None
        self._link.begin("train", incarnation, hub, store, agent)

    def collect_randomly(self, incarnation: int, already: int) -> None:
        """Start collecting with the random policy; does not wait."""
        self._last = None
        self._link.begin("collect_randomly", incarnation, already)

    def describe(self, timeout_s: float) -> tuple[int, tuple[str, ...]] | None:
        """Size of an action and the reward's terms, or None while the environment is being built."""
        return self._link.answer(
            self._link.begin("describe", timeout_s), "its environment to be built", timeout_s + ANSWER_S
        )

    def begin_take(self, timeout_s: float) -> Any:
        """Ask for the random policy's blocks; `taken` gives them."""
        return self._link.begin("take_random_blocks", timeout_s)

    def taken(self, request: Any, timeout_s: float) -> list[TransitionBlock] | None:
        """The result of `begin_take`, or None while there is none; raises `RoleLostError` if it will not come."""
        return (
            self._link.answer(request, "the random policy's blocks", ANSWER_S) if is_ready(request, timeout_s) else None
        )

    def poll(self) -> WorkerBeat | None:
        """The last beat, None before the first; never waits.

        Raises:
            RoleLostError: the process is gone.
        """
        if self._question is None:
            self._question = self._link.begin("beat")
        if is_ready(self._question):
            question, self._question = self._question, None
            try:
                self._last = self._link.answer(question, "how it does", ANSWER_S)
            except RoleUnreachableError:
                self._unreachable = True
                if time.monotonic() - self._heard_at > UNREACHABLE_S:
                    raise
                return self._last
            self._unreachable, self._heard_at = False, time.monotonic()
        return self._last

    @property
    def silent_s(self) -> float:
        """Time since it last answered; 0 while Ray cannot yet say what has become of it."""
        return 0.0 if self._unreachable else time.monotonic() - self._heard_at

    def begin_stop(self, timeout_s: float) -> Any:
        """Ask it to stop its loop; `stopped` waits for it."""
        return self._link.begin("stop", timeout_s)

    def stopped(self, request: Any, timeout_s: float) -> bool:
        """Whether the loop has ended in time."""
        try:
            return self._link.answer(request, "its loop to end", timeout_s)
        except (RoleLostError, RoleSilentError):
            return False

    def process_id(self) -> int:
        """Of its process."""
        return self._link.answer(self._link.begin("process_id"), "its process id", ANSWER_S)

    def kill(self) -> None:
        """End the process at once; native code cannot be interrupted otherwise."""
        self._link.kill()


class LearnerClient:
    """The learner as the driver sees it."""

    def __init__(self, link: ActorLink) -> None:
        self._link = link

    @classmethod
    def launch(
        cls,
        config: RunConfig,
        action_dim: int,
        num_threads: int,
        hub: Any,
        *,
        num_cpus: float,
        num_gpus: float,
        resources: Mapping[str, float],
    ) -> "LearnerClient":
        """Start the learner's process; `hub` is an `UpdateLink`."""
        link = ActorLink.launch(
            *(LearnerActor, "learner", config, action_dim, num_threads),
            keywords={"gpu": num_gpus > 0, "hub": hub},
            num_cpus=num_cpus,
            num_gpus=num_gpus,
            resources=dict(resources),
            max_restarts=0,
        )
        return cls(link)

    def call(self, method: str, *arguments: Any, timeout_s: float, **options: Any) -> Any:
        """A method of `LearnerRole` that takes its time; the same errors, plus those of a lost process."""
        request = self._link.begin("call", method, *arguments, **options)
        return self._link.answer(request, method.replace("_", " "), timeout_s)

    def status(self, timeout_s: float = ANSWER_S) -> LearnerStatus:
        """How it does."""
        return self._link.answer(self._link.begin("status"), "how it does", timeout_s)

    def process_id(self) -> int:
        """Of its process."""
        return self._link.answer(self._link.begin("process_id"), "its process id", ANSWER_S)

    def kill(self) -> None:
        """End the process at once."""
        self._link.kill()


class PlayerClient:
    """One evaluation process as the driver sees it."""

    def __init__(self, link: ActorLink) -> None:
        self._link = link

    @classmethod
    def launch(cls, config: RunConfig, index: int, make_env: Callable[..., Any], num_cpus: float) -> "PlayerClient":
        """Start a player's process."""
        arguments = (config, make_env)
        return cls(ActorLink.launch(PlayerActor, f"player {index}", *arguments, num_cpus=num_cpus, max_restarts=0))

    def begin_prepare(
        self, player: Player, camera: bool, setup: AgentSetup | None, snapshot: WeightSnapshot | None
    ) -> Any:
        """Build environment and policy; `answer` waits for it."""
        return self._link.begin("prepare", player, camera, setup, snapshot)

    def begin_play(self, seed: int) -> Any:
        """Play an episode; `answer` gives its summary."""
        return self._link.begin("play", seed)

    def begin_record(self, seed: int, video: Path, film_strip: Path) -> Any:
        """Play an episode and write its video; `answer` gives its summary."""
        return self._link.begin("record", seed, video, film_strip)

    def answer(self, request: Any, waiting_for: str, timeout_s: float) -> Any:
        """The result of a request."""
        return self._link.answer(request, waiting_for, timeout_s)

    def kill(self) -> None:
        """End the process."""
        self._link.kill()
