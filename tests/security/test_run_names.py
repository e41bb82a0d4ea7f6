"""Names of runs become folders: nothing that leaves the runs' folder or confuses a shell, a terminal or a disk."""

from pathlib import Path

import pytest

from slotfilm_dist.__main__ import main
from slotfilm_dist.presets import smoke
from slotfilm_dist.runs import new_run_directory

HOSTILE = {
    "parent": "..",
    "traversal": "../outside",
    "nested": "a/b",
    "absolute": "/tmp/outside",
    "backslash": "a\\b",
    "leading dash": "-rf",
    "hidden": ".ssh",
    "newline": "run\n",
    "escape": "run\x1b[2J",
    "nul": "run\0",
    "tab": "a\tb",
    "space": "a b",
    "shell": "$(id)",
    "quote": "a'b",
    "markup": "<script>",
    "homoglyph": "r\u0443n",
    "right to left": "run\u202etxt",
    "long": "a" * 101,
}


@pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE)
def test_hostile_name_is_refused_and_makes_nothing(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"^--name .*: use letters, digits, '\.', '_' and '-', at most 100") as refusal:
        new_run_directory(tmp_path / "runs", smoke(), "smoke", name)
    assert str(refusal.value).isprintable(), "a refusal must not send control characters to the terminal"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["run", "Run-1.final_b", "7", "a" * 100])
def test_plain_name_is_taken_as_it_is(name: str, tmp_path: Path) -> None:
    assert new_run_directory(tmp_path, smoke(), "smoke", name) == tmp_path / name


def test_command_refuses_a_hostile_name_before_it_starts_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["train", "smoke", "--runs", str(tmp_path), "--name", "../outside"]) == 2
    assert "--name '../outside'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
