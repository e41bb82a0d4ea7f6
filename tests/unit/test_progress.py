"""What a person sees of a run."""

import io
import os
import subprocess
import sys

import pytest
from rich.console import Console

from slotfilm_dist import progress
from slotfilm_dist.progress import Progress, duration


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (125, "2 min 05 s"),
        (3600, "1 h 00 min"),
        (86_399, "23 h 59 min"),
    ],
)
def test_duration_reads_as_a_person_writes_it(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def shown(monkeypatch: pytest.MonkeyPatch, calls: list[tuple[float, float]]) -> list[str]:
    """Lines written where the output is no terminal and every line is due."""
    monkeypatch.setattr(progress, "PLAIN_EVERY_S", 0.0)
    output = io.StringIO()
    told = Progress(Console(file=output, width=200))
    told.begin("train", "go")
    for done, total in calls:
        told.show(done, total, {"return": "1.5"})
    told.end("over")
    return output.getvalue().splitlines()


def test_line_names_phase_share_values_and_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, [(0, 100), (50, 100)])
    assert lines[0].split() == ["train", "go"]
    assert "##########.........." in lines[2]
    assert "50%" in lines[2]
    assert "return 1.5" in lines[2]
    assert lines[2].endswith("left")
    assert lines[-1].startswith("   train  over (")


def test_nothing_to_do_and_too_much_done_show_a_full_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    lines = shown(monkeypatch, [(0, 0), (150, 100)])
    assert all("#" * 20 in line and "100%" in line for line in lines[1:3])


def test_brackets_in_paths_and_errors_are_shown_as_they_are() -> None:
    output = io.StringIO()
    Progress(Console(file=output, width=200)).say("--resume '/runs/exp[gpu]/x': [enforce fail at a.cpp] [/]")
    assert output.getvalue() == "--resume '/runs/exp[gpu]/x': [enforce fail at a.cpp] [/]\n"


def test_lost_standard_error_ends_nothing() -> None:
    code = """
import os, sys
from slotfilm_dist.progress import Progress
progress = Progress()
progress.begin("train", "something")
progress.say("a sentence " * 10_000)
for done in range(3):
    progress.show(done, 3, {})
progress.end("over")
print("alive")
"""
    reading, writing = os.pipe()
    os.close(reading)
    with open("/dev/full", "wb") as full:
        for stderr in (full, writing):
            done = subprocess.run(
                [sys.executable, "-P", "-c", code], stderr=stderr, stdout=subprocess.PIPE, check=False
            )
            assert done.stdout == b"alive\n"
    os.close(writing)
