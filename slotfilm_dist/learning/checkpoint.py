"""Checkpoints on disk: tensors as safetensors, everything else as JSON, checked by hash before use. Never pickle."""

import hashlib
import json
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import safetensors
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors
from torch import Tensor

from slotfilm_dist.atomic import (
    RETIRED_SUFFIX,
    FileDigest,
    check_file,
    recover_directory,
    replace_directory,
    write_atomic,
)

FORMAT = 1
"""Raised when an older reader could misread what is written."""
TENSORS, MANIFEST = "tensors.safetensors", "manifest.json"
LARGEST_MANIFEST = 1 << 26
"""Bytes; a real one takes a few thousand."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Checkpoint:
    """What a directory of a checkpoint holds."""

    tensors: dict[str, Tensor]
    """Parameters, optimiser moments, generator states, by name."""
    values: dict[str, Any]
    """Counters and other plain values."""
    config_hash: str
    """Hash of the config that it continues."""


def write_checkpoint(directory: Path, checkpoint: Checkpoint) -> int:
    """Write a checkpoint; gives its size in bytes. The directory appears complete or not at all.

    Raises:
        OSError: the disk is full or may not be written; an older checkpoint of that name stays as it was.
    """
    with replace_directory(directory) as folder:
        digest = write_atomic(folder / TENSORS, [save_tensors(checkpoint.tensors)])
        manifest = {
            "format": FORMAT,
            "config_hash": checkpoint.config_hash,
            "tensors": {"num_bytes": digest.num_bytes, "sha256": digest.sha256},
            "values": checkpoint.values,
        }
        signed = manifest | {"sha256": _signature(manifest)}
        write_atomic(folder / MANIFEST, [json.dumps(signed, indent=1).encode()])
    return digest.num_bytes


def read_checkpoint(directory: Path, config_hash: str | None = None) -> Checkpoint:
    """Read a checkpoint back.

    Args:
        directory: where it lies.
        config_hash: hash of the config that will use it; None takes any.

    Raises:
        ValueError: it is missing, incomplete, altered, or belongs to another config; names the file.
    """
    manifest = _read_manifest(directory / MANIFEST)
    if config_hash is not None and manifest["config_hash"] != config_hash:
        raise ValueError(
            f"{directory}: was written by a run with config {manifest['config_hash']}, this one is {config_hash}; "
            "use the config.json beside it"
        )
    path = directory / TENSORS
    try:
        digest = FileDigest(**manifest["tensors"])
    except (TypeError, ValueError):
        raise ValueError(f"{directory / MANIFEST}: damaged, it does not describe {TENSORS}") from None
    check_file(path, digest)
    try:
        tensors = load_tensors(path.read_bytes())
    except (safetensors.SafetensorError, RuntimeError, ValueError, TypeError, KeyError, OverflowError) as error:
        raise ValueError(f"{path}: not a safetensors file ({error})") from None
    return Checkpoint(tensors=tensors, values=manifest["values"], config_hash=manifest["config_hash"])


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > LARGEST_MANIFEST:
            raise ValueError("it is too large")
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist: {path.parent} is no checkpoint") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: damaged ({error})") from None
    if not isinstance(manifest, dict) or not manifest.keys() >= {"format", "config_hash", "tensors", "values"}:
        raise ValueError(f"{path}: damaged, fields are missing")
    if not isinstance(manifest["values"], dict) or not isinstance(manifest["config_hash"], str):
        raise ValueError(f"{path}: damaged, fields have another type")
    if (stated := manifest.pop("sha256", None)) is None:
        raise ValueError(f"{path}: damaged, it does not state its own SHA-256")
    if stated != _signature(manifest):
        raise ValueError(f"{path}: damaged, its SHA-256 differs from the one it states")
    if manifest["format"] != FORMAT:
        raise ValueError(f"{path}: written in format {manifest['format']}, this version reads {FORMAT}")
    return manifest


def _signature(manifest: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(manifest, sort_keys=True).encode()).hexdigest()


class CheckpointStore:
    """The checkpoints of one run: the last few by number of updates, and `best`.

    Args:
        folder: where they lie.
        keep: how many to keep beside `best`.
    """

    def __init__(self, folder: Path, keep: int) -> None:
        self.folder = folder
        self._keep = keep

    def write(self, checkpoint: Checkpoint, updates: int) -> int:
        """Write one, drop the oldest ones beyond `keep` and those that the run went back behind; gives its size."""
        own = self.folder / f"updates-{updates:09d}"
        size = write_checkpoint(own, checkpoint)
        there = self._numbered()
        until_now = [path for path in there if path.name <= own.name]
        for path in (*until_now[: -self._keep], *there[len(until_now) :]):
            shutil.rmtree(path, ignore_errors=True)
        return size

    def write_best(self, checkpoint: Checkpoint) -> int:
        """Replace `best`; gives its size in bytes."""
        return write_checkpoint(self.folder / "best", checkpoint)

    def best_values(self) -> dict[str, Any]:
        """The plain values of `best`; empty where there is none that can be used."""
        try:
            return _read_manifest(self.folder / "best" / MANIFEST)["values"]
        except (ValueError, OSError):
            return {}

    def read_last(self, config_hash: str, *, strict: bool = False) -> tuple[Checkpoint, list[str]] | None:
        """The newest readable checkpoint and what was wrong with newer ones; None if there is none at all.

        Args:
            config_hash: hash of the config that will use it.
            strict: refuse to go back to an older one.

        Raises:
            ValueError: checkpoints are there, but none can be used.
        """
        problems: list[str] = []
        for directory in reversed(self._numbered()):
            try:
                return read_checkpoint(directory, config_hash), problems
            except ValueError as error:
                problems.append(str(error))
                if strict:
                    raise ValueError(f"{error}; --checkpoint.no_strict goes back to an older one") from None
        if problems:
            raise ValueError("no checkpoint can be used: " + "; ".join(problems))
        return None

    def _numbered(self) -> list[Path]:
        for moved_aside in self.folder.glob(f"updates-*{RETIRED_SUFFIX}"):
            recover_directory(moved_aside.with_name(moved_aside.name.removesuffix(RETIRED_SUFFIX)))
        return sorted(path for path in self.folder.glob("updates-*") if path.name[8:].isdigit())


def plain_tensors(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Detached, contiguous copies on the CPU, as safetensors takes them."""
    return {name: value.detach().cpu().clone().contiguous() for name, value in tensors.items()}
