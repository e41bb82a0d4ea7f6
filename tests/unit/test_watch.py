"""`slotfilm watch` follows a metrics file that is still being written."""

import json
from pathlib import Path

import pytest

from slotfilm_dist.commands.watch import MetricsFile, main


def test_newest_value_of_each_metric_is_kept_and_a_half_written_line_waits(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    metrics = MetricsFile(path)
    metrics.read()
    assert metrics.values == {}
    path.write_text('{"env_steps": 1, "learner_q_mean": 2.0}\n{"env_steps": 5, "learner_q_')
    metrics.read()
    assert metrics.values == {"env_steps": 1, "learner_q_mean": 2.0}
    with path.open("a") as file:
        file.write('mean": 3.0}\nnot json\n{"env_steps": 6, "learner_q_mean": null}\n')
    metrics.read()
    assert metrics.values == {"env_steps": 6, "learner_q_mean": 3.0}


@pytest.mark.parametrize(
    "odd",
    [
        '{"env_steps": NaN, "learner_q_mean": Infinity}',
        '{"time_s": "x", "phase": 3, "learner_q_mean": "high"}',
        '{"a_metric_of_tomorrow": 1.0}',
        "[" * 100_000,
        '{"env_steps": ' + "9" * 5000 + "}",
        "[1]",
    ],
)
def test_odd_line_changes_nothing_and_the_next_is_read(tmp_path: Path, odd: str) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_steps": 1, "phase": "train", "learner_q_mean": 2.0}\n' + odd + '\n{"updates": 3}\n')
    metrics = MetricsFile(path)
    metrics.read()
    assert metrics.values == {"env_steps": 1, "phase": "train", "learner_q_mean": 2.0, "updates": 3}


def test_values_are_printed_as_json_and_as_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "config.json").write_text("{}")
    (tmp_path / "metrics.jsonl").write_text('{"phase": "train", "env_steps": 7, "time_s": 61, "learner_q_mean": 1.5}\n')
    assert main([str(tmp_path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["learner_q_mean"] == 1.5
    assert main([str(tmp_path), "--once"]) == 0
    shown = capsys.readouterr().out
    assert "7 env steps" in shown
    assert "1 min 01 s" in shown
    assert "learner_q_mean" in shown


def test_a_directory_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no directory of a run"):
        main([str(tmp_path), "--once"])
