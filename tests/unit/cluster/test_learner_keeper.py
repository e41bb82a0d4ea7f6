"""How a lost learner is replaced, without Ray: its process is a stand-in, the hub a real one."""

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest

from slotfilm_dist.backend import RunFailedError
from slotfilm_dist.cluster import learner_keeper
from slotfilm_dist.cluster.failures import RoleLostError, RoleSilentError
from slotfilm_dist.cluster.hub import Hub, build_limiter
from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.learner_keeper import MAX_RESTARTS, LearnerKeeper
from slotfilm_dist.cluster.messages import BlockKey, BlockNotice, HubStatus, LearnerBeginning, LearnerStatus
from slotfilm_dist.cluster.placement import Placement
from slotfilm_dist.cluster.replay_client import ReplayClient
from slotfilm_dist.cluster.role_clients import LearnerClient
from slotfilm_dist.cluster.wiring import Wiring
from slotfilm_dist.presets import smoke
from slotfilm_dist.replay.schema import ReplaySchema

SAVED_UPDATES = 4
LOST = RoleLostError("learner", "crash", "its process has died")


class HubHere(HubClient):
    """The hub in this process."""

    def __init__(self, hub: Hub) -> None:
        self.hub = hub

    def status(self) -> HubStatus:
        return self.hub.status()

    def refund_updates(self, num_updates: int) -> None:
        self.hub.refund_updates(num_updates)


class Process(LearnerClient):
    """A learner that has made as many updates as its checkpoint says, or is gone."""

    launched: ClassVar[list["Process"]] = []
    errors: ClassVar[list[Exception]] = []

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.killed = False

    @classmethod
    def launch(cls, *arguments: Any, **options: Any) -> "Process":
        cls.launched.append(cls())
        return cls.launched[-1]

    def call(self, method: str, *arguments: Any, timeout_s: float, **options: Any) -> Any:
        self.calls.append(method if method != "begin" else f"begin from {arguments[2]}")
        schema = ReplaySchema(visual_kind="none", visual_shape=(0,), proprio_dim=35, action_dim=7, num_objects=2)
        return LearnerBeginning(values={}, problems=(), schema=schema, random_steps=100)

    def status(self, timeout_s: float = 1.0) -> LearnerStatus:
        if Process.errors:
            raise Process.errors.pop(0)
        return LearnerStatus(updates=SAVED_UPDATES, metrics={}, waiting_for="")

    def process_id(self) -> int:
        return 1

    def kill(self) -> None:
        self.killed = True


@pytest.fixture
def keeper(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> LearnerKeeper:
    """Of a learner that was granted 10 updates and has a checkpoint of 4."""
    monkeypatch.setattr(learner_keeper, "LearnerClient", Process)
    Process.launched, Process.errors = [], []
    hub = Hub(build_limiter(1.0, 100, 16), 1_000, 1)
    hub.count_random_steps(100)
    key = BlockKey(worker_id=0, incarnation=0, sequence=0)
    assert hub.admit_steps(BlockNotice(key=key, num_steps=16, policy_version=0, episodes=()), [], 0.1).granted
    assert hub.admit_updates(10, 0.1).num_updates == 10
    (tmp_path / "checkpoints" / "updates-000000004").mkdir(parents=True)
    placement = Placement(share_cpus=1.0, gpu=False, learner_cpus=1.0, learner_gpus=0.0)
    made = LearnerKeeper(smoke(), tmp_path, HubHere(hub), placement, 7, wiring=Wiring())
    made.begin(tmp_path / "data", None, None)
    made.start(lambda: ReplayClient([], np.random.SeedSequence(0)))
    return made


def hub_of(keeper: LearnerKeeper) -> Hub:
    assert isinstance(keeper._hub, HubHere)
    return keeper._hub.hub


@pytest.mark.parametrize("error", [LOST, RoleSilentError("learner", "how it does", 60.0)])
def test_lost_learner_goes_on_from_its_checkpoint_and_what_is_lost_falls_due_again(
    keeper: LearnerKeeper, error: Exception, tmp_path: Path
) -> None:
    Process.errors = [error]
    assert keeper.status().updates == SAVED_UPDATES
    first, second = Process.launched
    assert (first.killed, second.killed) == (True, False)
    assert second.calls == [f"begin from {tmp_path / 'checkpoints'}", "connect", "start"]
    assert hub_of(keeper).status().updates == SAVED_UPDATES
    assert hub_of(keeper).admit_updates(10, 0.1).num_updates == 10


def test_learner_that_is_lost_again_while_it_comes_back_is_replaced_until_it_stays(keeper: LearnerKeeper) -> None:
    Process.errors = [LOST] * 3
    assert keeper.status().updates == SAVED_UPDATES
    assert keeper.num_restarts == 3
    assert [process.killed for process in Process.launched] == [True, True, True, False]
    assert hub_of(keeper).status().updates == SAVED_UPDATES


def test_run_is_given_up_after_too_many_losses(keeper: LearnerKeeper) -> None:
    Process.errors = [LOST] * (MAX_RESTARTS + 1)
    with pytest.raises(RunFailedError, match=rf"the learner was lost {MAX_RESTARTS + 1} times, .*--resume goes on"):
        keeper.status()
    assert len(Process.launched) == MAX_RESTARTS + 1


def test_learner_that_is_lost_while_it_pretrains_goes_on_from_what_was_saved(
    keeper: LearnerKeeper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done, lost_at = [0], [10]

    def call(process: Process, method: str, *arguments: Any, timeout_s: float, **options: Any) -> Any:
        process.calls.append(method)
        if method == "pretrain":
            if done[0] in lost_at:
                lost_at.clear()
                raise LOST
            done[0] += arguments[0]
            return {"pretrain_steps_total": float(done[0])}, done[0]
        return None

    monkeypatch.setattr(Process, "call", call)
    seen = list(keeper.pretrain(tmp_path / "data", tmp_path / "encoder", lambda: None))
    assert [metrics["pretrain_steps_total"] for metrics in seen] == [10.0, 20.0]
    first, second = Process.launched
    assert first.killed
    assert second.calls[0] == "begin_pretraining"
    assert second.calls[-1] == "save_pretraining"
