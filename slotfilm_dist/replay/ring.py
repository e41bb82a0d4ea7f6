"""Preallocated storage of rows: inserts overwrite the oldest steps, draws are uniform over the stored ones."""

import math
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64

from slotfilm_dist.config import check
from slotfilm_dist.messages import SampleBatch, TransitionBlock
from slotfilm_dist.replay.frozen import FrozenRows
from slotfilm_dist.replay.schema import ReplaySchema

STEPS_PER_EPISODE_END = 200
"""One spare row per so many steps is kept for true last frames; enough for episodes at least this long."""


@dataclass(kw_only=True, slots=True)
class SampleTotals:
    """Sums over everything ever drawn; differences between two readings give means."""

    num_steps: int = 0
    """Steps drawn."""
    age_steps: int = 0
    """Sum of their ages: steps of this ring inserted since."""
    policy_version: int = 0
    """Sum of the versions of the policies that collected them."""


class RowRing:
    """A ring of rows and, beside it, a ring of the row numbers of the steps.

    Rows and steps are numbered from 0 in order of arrival and never renumbered: row r lies at `r % num_rows` of every
    column, step s has its row number at `s % capacity_steps`. A step is stored while its own row is; because rows are
    overwritten in ascending order and no block ends with a step, its next frame is stored then too.

    Memory: `capacity_steps` steps in blocks of `block_steps` need one row a step, one more a block and one more an
    episode. So many rows are allocated (touched only as they fill). Shorter blocks or episodes take more rows, and then
    the oldest steps go before `capacity_steps` is reached; `num_steps` is exact in any case.

    With `n_step` above 1 a drawn step is joined with those after it: rewards are added up, discounted by `gamma`, and
    the next frame is the one after the last of them. Fewer are joined where the episode or the block ends.
    """

    def __init__(
        self, schema: ReplaySchema, capacity_steps: int, block_steps: int = 32, *, n_step: int = 1, gamma: float = 1.0
    ) -> None:
        check(capacity_steps > 0, "capacity_steps", capacity_steps, "must be greater than 0")
        check(block_steps > 0, "block_steps", block_steps, "must be greater than 0")
        check(n_step > 0, "n_step", n_step, "must be greater than 0")
        self._n_step, self._gamma = n_step, gamma
        self.schema = schema
        self.capacity_steps = capacity_steps
        self.num_rows = ring_rows(capacity_steps, block_steps)
        self._columns = {
            name: np.empty((self.num_rows, *column.shape), column.dtype) for name, column in schema.columns.items()
        }
        self._step_rows = np.empty(capacity_steps, np.int64)
        self._step_versions = np.empty(capacity_steps, np.int32)
        self._next_row = 0
        self._first_step = 0
        self._next_step = 0
        self._frozen: FrozenRows | None = None
        self.drawn = SampleTotals()

    @property
    def num_steps(self) -> int:
        """Steps stored now."""
        return self._next_step - self._first_step

    @property
    def ring_bytes(self) -> int:
        """Memory of the full ring."""
        return self.num_rows * self.schema.row_bytes + self._step_rows.nbytes + self._step_versions.nbytes

    def insert(self, block: TransitionBlock) -> None:
        """Store a valid block over the oldest rows; of one larger than the ring only the newest steps."""
        skipped = max(0, block.num_rows - self.num_rows)
        new_steps = np.flatnonzero(block.is_step[skipped:])[-self.capacity_steps :] + self._next_row
        num_rows = block.num_rows - skipped
        self._forget(oldest_row=self._next_row + num_rows - self.num_rows, num_new_steps=len(new_steps))
        start = self._next_row % self.num_rows
        head = min(num_rows, self.num_rows - start)
        if self._frozen is not None:
            self._frozen.keep(self._next_row, num_rows)
        for name, column in self._columns.items():
            value = getattr(block, name)[skipped:]
            column[start : start + head] = value[:head]
            column[: num_rows - head] = value[head:]
        slots = np.arange(self._next_step, self._next_step + len(new_steps)) % self.capacity_steps
        self._step_rows[slots] = new_steps
        self._step_versions[slots] = block.policy_version
        self._next_row += num_rows
        self._next_step += len(new_steps)

    def _forget(self, *, oldest_row: int, num_new_steps: int) -> None:
        """Drop the steps whose rows come before `oldest_row`, and as many as the new ones need."""
        self._first_step = max(self._first_step, self._next_step + num_new_steps - self.capacity_steps)
        # Rows of the stored steps ascend from the first one, so the number to drop is found by bisection.
        low, high = self._first_step, self._next_step
        while low < high:
            middle = (low + high) // 2
            if self._step_rows[middle % self.capacity_steps] < oldest_row:
                low = middle + 1
            else:
                high = middle
        self._first_step = low

    def sample(self, rng: np.random.Generator, sizes: Sequence[int]) -> list[SampleBatch]:
        """Draw one batch of each size, with replacement, every stored step equally likely.

        One gather serves all batches; a batch's arrays are slices of it and share memory with nothing else.
        """
        if self.num_steps == 0:
            raise ValueError("replay is empty: insert a block before sampling")
        steps = rng.integers(self._first_step, self._next_step, size=sum(sizes))
        slots = steps % self.capacity_steps
        self.drawn.num_steps += len(steps)
        self.drawn.age_steps += int((self._next_step - 1 - steps).sum())
        self.drawn.policy_version += int(self._step_versions[slots].sum(dtype=np.int64))
        rows = self._step_rows[slots] % self.num_rows
        return self._gather(rows, sizes)

    def _gather(self, rows: Int64[np.ndarray, " total"], sizes: Sequence[int]) -> list[SampleBatch]:
        reward, discount, last_rows = self._returns(rows)
        next_rows = (last_rows + 1) % self.num_rows
        ends = np.cumsum(sizes)
        parts = [
            part
            for end, size in zip(ends, sizes, strict=True)
            for part in (rows[end - size : end], next_rows[end - size : end])
        ]
        frame_rows = np.concatenate(parts) if parts else rows
        frames = {name: self._columns[name].take(frame_rows, axis=0) for name in ("visual", "proprio", "goal")}
        steps = {
            "action": self._columns["action"].take(rows, axis=0),
            "reward": reward,
            "discount": discount,
            "terminated": self._columns["terminated"].take(last_rows),
            "truncated": self._columns["truncated"].take(last_rows),
        }
        batches: list[SampleBatch] = []
        for end, size in zip(ends, sizes, strict=True):
            now, after = slice(2 * (end - size), 2 * end - size), slice(2 * end - size, 2 * end)
            batches.append(
                SampleBatch(
                    visual=frames["visual"][now],
                    proprio=frames["proprio"][now],
                    goal=frames["goal"][now],
                    next_visual=frames["visual"][after],
                    next_proprio=frames["proprio"][after],
                    next_goal=frames["goal"][after],
                    **{name: column[end - size : end] for name, column in steps.items()},
                )
            )
        return batches

    def _returns(
        self, rows: Int64[np.ndarray, " total"]
    ) -> tuple[Float32[np.ndarray, " total"], Float32[np.ndarray, " total"], Int64[np.ndarray, " total"]]:
        """Discounted sums of rewards from each row on, discounts of what follows, and the rows of the last steps."""
        last_rows = rows
        reward = self._columns["reward"].take(rows)
        discount = np.full(len(rows), self._gamma, np.float32)
        going = np.ones(len(rows), np.bool_)
        for ahead in range(1, self._n_step):
            # An ended episode and a block are followed by a row without a step, so no sum reaches beyond either.
            following = (rows + ahead) % self.num_rows
            going &= self._columns["is_step"].take(following)
            reward = np.where(going, reward + discount * self._columns["reward"].take(following), reward)
            discount = np.where(going, discount * np.float32(self._gamma), discount)
            last_rows = np.where(going, following, last_rows)
        return reward, discount, last_rows

    def view(self) -> dict[str, Any]:
        """The state without copying: arrays are read-only views that hold only until the next insert."""
        used_rows, used_steps = min(self._next_row, self.num_rows), min(self._next_step, self.capacity_steps)
        state: dict[str, Any] = {
            "capacity_steps": self.capacity_steps,
            "num_rows": self.num_rows,
            "next_row": self._next_row,
            "first_step": self._first_step,
            "next_step": self._next_step,
            "step_rows": self._step_rows[:used_steps],
            "step_versions": self._step_versions[:used_steps],
            "columns": {name: column[:used_rows] for name, column in self._columns.items()},
            "drawn": asdict(self.drawn),
        }
        for array in (state["step_rows"], state["step_versions"], *state["columns"].values()):
            array.flags.writeable = False
        return state

    def freeze(self, lock: threading.Lock) -> dict[str, Any]:
        """The state of `view`, but it holds until `thaw` whatever is inserted; `lock` is held here and by each insert.

        Its columns are `FrozenColumn`s, read in pieces without the lock; only what is small is copied here.
        """
        assert self._frozen is None, "thaw comes first"
        state = self.view()
        self._frozen = FrozenRows(self._columns, self._next_row, lock)
        return state | {
            "step_rows": state["step_rows"].copy(),
            "step_versions": state["step_versions"].copy(),
            "columns": self._frozen.columns,
        }

    def thaw(self) -> None:
        """Nobody reads the frozen state any more."""
        self._frozen = None

    def load(self, state: Mapping[str, Any]) -> None:
        """Take over a saved state, copying its arrays; raises ``ValueError`` if it is of another size or schema."""
        self._check_state(state)
        self.drawn = SampleTotals(**{f.name: state["drawn"][f.name] for f in fields(SampleTotals)})
        self._next_row, self._first_step, self._next_step = (
            state["next_row"],
            state["first_step"],
            state["next_step"],
        )
        self._step_rows[: len(state["step_rows"])] = state["step_rows"]
        self._step_versions[: len(state["step_versions"])] = state["step_versions"]
        for name, column in self._columns.items():
            column[: len(state["columns"][name])] = state["columns"][name]

    def _check_state(self, state: Mapping[str, Any]) -> None:
        for name in ("capacity_steps", "num_rows"):
            mine, saved = getattr(self, name), state[name]
            check(saved == mine, f"ring.{name}", saved, f"this ring has {mine}; resume with the replay size it had")
        for name, total in ((field.name, state["drawn"][field.name]) for field in fields(SampleTotals)):
            check(type(total) is int, f"ring.drawn.{name}", total, "must be a whole number")
        next_row, first_step, next_step = (
            whole_number(state, name, "ring.") for name in ("next_row", "first_step", "next_step")
        )
        check(0 <= first_step <= next_step <= next_row, "ring.next_step", next_step, "the counters contradict another")
        check(next_step - first_step <= self.capacity_steps, "ring.first_step", first_step, "holds more than fits")
        used_rows, used_steps = min(next_row, self.num_rows), min(next_step, self.capacity_steps)
        _check_array(state["step_rows"], self._step_rows[:used_steps], "ring.step_rows")
        _check_array(state["step_versions"], self._step_versions[:used_steps], "ring.step_versions")
        check(set(state["columns"]) == set(self._columns), "ring.columns", sorted(state["columns"]), "other columns")
        for name, column in self._columns.items():
            _check_array(state["columns"][name], column[:used_rows], f"ring.columns.{name}")
        stored = state["step_rows"][np.arange(first_step, next_step) % self.capacity_steps]
        ascending = bool((np.diff(stored) > 0).all())
        inside = bool((stored >= max(0, next_row - self.num_rows)).all() and (stored < next_row - 1).all())
        check(ascending and inside, "ring.step_rows", len(stored), "step rows out of order or outside the ring")


def whole_number(state: Mapping[str, Any], name: str, where: str = "") -> int:
    """A saved counter; raises ``ValueError`` if it is no whole number from 0 on."""
    check(type(state[name]) is int and state[name] >= 0, where + name, state[name], "must be a whole number, 0 or more")
    return state[name]


def ring_rows(capacity_steps: int, block_steps: int) -> int:
    """Rows allocated for so many steps in blocks of `block_steps`."""
    return capacity_steps + math.ceil(capacity_steps / block_steps + capacity_steps / STEPS_PER_EPISODE_END) + 1


def _check_array(saved: Any, mine: np.ndarray, name: str) -> None:
    ok = isinstance(saved, np.ndarray) and saved.shape == mine.shape and saved.dtype == mine.dtype
    described = f"{saved.dtype} {saved.shape}" if isinstance(saved, np.ndarray) else type(saved).__name__
    check(ok, name, described, f"expected {mine.dtype} {mine.shape}")
