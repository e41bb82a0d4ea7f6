"""The random policy's frames as a directory of columns, read through memory maps and shared by many trials."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int32, UInt8

from slotfilm_dist.atomic import FileDigest, check_file
from slotfilm_dist.config import check
from slotfilm_dist.config_files import from_dict
from slotfilm_dist.messages import TransitionBlock
from slotfilm_dist.replay.schema import Column, ReplaySchema

MANIFEST = "manifest.json"
PROGRESS = "progress.json"
FORMAT = 2
"""Version of the layout on disk."""
HEADER_BYTES = 256
"""Size of a column's `.npy` header."""

_LARGEST_MANIFEST = 1 << 20

EPISODE_COLUMN = Column(shape=(), dtype=np.dtype(np.int32))
DATASET_WORKER_ID = -1
"""Worker id of blocks that were read from a dataset, which no worker has."""

RewardOf = Callable[[Float32[np.ndarray, "rows inputs"]], Float32[np.ndarray, " rows"]]
"""Computes a run's own reward from the reward's inputs."""


def dataset_columns(schema: ReplaySchema) -> dict[str, Column]:
    """The files of a dataset, by name without `.npy`: the schema's columns, the picture's called `rgb`, and `episode`.

    Where the reward's inputs are stored the reward is not: it is another one for every config that shares the dataset.

    Raises:
        ValueError: the schema stores tokens, which would tie the frames to one backbone, or no labels.
    """
    check(schema.visual_kind != "tokens", "schema.visual_kind", schema.visual_kind, "a dataset keeps pictures")
    check(schema.store_labels, "schema.store_labels", False, "a dataset is for pre-training, which needs the labels")
    columns = {("rgb" if name == "visual" else name): column for name, column in schema.columns.items()}
    if schema.num_reward_inputs:
        del columns["reward"]
    return columns | {"episode": EPISODE_COLUMN}


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameDataset:
    """Rows laid out as in a `TransitionBlock`: a frame and, where `is_step` is set, the step taken from it.

    All arrays are read-only maps of the files: index them, do not load them whole.
    """

    schema: ReplaySchema
    """Shapes and types."""
    config_hash: str
    """Hash of the config fields that the frames depend on."""
    num_steps: int
    """Rows with a step."""
    num_episodes: int
    """Distinct values of `episode`."""
    rgb: UInt8[np.ndarray, "rows *visual"]
    """Pictures [rows, height, width, 3], or [rows, 0] without a camera."""
    proprio: Float32[np.ndarray, "rows proprio"]
    goal: Float32[np.ndarray, "rows 3"]
    uv: Float32[np.ndarray, "rows objects 2"]
    visible: Bool[np.ndarray, "rows objects"]
    action: Float32[np.ndarray, "rows action"]
    terminated: Bool[np.ndarray, " rows"]
    truncated: Bool[np.ndarray, " rows"]
    is_step: Bool[np.ndarray, " rows"]
    episode: Int32[np.ndarray, " rows"]
    """Episode of the row, from 0; rows of one episode may lie apart. Split train from test by it, not by rows."""
    reward: Float32[np.ndarray, " rows"] | None = None
    """Unscaled reward, where the environment brings its own; None where `reward_inputs` are stored instead."""
    reward_inputs: Float32[np.ndarray, "rows inputs"] | None = None
    """What each run computes its own reward from; zeros in rows without a step."""

    @property
    def num_rows(self) -> int:
        """Frames held; a frame between two blocks is held twice."""
        return len(self.is_step)

    def blocks(self, rows: int, reward_of: RewardOf | None = None) -> Iterator[TransitionBlock]:
        """Everything in order, in blocks of at most `rows` rows where the layout allows, for filling replay.

        Blocks end where a row holds no step, so a longer run of steps gives a longer block. Their arrays are views of
        the files. Replace `visual` and `backbone_hash` with a backbone's tokens where replay holds those.

        Args:
            rows: most rows of a block.
            reward_of: the run's reward; needed where the dataset holds `reward_inputs`, unused elsewhere.

        Raises:
            ValueError: no `reward_of` where one is needed.
        """
        check(rows > 0, "rows", rows, "must be greater than 0")
        if self.reward is None and reward_of is None:
            raise ValueError("reward_of: this dataset holds the reward's inputs; say how the reward follows from them")
        ends = np.flatnonzero(~self.is_step) + 1
        start = sequence = 0
        while start < self.num_rows:
            reachable = int(np.searchsorted(ends, start + rows, side="right"))
            first = int(np.searchsorted(ends, start, side="right"))
            end = int(ends[max(reachable - 1, first)])
            yield self._block(slice(start, end), sequence, reward_of)
            start, sequence = end, sequence + 1

    def _block(self, span: slice, sequence: int, reward_of: RewardOf | None) -> TransitionBlock:
        return TransitionBlock(
            worker_id=DATASET_WORKER_ID,
            incarnation=0,
            sequence=sequence,
            policy_version=-1,
            backbone_hash="",
            visual=self.rgb[span],
            proprio=self.proprio[span],
            goal=self.goal[span],
            uv=self.uv[span],
            visible=self.visible[span],
            action=self.action[span],
            reward=self._rewards(span, reward_of),
            terminated=self.terminated[span],
            truncated=self.truncated[span],
            is_step=self.is_step[span],
        )

    def _rewards(self, span: slice, reward_of: RewardOf | None) -> Float32[np.ndarray, " rows"]:
        if self.reward is not None:
            return self.reward[span]
        assert self.reward_inputs is not None, "a dataset holds one of the two"
        assert reward_of is not None, "asked for before the first block"
        return np.where(self.is_step[span], reward_of(self.reward_inputs[span]), np.float32(0))


