"""A shard's state on disk: written in pieces, complete or not there, and checked before it is used.

A directory holds one file for each large array, one for everything else and `manifest.json`, which names them with
their SHA-256. The manifest is renamed into place last; until then the old one and its files stay readable.
"""

import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from slotfilm_dist.atomic import TEMPORARY_SUFFIX, FileDigest, check_file, write_atomic
from slotfilm_dist.config import check
from slotfilm_dist.config_files import to_dict
from slotfilm_dist.replay.codec import DTYPES, decode, encode
from slotfilm_dist.replay.frozen import FrozenColumn
from slotfilm_dist.replay.schema import Column

MANIFEST = "manifest.json"
FORMAT = 1
"""Version of the layout on disk."""

LARGE_BYTES = 1 << 16
"""Arrays from this size on get a file of their own."""

LARGEST_REST = 1 << 28
"""Bytes that everything but the large arrays may take, and the manifest; a real one takes a few hundred kilobytes."""

_CHUNK_BYTES = 1 << 23
_PREFIX = "replay-"


def write_snapshot(directory: Path, state: Mapping[str, Any]) -> None:
    """Write a state of nested mappings, scalars and arrays; takes no memory beyond one chunk.

    Give it `ReplayShard.view()`, which copies nothing, or `ReplayShard.freeze()` while others go on inserting.

    Raises:
        OSError: the disk is full or not writable; the previous snapshot stays and nothing of the new one is left.
    """
    directory.mkdir(parents=True, exist_ok=True)
    generation, kept = _previous(directory)
    _remove_files(directory, kept)
    generation += 1
    arrays: dict[str, np.ndarray | FrozenColumn] = {}
    rest = _take_arrays(state, "", arrays)
    try:
        files: dict[str, FileDigest] = {}
        for path, array in arrays.items():
            name = f"{_PREFIX}{generation}-{path}.bin"
            files[name] = write_atomic(directory / name, _chunks(array))
        name = f"{_PREFIX}{generation}.msgpack"
        files[name] = write_atomic(directory / name, [encode(rest)])
        manifest = {
            "format": FORMAT,
            "generation": generation,
            "files": {name: to_dict(digest) for name, digest in files.items()},
            "arrays": {
                path: {"dtype": array.dtype.newbyteorder("<").str, "shape": array.shape}
                for path, array in arrays.items()
            },
        }
        write_atomic(directory / MANIFEST, [_signed(manifest)])
    except BaseException:
        _remove_files(directory, kept)
        raise
    _remove_files(directory, set(files))


def read_snapshot(directory: Path) -> dict[str, Any]:
    """The state written last; large arrays are mapped from their files, read-only, so copy them before the next write.

    Raises:
        ValueError: there is none, or a file is missing, cut short or altered; names the file.
    """
    manifest = _read_manifest(directory)
    files, arrays = _check_manifest(directory, manifest)
    for name, digest in files.items():
        check_file(directory / name, digest)
    prefix = f"{_PREFIX}{manifest['generation']}"
    path = directory / f"{prefix}.msgpack"
    try:
        state = decode(path.read_bytes())
        for name, column in arrays.items():
            *parents, leaf = name.split(".")
            owner = state
            for parent in parents:
                owner = owner[parent] if isinstance(owner, dict) else None
            if not isinstance(owner, dict) or leaf in owner:
                raise ValueError(f"there is no place for the array {name}")
            owner[leaf] = np.memmap(directory / f"{prefix}-{name}.bin", column.dtype, "r", shape=column.shape)
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is corrupt: {error}") from None
    if not isinstance(state, dict):
        raise ValueError(f"{path} is corrupt: it holds no mapping")
    return state


def _take_arrays(state: Mapping[str, Any], prefix: str, arrays: dict[str, np.ndarray | FrozenColumn]) -> dict[str, Any]:
    """The state without its large arrays, which are collected under their dotted path."""
    rest: dict[str, Any] = {}
    for key, value in state.items():
        check(key.isidentifier(), "state", prefix + key, "keys become file names and must be identifiers")
        if isinstance(value, np.ndarray | FrozenColumn) and value.nbytes >= LARGE_BYTES:
            arrays[prefix + key] = value
        elif isinstance(value, FrozenColumn):
            rest[key] = value.rows(0, value.shape[0])
        elif isinstance(value, Mapping):
            rest[key] = _take_arrays(value, f"{prefix}{key}.", arrays)
        else:
            rest[key] = value
    return rest


