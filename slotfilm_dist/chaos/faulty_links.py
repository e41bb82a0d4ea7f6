"""Links of the learner that lose or spoil what they carry when they are told to; see `cluster.wiring`."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from slotfilm_dist.chaos.switches import Switches
from slotfilm_dist.cluster.learning_loops import SampleLink, UpdateLink
from slotfilm_dist.cluster.messages import AgentSetup, UpdateGrant
from slotfilm_dist.cluster.wiring import Wiring
from slotfilm_dist.messages import SampleBatch, TransitionBlock, WeightSnapshot


class LossyHub:
    """The hub, except that weights get lost on the way while the switch `lose_weights` is on.

    Args:
        hub: the real one.
        folder: of the switches.
    """

    def __init__(self, hub: UpdateLink, folder: Path) -> None:
        self._hub, self._switches = hub, Switches(folder)

    def admit_updates(self, max_updates: int, timeout_s: float) -> UpdateGrant:
        """Wait until updates are due."""
        return self._hub.admit_updates(max_updates, timeout_s)

    def refund_updates(self, num_updates: int) -> None:
        """Take back updates that did not happen."""
        self._hub.refund_updates(num_updates)

    def start_over(self, missing_steps: int) -> None:
        """As the hub does."""
        self._hub.start_over(missing_steps)

    def publish(self, snapshot: WeightSnapshot) -> None:
        """Take the newest weights, or lose them."""
        if self._switches.lasting("lose_weights") is None:
            self._hub.publish(snapshot)

    def set_up_agents(self, setup: AgentSetup) -> None:
        """Take what every policy needs besides the weights."""
        self._hub.set_up_agents(setup)

    def newest_version(self) -> int:
        """Version of the newest weights, -1 before the first."""
        return self._hub.newest_version()


class PoisonedReplay:
    """Replay, except that every reward of a request is the amount of the switch `reward`; NaN makes the loss NaN.

    The switch `first_reward` does so to a request's first batch alone: fewer in a row than make a learner go back.

    Args:
        replay: the real one.
        folder: of the switches.
    """

    def __init__(self, replay: SampleLink, folder: Path) -> None:
        self._replay, self._switches = replay, Switches(folder)

    def sample(self, num_batches: int, batch_size: int) -> list[SampleBatch]:
        """Draw batches, and spoil them if told to."""
        batches = self._replay.sample(num_batches, batch_size)
        for name, num_spoiled in (("reward", len(batches)), ("first_reward", 1)):
            amount = self._switches.take(name)
            if amount is not None:
                spoiled = [dataclasses.replace(b, reward=np.full_like(b.reward, amount)) for b in batches[:num_spoiled]]
                batches = [*spoiled, *batches[num_spoiled:]]
        return batches

    def num_steps(self) -> int:
        """Steps stored in the shards that answer."""
        return self._replay.num_steps()

    def insert_all(self, blocks: Iterable[TransitionBlock]) -> int:
        """Store blocks; gives the steps in them."""
        return self._replay.insert_all(blocks)


def faulty_wiring(folder: Path) -> Wiring:
    """A learner's links through the switches of a folder."""
    return Wiring(hub=partial(LossyHub, folder=folder), replay=partial(PoisonedReplay, folder=folder))
