"""The word by which a lost process is counted."""

import pytest
import ray.exceptions
from ray.core.generated.common_pb2 import ActorDiedErrorContext, NodeDeathInfo

from slotfilm_dist.cluster.clients import _reason
from slotfilm_dist.metrics import RESTART_REASONS


def died(text: str, *, preempted: bool = False) -> ray.exceptions.ActorDiedError:
    """What Ray raises where an actor's process is gone."""
    why = NodeDeathInfo.AUTOSCALER_DRAIN_PREEMPTED if preempted else NodeDeathInfo.UNSPECIFIED
    context = ActorDiedErrorContext(
        actor_id=bytes(16), class_name="Worker", error_message=text, node_death_info=NodeDeathInfo(reason=why)
    )
    return ray.exceptions.ActorDiedError(context)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ray.exceptions.OutOfMemoryError("killed by the memory monitor"), "memory"),
        (died("The node was above its memory usage threshold"), "memory"),
        (died("The actor died because its node has died."), "node_lost"),
        (died("The actor died because its node has died.", preempted=True), "preempted"),
        (died("The actor is dead because its worker process has died."), "crash"),
    ],
)
def test_lost_process_is_counted_under_its_reason(error: ray.exceptions.RayError, reason: str) -> None:
    assert _reason(error) == reason
    assert reason in RESTART_REASONS