def open_dataset(directory: Path, expect_hash: str, *, verify: bool = True) -> FrameDataset:
    """Open a finished dataset.

    Args:
        directory: where `FrameDatasetWriter` wrote it.
        expect_hash: hash of the config fields it must have been made with.
        verify: compare every file's SHA-256 (about a second per gigabyte), not only its size.

    Raises:
        ValueError: it does not exist, is unfinished, altered, or made with another config; names the file and the fix.
    """
    manifest = _read_manifest(directory)
    if manifest.get("config_hash") != expect_hash:
        raise ValueError(
            f"{directory} was made with config {manifest.get('config_hash')}, this run needs {expect_hash}; "
            "collect a dataset of its own for this run"
        )
    try:
        schema = from_dict(ReplaySchema, manifest["schema"], "schema.")
        counts = {name: manifest[name] for name in ("num_rows", "num_steps", "num_episodes")}
        for name, count in counts.items():
            check(type(count) is int and 0 <= count < 1 << 48, name, count, "must be a number of rows")
        columns = dataset_columns(schema)
        digests = {name: FileDigest(**manifest["files"][f"{name}.npy"]) for name in columns}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(
            f"{directory / MANIFEST} is corrupt: {error}; delete the directory and collect again"
        ) from None
    arrays: dict[str, Any] = {}
    for name, column in columns.items():
        path = directory / f"{name}.npy"
        check_file(path, digests[name], content=verify)
        arrays[name] = _open_column(path, column, counts["num_rows"])
    _check_rows(directory, arrays, counts)
    return FrameDataset(
        schema=schema,
        config_hash=expect_hash,
        num_steps=counts["num_steps"],
        num_episodes=counts["num_episodes"],
        **arrays,
    )


def _read_manifest(directory: Path) -> dict[str, Any]:
    path = directory / MANIFEST
    try:
        if path.stat().st_size > _LARGEST_MANIFEST:
            raise ValueError("it is too large")
        manifest = json.loads(path.read_bytes())
    except FileNotFoundError:
        if (directory / PROGRESS).exists():
            raise ValueError(f"{directory} is an unfinished dataset; collect again to continue it") from None
        raise ValueError(f"{path} does not exist: {directory} is not a dataset") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is corrupt: {error}; delete the directory and collect again") from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{path} is not a manifest of format {FORMAT}; delete the directory and collect again")
    return manifest


def _open_column(path: Path, column: Column, num_rows: int) -> np.ndarray:
    shape = (num_rows, *column.shape)
    if 0 in shape:
        return np.empty(shape, column.dtype)  # an empty file cannot be mapped
    # The header is compared and not read: only one is right, and numpy's reader of headers can fail in many ways.
    with path.open("rb") as file:
        header = file.read(HEADER_BYTES)
    if header != npy_header(column, num_rows) or path.stat().st_size != HEADER_BYTES + num_rows * column.num_bytes:
        raise ValueError(f"{path} does not hold {column.dtype} {shape}, as the manifest says; collect again")
    return np.memmap(path, column.dtype, "r", offset=HEADER_BYTES, shape=shape)


def npy_header(column: Column, num_rows: int) -> bytes:
    """A version 1.0 `.npy` header of a fixed size, so that the number of rows can be filled in at the end."""
    fields = {"descr": column.dtype.str, "fortran_order": False, "shape": (num_rows, *column.shape)}
    prefix = b"\x93NUMPY\x01\x00" + (HEADER_BYTES - 10).to_bytes(2, "little")
    return prefix + repr(fields).encode("latin1").ljust(HEADER_BYTES - 11) + b"\n"


def _check_rows(directory: Path, arrays: Mapping[str, np.ndarray], counts: Mapping[str, int]) -> None:
    """Raise ``ValueError`` where the columns and the manifest's numbers contradict each other."""
    is_step, episode = arrays["is_step"], arrays["episode"]
    if counts["num_rows"] == 0 or bool(is_step[-1]) or int(np.count_nonzero(is_step)) != counts["num_steps"]:
        raise ValueError(f"{directory} is corrupt: its steps are not those that the manifest counts; collect again")
    if episode.min() < 0 or episode.max() >= counts["num_episodes"]:
        raise ValueError(f"{directory} is corrupt: its episodes are not those that the manifest counts; collect again")
