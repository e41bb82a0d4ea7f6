"""The set-up script, as far as it goes without a network."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PYTHONS = [sys.executable, *filter(None, map(shutil.which, ("python3.11", "python3.12")))]


def runs(python: str) -> bool:
    """Whether it is a Python that the project takes; a version manager's name may stand for none."""
    asked = "import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))"
    return subprocess.run([python, "-c", asked], capture_output=True).returncode == 0


@pytest.mark.parametrize("python", [python for python in dict.fromkeys(PYTHONS) if runs(python)])
@pytest.mark.parametrize("folder", ["copy", "a copy"])
def test_set_up_knows_a_virtual_environment_of_its_folder_and_keeps_what_is_in_it(
    tmp_path: Path, python: str, folder: str
) -> None:
    copy = tmp_path / folder
    shutil.copytree(ROOT / "ops", copy / "ops", ignore=shutil.ignore_patterns("results"))
    shutil.copy(ROOT / "pyproject.toml", copy)
    subprocess.run([python, "-m", "venv", "--without-pip", ".venv"], cwd=copy, check=True)
    (copy / ".venv" / "of_the_user").touch()
    answer = subprocess.run(["bash", "ops/setup.sh"], cwd=copy, capture_output=True, text=True, timeout=60)
    assert "pip could not install" in answer.stderr  # it got that far, and there is no pip
    assert (copy / ".venv" / "of_the_user").exists()


def test_virtual_environment_of_another_folder_is_not_taken(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "ops", tmp_path / "ops", ignore=shutil.ignore_patterns("results"))
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "elsewhere" / ".venv"], check=True)
    shutil.copytree(tmp_path / "elsewhere" / ".venv", tmp_path / ".venv", symlinks=True)
    answer = subprocess.run(["bash", "ops/setup.sh"], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert answer.returncode == 1
    assert "not a working virtual environment of this folder" in answer.stderr
