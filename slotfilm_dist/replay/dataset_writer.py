"""Writes a `FrameDataset` block by block; a crash costs the last few blocks and never leaves a wrong dataset."""

import contextlib
import hashlib
import json
import os
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

import numpy as np

from slotfilm_dist.atomic import file_digest, write_atomic
from slotfilm_dist.config import check
from slotfilm_dist.config_files import to_dict
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.dataset import FORMAT, HEADER_BYTES, MANIFEST, PROGRESS, dataset_columns, npy_header
from slotfilm_dist.replay.schema import Column, ReplaySchema


class FrameDatasetWriter:
    """Appends blocks to the columns of a dataset; an interrupted one is continued where its last commit was.

    Every column is a `.npy` file whose header states 0 rows until `finish`. `progress.json` says how many rows count;
    what lies beyond them is cut off when writing goes on. `manifest.json` comes last and makes it a dataset.

        with FrameDatasetWriter(directory, schema, config_hash) as writer:
            while writer.num_steps < wanted:
                writer.append(loop.collect(32))
            writer.finish()

    Args:
        directory: created if missing.
        schema: pictures or no camera, with labels.
        config_hash: hash of the config fields that the frames depend on.
        commit_rows: rows after which all files are flushed to the disk; a crash costs at most so many.

    Raises:
        ValueError: the directory holds a finished dataset, or an unfinished one of another config or schema.
    """

    def __init__(self, directory: Path, schema: ReplaySchema, config_hash: str, *, commit_rows: int = 4096) -> None:
        check(commit_rows > 0, "commit_rows", commit_rows, "must be greater than 0")
        self._commit_rows = commit_rows
        self._directory = directory
        self._schema = schema
        self._columns = dataset_columns(schema)
        self._identity = {"format": FORMAT, "config_hash": config_hash, "schema": to_dict(schema)}
        directory.mkdir(parents=True, exist_ok=True)
        self.num_rows, self.num_steps, self.num_episodes = self._read_progress()
        self._committed_rows = self.num_rows
        self._episodes = _EpisodeNumbers(self.num_episodes)
        self._files = {name: self._open_column(name, column) for name, column in self._columns.items()}
        self._commit()

    def __enter__(self) -> "FrameDatasetWriter":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def append(self, block: TransitionBlock) -> None:
        """Add a block's rows.

        Raises:
            ValueError: the block does not fit the schema.
            OSError: the disk is full; what was committed stays, and a new writer continues from it.
        """
        self._schema.validate(block)
        values: dict[str, np.ndarray] = {
            name: getattr(block, "visual" if name == "rgb" else name) for name in self._columns if name != "episode"
        }
        values["episode"] = self._episodes.of_rows(block)
        for name, column in self._columns.items():
            self._files[name].write(values[name].astype(column.dtype, copy=False).tobytes())
        self.num_rows += block.num_rows
        self.num_steps += block.num_steps
        self.num_episodes = self._episodes.count
        if self.num_rows - self._committed_rows >= self._commit_rows:
            self._commit()

    def finish(self) -> None:
        """Complete the headers, compute the checksums and turn the directory into a dataset; closes the writer."""
        check(self.num_rows > 0, "num_rows", 0, "a dataset needs at least one block")
        for name, column in self._columns.items():
            self._files[name].seek(0)
            self._files[name].write(npy_header(column, self.num_rows))
        self._commit()
        self.close()
        manifest: dict[str, Any] = {
            **self._identity,
            "num_rows": self.num_rows,
            "num_steps": self.num_steps,
            "num_episodes": self.num_episodes,
            "files": {f"{name}.npy": to_dict(file_digest(self._directory / f"{name}.npy")) for name in self._columns},
        }
        write_atomic(self._directory / MANIFEST, [json.dumps(manifest, indent=1).encode()])
        (self._directory / PROGRESS).unlink()

    def close(self) -> None:
        """Close the files; what was appended since the last commit is given up unless `finish` was called."""
        with contextlib.ExitStack() as stack:
            for file in self._files.values():
                stack.callback(file.close)

    def _read_progress(self) -> tuple[int, int, int]:
        path = self._directory / PROGRESS
        if (self._directory / MANIFEST).exists():
            raise ValueError(f"{self._directory} is a finished dataset; open it, or delete it to collect again")
        if not path.exists():
            return 0, 0, 0
        try:
            progress = json.loads(path.read_bytes())
            identity, counts = progress["identity"], progress["counts"]
            rows, steps, episodes = counts["rows"], counts["steps"], counts["episodes"]
            for count in (rows, steps, episodes):
                check(type(count) is int and 0 <= count < 1 << 48, "counts", count, "must be a number of rows")
        except (ValueError, KeyError, TypeError, RecursionError) as error:
            raise ValueError(f"{path} is corrupt ({error!r}); delete {self._directory} and collect again") from None
        if identity != self._identity:
            raise ValueError(
                f"{self._directory} is an unfinished dataset of another config or schema "
                f"({identity} instead of {self._identity}); delete it or choose another directory"
            )
        return rows, steps, episodes

    def _open_column(self, name: str, column: Column) -> BinaryIO:
        path = self._directory / f"{name}.npy"
        size = HEADER_BYTES + self.num_rows * column.num_bytes
        if self.num_rows and (not path.exists() or path.stat().st_size < size):
            raise ValueError(f"{path} is shorter than {PROGRESS} says; delete {self._directory} and collect again")
        path.touch()
        file = path.open("r+b")
        file.write(npy_header(column, 0))
        file.truncate(size)
        file.seek(size)
        return file

    def _commit(self) -> None:
        for file in self._files.values():
            file.flush()
            os.fsync(file.fileno())
        counts = {"rows": self.num_rows, "steps": self.num_steps, "episodes": self.num_episodes}
        write_atomic(
            self._directory / PROGRESS, [json.dumps({"identity": self._identity, "counts": counts}, indent=1).encode()]
        )
        self._committed_rows = self.num_rows


class _EpisodeNumbers:
    """Numbers episodes across blocks: a run of steps that breaks off goes on where the same frame comes first again."""

    def __init__(self, count: int) -> None:
        self.count = count
        self._open: dict[tuple[int, int, bytes], int] = {}

    def of_rows(self, block: TransitionBlock) -> np.ndarray:
        """The episode of every row of a block, int32."""
        episodes = np.empty(block.num_rows, np.int32)
        went_on: dict[tuple[int, int, bytes], int] = {}
        start = 0
        for end in (np.flatnonzero(~block.is_step) + 1).tolist():
            episode = self._open.pop(_frame_key(block, start), None)
            if episode is None:
                episode, self.count = self.count, self.count + 1
            episodes[start:end] = episode
            ended = end - start >= 2 and bool(block.terminated[end - 2] or block.truncated[end - 2])
            if not ended:
                went_on[_frame_key(block, end - 1)] = episode
            start = end
        stale = [key for key in self._open if key[0] == block.worker_id and key[1] < block.incarnation]
        for key in stale:
            del self._open[key]
        self._open |= went_on
        return episodes


def _frame_key(block: TransitionBlock, row: int) -> tuple[int, int, bytes]:
    digest = hashlib.blake2b(digest_size=16)
    for column in (block.visual, block.proprio, block.goal):
        digest.update(column[row].tobytes())
    return block.worker_id, block.incarnation, digest.digest()
