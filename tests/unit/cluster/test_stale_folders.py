"""What a killed driver leaves of its private cluster is deleted by the next one."""

import os
import subprocess
import sys
from pathlib import Path

import psutil

from slotfilm_dist.cluster.session import OWNER_FILE, remove_stale_folders


def folder_of(parent: Path, name: str, owner: str) -> Path:
    folder = parent / f"slotfilm-{name}"
    folder.mkdir()
    (folder / OWNER_FILE).write_text(owner)
    (folder / "socket").touch()
    return folder


def test_only_folders_of_processes_that_are_gone_are_deleted(tmp_path: Path) -> None:
    child = subprocess.Popen([sys.executable, "-c", ""])
    child.wait()
    mine, started = os.getpid(), psutil.Process().create_time()
    gone = folder_of(tmp_path, "gone", f"{child.pid} {started}")
    reused = folder_of(tmp_path, "reused", f"{mine} {started - 100}")
    kept = [
        folder_of(tmp_path, "mine", f"{mine} {started}"),
        folder_of(tmp_path, "beginning", ""),
        folder_of(tmp_path, "strange", "x"),
    ]
    other = tmp_path / "slotfilm-other"
    other.mkdir()
    assert remove_stale_folders(tmp_path) == 2
    assert not gone.exists()
    assert not reused.exists()
    assert all(folder.exists() for folder in [*kept, other])
