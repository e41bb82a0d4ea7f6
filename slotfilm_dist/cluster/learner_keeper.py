"""The learner's process as the backend needs it: started at the first need, replaced when it is lost."""

import logging
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.messages import LearnerBeginning, LearnerStatus
from slotfilm_dist.cluster.placement import Placement
from slotfilm_dist.cluster.replay_client import ReplayClient
from slotfilm_dist.cluster.role_clients import LearnerClient
from slotfilm_dist.cluster.wiring import Wiring
from slotfilm_dist.config import RunConfig
from slotfilm_dist.machine import usable_cores

STOP_S = 5.0
"""Time that the learner gets to finish its update."""
SILENCE_S = 60.0
"""Time without an answer after which the learner counts as lost."""
LONG_S = 3600.0
"""Longest wait for what depends on the size of data: reading, encoding, writing."""
PRETRAIN_CHUNK = 10
"""Pre-training steps between reports."""
PRETRAIN_SAVE_S = 60.0
"""Seconds between checkpoints of an unfinished pre-training."""
MAX_RESTARTS = 10
"""Losses of the learner before the run is given up."""

_logger = logging.getLogger(__name__)


class LearnerKeeper:
    """Starts the learner, sets it to work, and starts it again from its last checkpoint when its process is lost.

    Args:
        config: the run.
        run: its directory.
        hub: admits updates, takes weights.
        placement: what the learner asks Ray for.
        action_dim: size of an action.
        wiring: what lies between the learner and its links.
    """

    def __init__(
        self, config: RunConfig, run: Path, hub: HubClient, placement: Placement, action_dim: int, *, wiring: Wiring
    ) -> None:
        self._config, self._folder, self._hub = config, run / "checkpoints", hub
        self._placement, self._action_dim, self._wiring = placement, action_dim, wiring
        self._sources: tuple[Path, Path | None] | None = None
        self._make_replay: Callable[[], ReplayClient] | None = None
        self.num_restarts = 0
        self._client = self._launch()

    def call(self, method: str, *arguments: Any, timeout_s: float = LONG_S, **options: Any) -> Any:
        """A method of `LearnerRole` that takes its time; the same errors, plus those of a lost process."""
        self._await_start()
        return self._client.call(method, *arguments, timeout_s=timeout_s, **options)

    def pretrain(self, dataset: Path, artifact: Path, check: Callable[[], None]) -> Iterator[dict[str, float]]:
        """Pre-train, from what was last saved on; the same where the process is lost meanwhile.

        Args:
            dataset: the random policy's data.
            artifact: where the result goes.
            check: raises where the run cannot go on.

        Raises:
            RunFailedError: the process was lost too often.
        """
        while True:
            try:
                yield from self._pretrain(dataset, artifact, check)
            except (RoleLostError, RoleSilentError) as error:
                self.launch_again(error)
            else:
                return

    def begin(self, dataset: Path, pretrained: Path | None, resume_from: Path | None) -> LearnerBeginning:
        """Build the agent; a checkpoint that cannot be read, and is passed over, is told.

        Raises:
            ValueError: a file does not fit or is damaged.
        """
        self._sources = dataset, pretrained
        return self._begin(resume_from)

    def refill(self, make_replay: Callable[[], ReplayClient]) -> None:
        """Store the random policy's data in replay."""
        assert self._sources is not None, "begin comes first"
        self.call("connect", self._wiring.replay(make_replay()))
        self.call("refill", self._sources[0])

    def start(self, make_replay: Callable[[], ReplayClient]) -> None:
        """Start learning from replay, of which every process of the learner gets a client of its own."""
        self._make_replay = make_replay
        self.call("connect", self._wiring.replay(make_replay()))
        self.call("start")

    def status(self) -> LearnerStatus:
        """How it does; a lost one is replaced and goes on from the last checkpoint.

        Raises:
            RunFailedError: it failed by itself, or was lost too often.
        """
        try:
            status = self._client.status(SILENCE_S)
        except (RoleLostError, RoleSilentError) as error:
            return self._replace_until_it_stays(error)
        if status.error:
            raise RunFailedError(f"the learner stopped: {status.error}; go on with --resume")
        return status

    def process_id(self) -> int:
        """Of its process now."""
        return self._client.process_id()

    def close(self) -> None:
        """Stop learning, then end the process."""
        try:
            self._client.call("stop", STOP_S / 2, timeout_s=STOP_S)
        finally:
            self._client.kill()

    def _pretrain(self, dataset: Path, artifact: Path, check: Callable[[], None]) -> Iterator[dict[str, float]]:
        self.call("begin_pretraining", dataset, artifact)
        saved_at, done = time.monotonic(), 0
        while done < self._config.pretrain.steps:
            metrics, done = self.call("pretrain", PRETRAIN_CHUNK)
            if metrics:
                yield metrics
            check()
            if time.monotonic() - saved_at > PRETRAIN_SAVE_S:
                self.call("save_pretraining", artifact, finished=False)
                saved_at = time.monotonic()
        self.call("save_pretraining", artifact, finished=True)

    def _launch(self) -> LearnerClient:
        self._started = False
        threads = self._config.runtime.learner_threads or max(1, int(usable_cores()) // 2)
        return LearnerClient.launch(
            self._config,
            self._action_dim,
            threads,
            self._wiring.hub(self._hub),
            num_cpus=self._placement.learner_cpus,
            num_gpus=self._placement.learner_gpus,
            resources=self._placement.state_resources,
        )

    def _begin(self, resume_from: Path | None) -> LearnerBeginning:
        assert self._sources is not None, "begin comes first"
        beginning: LearnerBeginning = self.call("begin", *self._sources, resume_from)
        for problem in beginning.problems:
            _logger.warning("an older checkpoint is used: %s", problem)
        return beginning

    def _await_start(self) -> None:
        """Until its process runs, which Ray starts where there is room: another run may have the GPU."""
        while not self._started:
            try:
                self._client.process_id()
                self._started = True
            except RoleSilentError:
                _logger.warning(
                    "the learner's process has not started yet: it asks for %g GPUs and %g cores; `ray status` shows "
                    "who has them. Waiting; Ctrl-C twice ends the run, and --resume goes on",
                    self._placement.learner_gpus,
                    self._placement.learner_cpus,
                )

    def _replace_until_it_stays(self, error: Exception) -> LearnerStatus:
        while True:
            try:
                return self._replace(error)
            except (RoleLostError, RoleSilentError) as again:
                error = again

    def launch_again(self, error: Exception) -> None:
        """Put a new process in place of one that is lost.

        Raises:
            RunFailedError: it was lost too often.
        """
        self.num_restarts += 1
        if self.num_restarts > MAX_RESTARTS:
            raise RunFailedError(f"the learner was lost {self.num_restarts} times, last: {error}; --resume goes on")
        _logger.warning("the learner's process is replaced: %s", error)
        self._client.kill()
        self._client = self._launch()

    def _replace(self, error: Exception) -> LearnerStatus:
        assert self._make_replay is not None, "start comes first"
        self.launch_again(error)
        self._begin(self._folder if any(self._folder.glob("updates-*")) else None)
        status = self._client.status()
        # What was granted and is lost with the process is due again.
        self._hub.refund_updates(self._hub.status().updates - status.updates)
        self.start(self._make_replay)
        return status
