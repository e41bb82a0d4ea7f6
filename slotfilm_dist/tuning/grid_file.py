"""What a grid's directory says of itself: the settings that all its trials share, and the command that began it."""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from slotfilm_dist.atomic import write_atomic
from slotfilm_dist.config import RunConfig
from slotfilm_dist.config_files import changed_fields, from_dict, to_dict

GRID_FILE = "grid.json"


def check_same_settings(grid: Path, settings: RunConfig) -> None:
    """Raise ``ValueError`` if the directory holds a grid of other settings, whose trials must not be mixed with these.

    Args:
        grid: the directory, which may not be there yet.
        settings: the proposed agent as this grid trains it, without seed and places.
    """
    values = _read(grid)
    if not values:
        return
    try:
        differing = changed_fields(from_dict(RunConfig, values["settings"]), settings)
    except ValueError as error:
        raise ValueError(f"{grid / GRID_FILE}: {error}; give this grid another --name") from None
    if differing:
        raise ValueError(f"{grid} is a grid with other settings ({', '.join(differing)}); give this one another --name")


def write_grid_file(grid: Path, settings: RunConfig, command: Sequence[str]) -> None:
    """Note the settings, and the command of this start beside those before."""
    commands = [*_read(grid).get("commands", []), shlex.join(("slotfilm", *command))]
    values = {"settings": to_dict(settings), "commands": list(dict.fromkeys(commands))}
    write_atomic(grid / GRID_FILE, [json.dumps(values, indent=1).encode()])


def _read(grid: Path) -> dict[str, Any]:
    path = grid / GRID_FILE
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(
            f"{path} is not valid JSON ({error}); delete it if the grid's settings have not changed"
        ) from None
    if not isinstance(values, dict) or not isinstance(values.get("settings"), dict):
        raise ValueError(f"{path} is not a grid's; give this grid another --name")
    return values
