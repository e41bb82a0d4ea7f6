"""What lies between the learner and its links: nothing, or what a chaos run puts there."""

from collections.abc import Callable
from dataclasses import dataclass

from slotfilm_dist.cluster.hub_client import HubClient
from slotfilm_dist.cluster.learning_loops import SampleLink, UpdateLink
from slotfilm_dist.cluster.replay_client import ReplayClient


def direct_hub(hub: HubClient) -> UpdateLink:
    """The hub itself."""
    return hub


def direct_replay(replay: ReplayClient) -> SampleLink:
    """Replay itself."""
    return replay


@dataclass(frozen=True, kw_only=True, slots=True)
class Wiring:
    """How the learner's links are made; both functions stand at the top of a module or are `functools.partial`s."""

    hub: Callable[[HubClient], UpdateLink] = direct_hub
    replay: Callable[[ReplayClient], SampleLink] = direct_replay
