"""The subjects of `slotfilm bench` and the command itself."""

import importlib.util
import json
from pathlib import Path

import pytest

from slotfilm_dist.__main__ import main
from slotfilm_dist.bench import contender
from slotfilm_dist.bench.results import BenchOptions
from slotfilm_dist.bench.suite import SUBJECTS, run_subject

ISSUE_SUBJECTS = ["render", "env", "attention", "learner", "replay", "runtime", "e2e", "pretrain", "scale", "gpu"]


def test_every_subject_has_a_module() -> None:
    assert list(SUBJECTS) == ISSUE_SUBJECTS
    for name in SUBJECTS:
        assert importlib.util.find_spec(f"slotfilm_dist.bench.{name}") is not None


def test_unknown_subject_names_the_nearest(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "atention"]) == 2
    assert "did you mean 'attention'?" in capsys.readouterr().err


def test_attention_row_is_measured_and_printed_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "attention", "--quick", "--rounds", "1", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)["results"]}
    difference = rows["attention/largest difference"]
    assert difference["holds"] is True
    assert 0 <= difference["measured"] < 1e-6
    assert rows["attention/forward against nn.MultiheadAttention"]["measured"] > 0


def test_without_the_peers_environment_the_rows_say_how_to_get_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(contender, "PEERS_PYTHON", tmp_path / "nothing")
    rows = [row for row in run_subject("e2e", BenchOptions(rounds=1, quick=True)) if row.goal is not None]
    assert [(row.measured, row.holds, row.goal) for row in rows] == [(None, None, 200.0), (None, None, 5.0)]
    assert all("make bench-peers" in row.how for row in rows)
