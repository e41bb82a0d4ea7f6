"""What `slotfilm evaluate`, `probe`, `perceive` and `cost` have left in runs' directories, read for a study."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image

from slotfilm_dist.evaluation.study.collection import StudyRun

_WIDEST_PX = 1300
_COLORS = 128
COST_FILE = "cost.json"
"""In the study's folder: the output of `slotfilm cost --json`."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Measurement:
    """One measurement of one run."""

    run: StudyRun
    folder: Path
    values: dict[str, Any]


def measured(runs: Sequence[StudyRun], pattern: str) -> list[Measurement]:
    """JSON files of runs that match a pattern below their directories; damaged ones are passed over."""
    found = []
    for run in runs:
        for path in sorted(run.path.glob(pattern)):
            if values := read_object(path):
                found.append(Measurement(run=run, folder=path.parent, values=values))
    return found


def in_one_way(measurements: Sequence[Measurement], preferred: Sequence[str] = ()) -> list[Measurement]:
    """Those made in the same way, so that they may stand side by side: one a run, from folders of the same name.

    Args:
        measurements: of any runs, whose folders are named after frames and checkpoint.
        preferred: endings of folder names, best first; among equals the one that most runs have.
    """
    counts = Counter(m.folder.name for m in measurements)
    if not counts:
        return []

    def rank(name: str) -> tuple[int, int]:
        ending = next((i for i, end in enumerate(preferred) if name.endswith(end)), len(preferred))
        return ending, -counts[name]

    chosen = min(sorted(counts), key=rank)
    return [m for m in measurements if m.folder.name == chosen]


def read_object(path: Path) -> dict[str, Any]:
    """A JSON object; empty if the file is not there, damaged, or something else."""
    values = _read(path)
    return values if isinstance(values, dict) else {}


def read_costs(folder: Path) -> list[dict[str, Any]]:
    """Rows of the study's cost table; empty without the file."""
    values = _read(folder / COST_FILE)
    return [row for row in values if isinstance(row, dict)] if isinstance(values, list) else []


def _read(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (FileNotFoundError, UnicodeDecodeError, json.JSONDecodeError):
        return {}


def take_picture(source: Path, target: Path) -> Path:
    """Copy a picture into the report, at most 1300 pixels wide and of 128 colours, so that many fit in one page."""
    with Image.open(source) as picture:
        small = picture.convert("RGB")
        small.thumbnail((_WIDEST_PX, _WIDEST_PX))
        target.parent.mkdir(parents=True, exist_ok=True)
        small.quantize(_COLORS).save(target, optimize=True)
    return target
