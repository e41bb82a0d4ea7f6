"""Which faults happen, to whom, and when: a list that follows from one seed."""

import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

Scene = Literal["live", "driver", "files"]
"""Where a fault takes place: in one run that goes on, in a driver of its own, or without a run."""
FEWEST_STEPS, MOST_STEPS = 100, 400
"""Environment steps of quiet before a fault of a live run."""


@dataclass(frozen=True, kw_only=True, slots=True)
class FaultKind:
    """A fault that can be brought about."""

    name: str
    scene: Scene
    rows: str
    """Numbers of the fault cases that it stands for."""
    expected: str
    """What should follow."""


@dataclass(frozen=True, kw_only=True, slots=True)
class PlannedFault:
    """A fault of a plan."""

    kind: FaultKind
    after_steps: int
    """Environment steps of quiet before it, in a live run."""
    seed: int
    """Of everything else about it: which worker, which shard, which bit."""

    def rng(self) -> np.random.Generator:
        """The stream that decides the rest."""
        return np.random.default_rng(self.seed)


def _kinds(scene: Scene, rows: Mapping[str, tuple[str, str]]) -> dict[str, FaultKind]:
    return {
        name: FaultKind(name=name, scene=scene, rows=numbers, expected=expected)
        for name, (numbers, expected) in rows.items()
    }


KINDS: dict[str, FaultKind] = (
    _kinds(
        "live",
        {
            "worker_killed": ("1", "restarted with new seeds; nothing stored twice; the learner hardly notices"),
            "all_workers_killed": ("2", "the learner waits at the limiter, then goes on"),
            "hang_in_step": ("3", "killed by the watchdog and replaced"),
            "hang_in_reset": ("3", "killed by the watchdog and replaced"),
            "straggler": ("4", "no barrier: only its own share is lost"),
            "shard_killed_without_snapshot": ("5", "sampling goes on with the rest; it begins empty"),
            "shard_killed": ("5", "sampling goes on with the rest; it loads its snapshot"),
            "all_shards_killed": ("6", "no update on too few steps; goes on once enough are stored"),
            "learner_killed": ("7", "goes on from the last checkpoint; versions upward"),
            "disk_full": ("12", "old checkpoint kept, no temporary file, training goes on, alert"),
            "nan_reward": ("16", "steps left out and counted, episode cut; none in replay"),
            "broken_environment": ("16", "more than 5 % of the steps: worker replaced"),
            "nan_gradient": ("17", "updates skipped and counted; parameters stay finite"),
            "diverged": ("17", "after 10 in a row back to the last checkpoint, half the rates"),
            "short_memory": ("20", "a worker stands still until there is room; nothing else is lost"),
            "weights_lost": ("21", "old version used; its age is right to 1 s"),
        },
    )
    | _kinds(
        "driver",
        {
            "preempted": ("11, 26", "last checkpoint, exit code 143, nothing left behind"),
            "driver_killed": ("8, 10", "no orphans; a resume goes on from the last checkpoint"),
            "interrupted_twice": ("8", "ends at once, no orphans"),
            "two_drivers": ("23", "the second is refused; a dead driver's lock is taken over"),
            "port_taken": ("22", "training unaffected"),
        },
    )
    | _kinds(
        "files",
        {
            "flipped_bits": ("13", "found by its hash and named; the one before is used"),
            "malicious_pickle": ("14", "refused before it is unpickled"),
            "other_config": ("15", "refused, hashes and shapes named"),
            "black_picture": ("16", "step left out and counted; none in the data"),
            "wrong_setting": ("18", "refused at once with the nearest field, exit code 2"),
            "missing_gpu": ("19", "explained, with the option that helps"),
            "missing_weights": ("24", "named at the start"),
        },
    )
)
"""Every fault by name."""

PLANS: dict[str, tuple[str, ...]] = {
    "short": (
        *("worker_killed", "hang_in_step", "learner_killed", "nan_reward", "nan_gradient", "disk_full"),
        *("flipped_bits", "malicious_pickle", "other_config", "black_picture"),
    ),
    "long": tuple(KINDS),
}
"""Named lists of faults: minutes for CI, and all of them."""


@dataclass(frozen=True, slots=True)
class FaultPlan:
    """Faults in the order in which they happen."""

    faults: tuple[PlannedFault, ...]
    seed: int

    @classmethod
    def draw(cls, names: Sequence[str], seed: int) -> "FaultPlan":
        """A plan of these faults: the same names and seed give the same plan.

        Raises:
            ValueError: an unknown fault (with the nearest known one), one named twice, none at all, a negative seed.
        """
        if not names:
            raise ValueError(f"no fault is named; known: {', '.join(KINDS)}")
        if seed < 0:
            raise ValueError(f"seed = {seed}: must be 0 or more")
        for name in names:
            if name not in KINDS:
                near = difflib.get_close_matches(name, KINDS, n=1)
                raise ValueError(
                    f"{name!r} is no fault; " + (f"did you mean {near[0]!r}?" if near else f"known: {', '.join(KINDS)}")
                )
        if len(set(names)) < len(names):
            raise ValueError(f"a fault is named twice: {', '.join(sorted(n for n in names if names.count(n) > 1))}")
        rng = np.random.default_rng(seed)
        faults = [
            PlannedFault(
                kind=KINDS[name],
                after_steps=int(rng.integers(FEWEST_STEPS, MOST_STEPS + 1)),
                seed=int(rng.integers(2**31)),
            )
            for name in np.array(sorted(names))[rng.permutation(len(names))].tolist()
        ]
        return cls(tuple(faults), seed)

    def of(self, scene: Scene) -> tuple[PlannedFault, ...]:
        """The faults of one scene, in order."""
        return tuple(fault for fault in self.faults if fault.kind.scene == scene)
