"""Results on disk: CSV tables and JSON that every reader accepts. An undefined number is an empty cell, or null."""

import csv
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from slotfilm_dist.atomic import write_atomic


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> Path:
    """Write rows under the first row's names, one file that is whole or not there; gives its path.

    Raises:
        ValueError: no rows, which would leave a file without columns.
    """
    if not rows:
        raise ValueError(f"{path.name}: there is nothing to write")
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({name: "" if value is None else value for name, value in plain(dict(row)).items()})
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, [text.getvalue().encode()])
    return path


def write_json(path: Path, values: Any) -> Path:
    """Write plain values as JSON, one file that is whole or not there; gives its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, [(json.dumps(plain(values), indent=1, allow_nan=False) + "\n").encode()])
    return path


def plain(value: Any) -> Any:
    """Lists, dicts and scalars of Python, with null in place of what is not finite."""
    match value:
        case Mapping():
            return {str(name): plain(item) for name, item in value.items()}
        case np.ndarray():
            return plain(value.tolist())
        case list() | tuple():
            return [plain(item) for item in value]
        case np.generic():
            return plain(value.item())
        case float():
            return value if math.isfinite(value) else None
        case _:
            return value
