"""Ways to damage a file or to forge its content; every choice comes from the given `Random`."""

import copy
import json
import random
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Random = random.Random


def rotten(content: bytes, rng: Random) -> bytes:
    """A copy with a flipped bit, a cut, a run of equal bytes, a hole or a repetition."""
    changed = bytearray(content)
    at = rng.randrange(len(changed) + 1)
    match rng.choice(["flip", "cut", "run", "hole", "repeat"]):
        case "flip" if at < len(changed):
            changed[at] ^= 1 << rng.randrange(8)
        case "cut":
            del changed[at:]
        case "run":
            changed[at : at + 8] = bytes([rng.choice([0x00, 0xFF, 0x7F, 0xDD, 0xC9, 0x5B, 0x7B])]) * rng.randrange(1, 9)
        case "hole":
            del changed[at : at + rng.randrange(1, 64)]
        case _:
            changed[at:at] = changed[max(0, at - 64) : at] * rng.randrange(1, 4)
    return bytes(changed)


def strange_value(rng: Random) -> Any:
    nested: Any = []
    for _ in range(rng.choice([40, 300])):
        nested = [nested]
    numbers = [0, 1, 2, -1, 2**31, 2**48, 2**63 - 1, 2**63, 2**64 - 1, -(2**63), 0.5, float("nan"), float("inf")]
    words = [
        "",
        "x",
        "../../../etc/passwd",
        "/dev/zero",
        "a.b",
        "ring.columns",
        "O",
        "|O",
        "<f8",
        "V16",
        "\0",
        "9" * 99,
    ]
    return rng.choice([*numbers, *words, None, True, False, [], {}, [[]], [2**40, 2**40], {"x": {}}, nested])


def strange_array(rng: Random) -> np.ndarray:
    shape = rng.choice([(), (0,), (3,), (1, 3), (2, 2), (0, 3), (5, 3)])
    dtype = rng.choice(["bool", "i1", "i8", "u8", "f2", "f4", "f8"])
    return np.full(shape, rng.choice([0, 1, 127]), dtype) * (-1 if dtype == "i8" and rng.random() < 0.5 else 1)


def forged(value: Any, rng: Random, leaf: Callable[[Random], Any] = strange_value) -> Any:
    """A copy with one to three things replaced, removed, added or renamed, anywhere within it."""
    root = [copy.deepcopy(value)]
    for _ in range(rng.randint(1, 3)):
        places = list(_places(root))
        owner, key = rng.choice(places)
        match rng.choice(["replace", "replace", "remove", "add", "rename"]):
            case "remove" if owner is not root:
                del owner[key]
            case "rename" if isinstance(owner, dict):
                owner[rng.choice(["", "x", "../x", key + "x"])] = owner.pop(key)
            case "add" if isinstance(owner, dict):
                owner[rng.choice(["x", "../x", "format"])] = leaf(rng)
            case _:
                owner[key] = leaf(rng)
    return root[0]


def _places(value: Any) -> Iterator[tuple[Any, Any]]:
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in list(items):
        yield value, key
        yield from _places(item)


def number_nested(text: str, rng: Random) -> str:
    """JSON with a number of thousands of digits or a very deep nesting in place of a digit or a word."""
    at = rng.randrange(len(text))
    return text[:at] + rng.choice(["[" * 100_000, "9" * 5000, "1e999999", "-", '{"a":' * 50_000]) + text[at + 1 :]


def refilled(base: Path, folder: Path) -> Path:
    """The folder with the files of the base and no others."""
    folder.mkdir(exist_ok=True)
    for path in folder.iterdir():
        path.unlink()
    for path in base.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    return folder


def rot_a_file(base: Path, folder: Path, rng: Random) -> None:
    path = rng.choice(sorted(refilled(base, folder).iterdir()))
    if rng.random() < 0.1:
        path.unlink()
    elif path.suffix == ".json" and rng.random() < 0.3:
        path.write_text(number_nested(path.read_text(), rng))
    else:
        path.write_bytes(rotten(path.read_bytes(), rng))


def json_text(value: Any) -> bytes:
    try:
        return json.dumps(value).encode()
    except RecursionError:
        return b"[" * 100_000


def write_json(path: Path, value: Any) -> None:
    path.write_bytes(json_text(value))
