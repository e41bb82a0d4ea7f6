"""A config as plain values and as a file: read strictly, named by a hash, compared with another."""

import dataclasses
import difflib
import hashlib
import json
import math
import typing
from pathlib import Path
from typing import Any, Literal, TypeVar

from slotfilm_dist.config import RunConfig, check

ConfigT = TypeVar("ConfigT")


def to_dict(config: Any) -> dict[str, Any]:
    """The config as plain dicts, lists and scalars, ready for JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(cls: type[ConfigT], values: dict[str, Any], where: str = "") -> ConfigT:
    """Build a config section from plain values.

    Raises:
        ValueError: an unknown key (with the nearest known one), a value of the wrong type, or an impossible value.
    """
    known = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]  # cls is a dataclass by contract
    hints = typing.get_type_hints(cls)
    kwargs: dict[str, Any] = {}
    for key, value in values.items():
        path = f"{where}{key}"
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1)
            raise ValueError(f"unknown field {path!r}" + (f"; did you mean {where + near[0]!r}?" if near else ""))
        kwargs[key] = _coerce(hints[key], value, path)
    lacking = [n for n, f in known.items() if n not in kwargs and f.default is f.default_factory is dataclasses.MISSING]
    if lacking:
        raise ValueError(f"field {where + lacking[0]!r} is missing")
    return cls(**kwargs)


def _coerce(kind: Any, value: Any, path: str) -> Any:
    if dataclasses.is_dataclass(kind):
        check(isinstance(value, dict), path, value, "must be a section of fields")
        return from_dict(typing.cast(type, kind), value, path + ".")
    origin = typing.get_origin(kind)
    if origin is Literal:
        choices = typing.get_args(kind)
        check(value in choices, path, value, f"must be one of {', '.join(map(str, choices))}")
        return value
    if origin is tuple:
        check(isinstance(value, list | tuple), path, value, "must be a list")
        return tuple(_coerce(typing.get_args(kind)[0], item, path) for item in value)
    if isinstance(value, float):
        check(math.isfinite(value), path, value, "must be a finite number")
    if type(value) is int:
        check(abs(value) < 1 << 63 or kind is float, path, value, "must be a number of sensible size")
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        check(abs(value) < 1 << 1023, path, "a number of hundreds of digits", "must be a number of sensible size")
        return float(value)
    check(
        isinstance(value, kind) and (kind is bool or not isinstance(value, bool)),
        path,
        value,
        f"must be {'an' if kind is int else 'a'} {getattr(kind, '__name__', kind)}",
    )
    return value


def save_config(config: RunConfig, path: Path) -> None:
    """Write the whole config as JSON."""
    path.write_text(json.dumps(to_dict(config), indent=2) + "\n", encoding="utf-8")


def load_config(path: Path) -> RunConfig:
    """Read a config written by `save_config`; raises ``ValueError`` naming the file and the field."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ValueError(f"{path} does not exist; a run directory has a config.json") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is not valid JSON: {error}") from None
    except OSError as error:
        raise ValueError(f"{path} cannot be read: {error.strerror}") from None
    if not isinstance(values, dict):
        raise ValueError(f"{path} is no config: it must hold one JSON object of sections")
    if isinstance(values.get("sac"), dict):
        values["sac"].pop("train_heads", None)  # older files name it; nothing ever read it
    try:
        return from_dict(RunConfig, values)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def config_hash(*sections: Any) -> str:
    """First 16 hex digits of SHA-256 over the sections; names artifacts and checks checkpoints.

    Of a config section only the fields that differ from its defaults count, so that a version with a new field still
    finds what an older one made.
    """
    plain = [
        {type(s).__name__: {name: new for name, (_, new) in changed_fields(type(s)(), s).items()}}
        if dataclasses.is_dataclass(s)
        else s
        for s in sections
    ]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def changed_fields(base: Any, other: Any, where: str = "") -> dict[str, tuple[Any, Any]]:
    """Dotted names of the fields that differ, each with (base value, other value)."""
    out: dict[str, tuple[Any, Any]] = {}
    for f in dataclasses.fields(base):
        a, b = getattr(base, f.name), getattr(other, f.name)
        if dataclasses.is_dataclass(a) and not isinstance(a, type):
            out |= changed_fields(a, b, f"{where}{f.name}.")
        elif a != b:
            out[where + f.name] = (a, b)
    return out
