"""Nested plain values and arrays as bytes, with nothing executable in them: msgpack plus one type for arrays.

Decoding trusts nothing. Before anything is built, the whole input is walked once: every length must fit what is left of
it, so a forged header can neither crash the reader nor make it allocate more than the input's size justifies.
"""

import math
import struct
from collections.abc import Mapping
from typing import Any

import msgpack
import numpy as np

MAX_DEPTH = 32
"""Containers within containers."""

MAX_AXES = 16
"""Axes of an array."""

DTYPES = tuple(
    np.dtype(name).newbyteorder("<")
    for name in ("bool", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8")
)
"""Types of an array's elements."""

_ARRAY_CODE = 1
_MAX_ELEMENTS = 1 << 40

_FIXED_BYTES = {0xC0: 0, 0xC2: 0, 0xC3: 0, 0xCA: 4, 0xCB: 8} | {
    first + i: 1 << i for first in (0xCC, 0xD0) for i in range(4)
}
_FIXED_EXT_BYTES = {0xD4 + i: 1 << i for i in range(5)}
_LENGTH_FORMATS = {
    **dict.fromkeys((0xC4, 0xC7, 0xD9), ">B"),
    **dict.fromkeys((0xC5, 0xC8, 0xDA, 0xDC, 0xDE), ">H"),
    **dict.fromkeys((0xC6, 0xC9, 0xDB, 0xDD, 0xDF), ">I"),
}
_EXT, _ARRAY, _MAP = {0xC7, 0xC8, 0xC9}, {0xDC, 0xDD}, {0xDE, 0xDF}


def encode(value: Any) -> bytes:
    """Write None, bools, ints of 64 bits, floats, strings, bytes, lists, tuples, string-keyed mappings and arrays.

    Tuples come back as lists, numpy scalars as Python numbers, arrays with their type, shape and bits (little-endian).

    Raises:
        ValueError: a value of another kind, an array of objects, an int that is too large, or too deep a nesting.
    """
    try:
        return msgpack.Packer(use_bin_type=True, strict_types=True).pack(_plain(value, 0))
    except (TypeError, OverflowError) as error:
        raise ValueError(f"cannot be written: {error}") from None


def decode(content: bytes) -> Any:
    """Read what `encode` wrote; arrays own their memory.

    Raises:
        ValueError: whatever else the input is; nothing is executed and no memory beyond its size is taken.
    """
    try:
        _check_lengths(content)
        return msgpack.unpackb(content, ext_hook=_decode_array, object_pairs_hook=_mapping, strict_map_key=True)
    except (ValueError, TypeError, struct.error, IndexError, msgpack.exceptions.UnpackException) as error:
        raise ValueError(f"not a valid message: {error}") from None


def _plain(value: Any, depth: int) -> Any:
    if depth > MAX_DEPTH:
        raise ValueError(f"cannot be written: nested deeper than {MAX_DEPTH}")
    if isinstance(value, np.ndarray):
        return _encode_array(value)
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, Mapping):
        wrong = [key for key in value if type(key) is not str]
        if wrong:
            raise ValueError(f"cannot be written: key {wrong[0]!r} is not a string")
        return {key: _plain(item, depth + 1) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item, depth + 1) for item in value]
    return value


def _encode_array(array: np.ndarray) -> msgpack.ExtType:
    little = array.dtype.newbyteorder("<")
    if little not in DTYPES:
        raise ValueError(f"cannot be written: an array of {array.dtype}")
    if array.ndim > MAX_AXES:
        raise ValueError(f"cannot be written: an array of {array.ndim} axes; at most {MAX_AXES}")
    header = struct.pack(f"<BB{array.ndim}Q", DTYPES.index(little), array.ndim, *array.shape)
    return msgpack.ExtType(_ARRAY_CODE, header + array.astype(little, copy=False).tobytes())


def _decode_array(_code: int, payload: bytes) -> np.ndarray:
    dtype_index, num_axes = struct.unpack_from("<BB", payload)
    if dtype_index >= len(DTYPES) or num_axes > MAX_AXES:
        raise ValueError("an array of unknown type")
    dtype = DTYPES[dtype_index]
    shape: tuple[int, ...] = struct.unpack_from(f"<{num_axes}Q", payload, 2)
    start = 2 + 8 * num_axes
    if math.prod(max(length, 1) for length in shape) > _MAX_ELEMENTS:
        raise ValueError(f"an array of impossible shape {shape}")
    if math.prod(shape) * dtype.itemsize != len(payload) - start:
        raise ValueError(f"an array of shape {shape} and type {dtype} with {len(payload) - start} bytes")
    if dtype == np.bool_ and (np.frombuffer(payload, np.uint8, offset=start) > 1).any():
        raise ValueError("a truth value that is neither 0 nor 1")
    return np.frombuffer(payload, dtype, offset=start).reshape(shape).copy()


def _mapping(pairs: list[tuple[Any, Any]]) -> dict[str, Any]:
    mapping = dict(pairs)
    if len(mapping) != len(pairs) or not all(isinstance(key, str) for key in mapping):
        raise ValueError("a mapping with a repeated key or one that is not a string")
    return mapping


def _check_lengths(content: bytes) -> None:
    """Walk over all values without building any; raise ``ValueError`` if one promises more than follows."""
    position = 0
    due_in_all = 1
    due = [1]
    while due:
        if due[-1] == 0:
            due.pop()
            continue
        due[-1] -= 1
        position, num_children = _skip(content, position)
        due_in_all += num_children - 1
        if due_in_all > len(content) - position:
            raise ValueError(f"cut short, or a forged length before byte {position}")
        if num_children:
            due.append(num_children)
        if len(due) > MAX_DEPTH + 2:
            raise ValueError(f"nested deeper than {MAX_DEPTH}")
    if position != len(content):
        raise ValueError(f"{len(content) - position} bytes follow its end")


def _skip(content: bytes, position: int) -> tuple[int, int]:
    """Position behind a value's own bytes, and how many values it contains."""
    tag = content[position]
    position += 1
    if tag <= 0x7F or tag >= 0xE0:  # small ints
        return position, 0
    if tag <= 0x8F:  # short mapping
        return position, 2 * (tag & 0x0F)
    if tag <= 0x9F:  # short list
        return position, tag & 0x0F
    if tag <= 0xBF:  # short string
        return position + (tag & 0x1F), 0
    if tag in _FIXED_BYTES:
        return position + _FIXED_BYTES[tag], 0
    if tag in _FIXED_EXT_BYTES:
        return _skip_array(content, position, _FIXED_EXT_BYTES[tag]), 0
    if tag not in _LENGTH_FORMATS:
        raise ValueError(f"unknown type 0x{tag:02x} at byte {position - 1}")
    length = struct.unpack_from(_LENGTH_FORMATS[tag], content, position)[0]
    position += struct.calcsize(_LENGTH_FORMATS[tag])
    if tag in _MAP:
        return position, 2 * length
    if tag in _ARRAY:
        return position, length
    if tag in _EXT:
        return _skip_array(content, position, length), 0
    return position + length, 0


def _skip_array(content: bytes, position: int, num_bytes: int) -> int:
    if content[position] != _ARRAY_CODE:
        raise ValueError(f"an extension of unknown type {content[position]} at byte {position}")
    return position + 1 + num_bytes
