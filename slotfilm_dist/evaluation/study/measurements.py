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

    @property
    def options(self) -> dict[str, str]:
        """Options of the command that made it, as far as its file tells them."""
        frames, played = self.values.get("frames", {}), self.values.get("episodes", {})
        found = {
            "--checkpoint": self.values.get("checkpoint"),
            "--hold": self.values.get("hold"),
            "--frames": frames.get("source"),
            "--episodes": frames.get("episodes", max(map(len, played.values()), default=None)),
            "--steps": frames.get("steps"),
            "--seed": frames.get("first_seed", self.values.get("first_seed")),
        }
        return {option: str(value) for option, value in found.items() if value is not None}

    @property
    def stage(self) -> str:
        """After how much training, in words; empty where it is unknown, or another one for every run's best."""
        steps = self.values.get("env_steps")
        if not isinstance(steps, int) or self.values.get("checkpoint") == "best":
            return ""
        # Runs of several workers end a few steps apart.
        return "at the end of training" if steps >= self.run.config.schedule.total_steps else f"after {steps} steps"

    @property
    def way(self) -> tuple[object, ...]:
        """How it was made: measurements of different runs may stand side by side where this is the same."""
        own_frames = (self.run.path,) if self.options.get("--frames") == "agent" else ()  # nobody else's are the same
        return self.folder.name, *self.options.items(), self.stage, *own_frames


def measured(runs: Sequence[StudyRun], pattern: str) -> list[Measurement]:
    """JSON files of runs that match a pattern below their directories; damaged ones are passed over."""
    found = []
    for run in runs:
        for path in sorted(run.path.glob(pattern)):
            if values := read_object(path):
                found.append(Measurement(run=run, folder=path.parent, values=values))
    return found


def in_one_way(
    measurements: Sequence[Measurement], preferred: Sequence[str] = ()
) -> tuple[list[Measurement], list[Measurement]]:
    """Those made in the same way, one a run, and those of runs that were only measured in another way.

    Args:
        measurements: of any runs, whose folders are named after frames and checkpoint.
        preferred: endings of folder names, best first; among equals the way that most runs were measured in.
    """
    counts = Counter(m.way for m in measurements)
    if not counts:
        return [], []

    def rank(way: tuple[object, ...]) -> tuple[int, int]:
        ending = next((i for i, end in enumerate(preferred) if str(way[0]).endswith(end)), len(preferred))
        return ending, -counts[way]

    chosen = min(counts, key=rank)
    kept = [m for m in measurements if m.way == chosen]
    paths = {m.run.path for m in kept}
    return kept, [m for m in measurements if m.run.path not in paths]


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
