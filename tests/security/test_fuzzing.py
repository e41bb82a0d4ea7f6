"""Thousands of corrupt files: each reader gives a value or one plain refusal, and never takes much memory."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).resolve().parent
EXAMPLES = {"codec": 3000, "snapshot": 1200, "dataset": 1000, "checkpoint": 1000}


@pytest.mark.parametrize("reader", EXAMPLES)
def test_corrupt_input_is_refused_with_little_memory(reader: str, tmp_path: Path) -> None:
    child = subprocess.run(
        [sys.executable, str(HERE / "fuzzing.py"), reader, str(tmp_path), str(EXAMPLES[reader])],
        cwd=HERE.parents[1],
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert child.returncode == 0, child.stdout[-3000:] + child.stderr[-6000:]
    outcomes = json.loads(child.stdout.splitlines()[-1])
    print(reader, outcomes)
    assert outcomes["refused"] > EXAMPLES[reader] // 3, outcomes
