"""A ring's rows as they were at one instant, read piece by piece while new rows come in."""

import threading
from collections.abc import Mapping

import numpy as np
from jaxtyping import Shaped


class FrozenRows:
    """Keeps what inserts are about to overwrite; everything else is read from the ring itself.

    Inserts go on from the row number at which the ring was frozen, in ascending order, so each old row is overwritten
    once, and its values are kept then. This takes memory for the rows that come in while this object is used, not for
    the ring.

    Args:
        columns: of the ring.
        next_row: number of the next row.
        lock: held by whoever inserts, and taken here for every read; not held by the caller of `FrozenColumn.rows`.
    """

    def __init__(self, columns: Mapping[str, np.ndarray], next_row: int, lock: threading.Lock) -> None:
        self._live, self._next_row, self._lock = columns, next_row, lock
        self._num_slots = len(next(iter(columns.values())))
        self._used = min(next_row, self._num_slots)
        self._kept: list[tuple[int, dict[str, np.ndarray]]] = []
        self.columns = {name: FrozenColumn(self, name, column[: self._used]) for name, column in columns.items()}

    def keep(self, row: int, num_rows: int) -> None:
        """Rows from number `row` on are about to be written; the caller holds the lock."""
        begin, end = row - self._next_row, min(row - self._next_row + num_rows, self._num_slots)
        slot = (self._next_row + begin) % self._num_slots
        head = min(max(0, end - begin), self._num_slots - slot)
        for first, last in ((slot, slot + head), (0, end - begin - head)):
            last = min(last, self._used)
            if first < last:
                self._kept.append((first, {name: column[first:last].copy() for name, column in self._live.items()}))

    def read(self, name: str, start: int, stop: int) -> Shaped[np.ndarray, "rows ..."]:
        """A copy of rows of one column as they were."""
        with self._lock:
            rows = self._live[name][start:stop].copy()
            for first, columns in self._kept:
                old = columns[name]
                begin, end = max(first, start), min(first + len(old), stop)
                if begin < end:
                    rows[begin - start : end - start] = old[begin - first : end - first]
        return rows


class FrozenColumn:
    """One column of `FrozenRows`: what `snapshot.write_snapshot` needs to know of an array that it reads in pieces."""

    def __init__(self, owner: FrozenRows, name: str, like: np.ndarray) -> None:
        self._owner, self._name = owner, name
        self.shape, self.dtype, self.nbytes = like.shape, like.dtype, like.nbytes

    def rows(self, start: int, stop: int) -> Shaped[np.ndarray, "rows ..."]:
        """A copy of some rows; `stop` may lie beyond the end."""
        return self._owner.read(self._name, start, min(stop, self.shape[0]))