def _chunks(array: np.ndarray | FrozenColumn) -> Iterator[bytes]:
    """The array's bytes, little-endian, in order; a chunk is copied at a time."""
    num_rows = array.shape[0]
    rows = max(1, _CHUNK_BYTES * num_rows // array.nbytes)
    little = array.dtype.newbyteorder("<")
    for start in range(0, num_rows, rows):
        chunk = array.rows(start, start + rows) if isinstance(array, FrozenColumn) else array[start : start + rows]
        yield chunk.astype(little, copy=False).tobytes()


def _signed(manifest: dict[str, Any]) -> bytes:
    digest = hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()
    return json.dumps({"manifest": manifest, "sha256": digest}, indent=1).encode()


def _read_manifest(directory: Path) -> dict[str, Any]:
    path = directory / MANIFEST
    try:
        if path.stat().st_size > LARGEST_REST:
            raise ValueError("it is too large")
        content = json.loads(path.read_bytes())
        manifest, expected = content["manifest"], content["sha256"]
    except FileNotFoundError:
        raise ValueError(f"{path} is missing: {directory} holds no finished replay snapshot") from None
    except (ValueError, KeyError, TypeError, RecursionError) as error:
        raise ValueError(f"{path} is corrupt: {error!r}") from None
    if not isinstance(manifest, dict) or not manifest.keys() >= {"format", "generation", "files", "arrays"}:
        raise ValueError(f"{path} is corrupt: fields are missing")
    if hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest() != expected:
        raise ValueError(f"{path} is corrupt: its SHA-256 differs from the one it states")
    if manifest["format"] != FORMAT:
        raise ValueError(f"{path} has format {manifest['format']}, this version reads {FORMAT}")
    return manifest


def _check_manifest(directory: Path, manifest: Mapping[str, Any]) -> tuple[dict[str, FileDigest], dict[str, Column]]:
    """What the manifest says of each file and each array; raises ``ValueError`` unless one fits the other exactly."""
    path, generation = directory / MANIFEST, manifest["generation"]
    try:
        check(type(generation) is int and 0 < generation < 1 << 63, "generation", generation, "must be a number")
        files = {name: FileDigest(**digest) for name, digest in manifest["files"].items()}
        arrays = {name: _column(name, described) for name, described in manifest["arrays"].items()}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError) as error:
        raise ValueError(f"{path} is corrupt: {error}") from None
    rest = f"{_PREFIX}{generation}.msgpack"
    sizes = {f"{_PREFIX}{generation}-{name}.bin": column.num_bytes for name, column in arrays.items()}
    if files.keys() != {rest, *sizes}:
        raise ValueError(f"{path} is corrupt: its files and its arrays differ")
    for name, num_bytes in sizes.items():
        if files[name].num_bytes != num_bytes:
            raise ValueError(f"{path} is corrupt: {name} has not the size of its array")
    if not files[rest].num_bytes <= LARGEST_REST:
        raise ValueError(f"{path} is corrupt: {rest} is too large")
    return files, arrays


def _column(name: str, described: Mapping[str, Any]) -> Column:
    shape = described["shape"]
    check(all(part.isidentifier() for part in name.split(".")), "arrays", name, "must be identifiers and dots")
    check(described["dtype"] in DTYPES, f"arrays.{name}.dtype", described["dtype"], "must be a plain number's type")
    check(
        isinstance(shape, list) and all(type(n) is int and 0 < n < 1 << 48 for n in shape),
        *(f"arrays.{name}.shape", shape, "must be a list of sizes"),
    )
    check(math.prod(shape) < 1 << 48, f"arrays.{name}.shape", shape, "is impossible")
    return Column(shape=tuple(shape), dtype=np.dtype(described["dtype"]))


def _previous(directory: Path) -> tuple[int, set[str]]:
    """Generation and files of the last snapshot; one that cannot be read is not worth keeping."""
    try:
        manifest = _read_manifest(directory)
        files, _ = _check_manifest(directory, manifest)
    except ValueError:
        return 0, set()
    return manifest["generation"], set(files)


def _remove_files(directory: Path, kept: set[str]) -> None:
    """Delete what no finished snapshot needs: other generations and files cut off by a crash."""
    for path in directory.glob(f"{_PREFIX}*"):
        if path.name not in kept:
            path.unlink()
    (directory / (MANIFEST + TEMPORARY_SUFFIX)).unlink(missing_ok=True)
