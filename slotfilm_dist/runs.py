"""A run's directory: its config, versions, logs and checkpoints, and the lock that keeps it to one driver."""

import contextlib
import dataclasses
import importlib.metadata
import json
import os
import platform
import re
import shlex
import shutil
import socket
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import psutil
from filelock import FileLock, Timeout

from slotfilm_dist import __version__
from slotfilm_dist.atomic import append_whole, write_atomic
from slotfilm_dist.config import TEMPERATURE_FIELDS, RunConfig
from slotfilm_dist.config_files import changed_fields, save_config
from slotfilm_dist.messages import TrainingEpisode

PACKAGES = ("ray", "torch", "torchvision", "mani_skill", "sapien", "gymnasium", "numpy", "msgpack", "safetensors")
RUN_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
RESUMABLE = ("schedule.total_steps", "evaluation", "runtime", "checkpoint")
"""Sections and fields that may change when a run is resumed: budgets and places."""
BY_HAND = {"sac": ("lr", *(f"sac.{name}" for name in TEMPERATURE_FIELDS)), "ddpg": ("ddpg.lr",)}
"""Those of an algorithm that are annealed by hand, and may change too."""
FIXED = ("runtime.block_steps",)
"""Fields of those sections that may not: stored replay is cut into blocks of that size."""


def new_run_directory(root: Path, config: RunConfig, preset: str, name: str = "") -> Path:
    """A directory for a new run that does not exist yet.

    Raises:
        ValueError: the name has characters that a file name should not have, or such a run exists.
    """
    if name:
        if not RUN_NAME.fullmatch(name):
            raise ValueError(f"--name {name!r}: use letters, digits, '.', '_' and '-', at most 100 of them")
        if (root / name).exists():
            raise ValueError(f"{root / name} exists; choose another --name, or go on with --resume {root / name}")
        return root / name
    stem = f"{preset}-{config.variant}-s{config.seed}"
    number = 1
    while (root / f"{stem}-{number:03d}").exists():
        number += 1
    return root / f"{stem}-{number:03d}"


def resumed_config(path: Path, config: RunConfig, changed: RunConfig) -> RunConfig:
    """The changed config of a run that goes on; raises ``ValueError`` if it touches what was already learned from."""
    changes = changed_fields(config, changed)
    resumable = (*RESUMABLE, *BY_HAND[config.algorithm])
    fixed = [n for n in changes if n in FIXED or not {n, n.split(".")[0]} & {*resumable}]
    if fixed:
        raise ValueError(
            f"--resume {path}: {', '.join(fixed)} cannot change in a run that has begun; "
            f"only {', '.join(resumable)} can, without {', '.join(FIXED)}. Start a new run instead"
        )
    return changed


def refuse_if_held(path: Path) -> None:
    """Raise ``ValueError`` if another driver has this run, before anything is started for it."""
    if not (path / ".lock").exists():
        return
    try:
        with FileLock(path / ".lock").acquire(timeout=0):
            return
    except Timeout:
        raise ValueError(_in_use(path)) from None


class RunDirectory:
    """One run on disk, held by one driver at a time.

    Use it as a context manager: entering takes the lock, leaving gives it back; a driver that died has given it back.

    Args:
        path: the directory.
        config: of the run.
    """

    def __init__(self, path: Path, config: RunConfig) -> None:
        self.path = path
        self.config = config
        self._lock = FileLock(path / ".lock")
        self._unlogged: list[str] = []

    def __enter__(self) -> "RunDirectory":
        self.path.mkdir(parents=True, exist_ok=True)
        try:
            self._lock.acquire(timeout=0)
        except Timeout:
            raise ValueError(_in_use(self.path)) from None
        save_config(self.config, self.path / "config.json")
        self._write("owner.json", {"pid": os.getpid(), "host": socket.gethostname(), "since": _now()})
        if not (self.path / "versions.json").exists():
            self._write("versions.json", describe_machine())
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._lock.release()

    @property
    def checkpoints(self) -> Path:
        """Folder of the checkpoints."""
        return self.path / "checkpoints"

    @property
    def metrics(self) -> Path:
        """File of the metrics, one JSON object a line."""
        return self.path / "metrics.jsonl"

    def log_episodes(self, episodes: Iterable[TrainingEpisode]) -> None:
        """Append finished training episodes; those that the disk does not take go with the next."""
        for episode in episodes:
            own = {"env_steps": episode.env_steps, "policy_version": episode.policy_version}
            self._unlogged.append(json.dumps(dataclasses.asdict(episode.summary) | own) + "\n")
        with contextlib.suppress(OSError):
            append_whole(self.path / "episodes.jsonl", "".join(self._unlogged).encode())
            self._unlogged = []

    def room(self) -> dict[str, float]:
        """Resident memory of this process and those it started (what they share counts once for each); free disk."""
        process = psutil.Process()
        memory = 0
        for member in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):  # it may have ended since
                memory += member.memory_info().rss
        return {"run_memory_bytes": float(memory), "run_disk_free_bytes": float(shutil.disk_usage(self.path).free)}

    def read_status(self) -> dict[str, Any]:
        """How far the run has come: what `write_status` last wrote, empty before."""
        return self._read("status.json")

    def write_status(self, **values: Any) -> None:
        """Note how far the run has come."""
        self._write("status.json", values | {"written_at": _now()})

    def _read(self, name: str) -> dict[str, Any]:
        try:
            values = json.loads((self.path / name).read_text(encoding="utf-8"))
        except (FileNotFoundError, UnicodeDecodeError, json.JSONDecodeError):
            return {}
        return values if isinstance(values, dict) else {}

    def _write(self, name: str, values: dict[str, Any]) -> None:
        write_atomic(self.path / name, [json.dumps(values, indent=1).encode()])


def _in_use(path: Path) -> str:
    try:
        owner = json.loads((path / "owner.json").read_text(encoding="utf-8"))
    except (FileNotFoundError, UnicodeDecodeError, json.JSONDecodeError):
        owner = {}
    return (
        f"{path} is in use by process {owner.get('pid', '?')} on {owner.get('host', 'another machine')}; "
        "stop it first, or start a new run"
    )


def describe_machine() -> dict[str, Any]:
    """Versions, machine and command, for the record."""
    versions: dict[str, Any] = {"slotfilm_dist": __version__}
    for package in PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            versions[package] = "not installed"
    return versions | {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": f"{_cpu_model()}, {os.cpu_count()} cores",
        "gpu": _gpu_model(),
        "command": shlex.join(["slotfilm", *sys.argv[1:]]),
        "started_at": _now(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "unknown")


def _gpu_model() -> str:
    import torch

    return torch.cuda.get_device_name() if torch.cuda.is_available() else "none"


def _now() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
