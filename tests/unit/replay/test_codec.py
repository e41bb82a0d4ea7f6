import struct
import tracemalloc

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_np

from slotfilm_dist.replay.codec import MAX_AXES, MAX_DEPTH, decode, encode

DTYPES = ["?", "i1", "<i2", ">i4", "<i8", "u1", "<u2", "<u4", ">u8", "<f2", ">f4", "<f8"]

arrays = st.sampled_from(DTYPES).flatmap(
    lambda dtype: st_np.arrays(dtype, st_np.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
)
scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary()
values = st.recursive(
    scalars | arrays, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4)
)


def assert_same(left, right) -> None:
    if isinstance(left, np.ndarray):
        assert isinstance(right, np.ndarray)
        assert left.shape == right.shape
        assert left.dtype.newbyteorder("<") == right.dtype
        assert left.astype(right.dtype).tobytes() == right.tobytes()
    elif isinstance(left, list):
        assert len(left) == len(right)
        for a, b in zip(left, right, strict=True):
            assert_same(a, b)
    elif isinstance(left, dict):
        assert left.keys() == right.keys()
        for key, value in left.items():
            assert_same(value, right[key])
    elif isinstance(left, float):
        assert struct.pack("<d", left) == struct.pack("<d", right)
    else:
        assert type(left) is type(right)
        assert left == right


@settings(max_examples=300, deadline=None)
@given(value=values)
def test_what_is_read_is_what_was_written(value):
    assert_same(value, decode(encode(value)))


@settings(max_examples=500, deadline=None)
@given(value=values, data=st.data())
def test_damaged_bytes_give_a_value_or_one_value_error(value, data):
    content = bytearray(encode(value))
    for _ in range(data.draw(st.integers(1, 3))):
        kind = data.draw(st.sampled_from(["flip", "cut", "insert"]))
        position = data.draw(st.integers(0, max(0, len(content) - 1)))
        if kind == "flip" and content:
            content[position] ^= data.draw(st.integers(1, 255))
        elif kind == "cut":
            del content[position:]
        else:
            content[position:position] = data.draw(st.binary(max_size=6))
    try:
        decode(bytes(content))
    except ValueError as error:
        assert str(error).startswith("not a valid message: ")  # noqa: PT017 - both outcomes are right


@settings(max_examples=300, deadline=None)
@given(content=st.binary(max_size=64))
def test_random_bytes_give_a_value_or_one_value_error(content):
    try:
        decode(content)
    except ValueError as error:
        assert str(error).startswith("not a valid message: ")  # noqa: PT017 - both outcomes are right


@pytest.mark.parametrize("cut", range(1, 40))
def test_truncated_message_is_refused(cut):
    content = encode({"weights": np.arange(6, dtype=np.float32), "version": 3, "name": "abc"})
    with pytest.raises(ValueError, match="not a valid message"):
        decode(content[:-cut])


def test_arrays_are_aligned_writable_and_own_their_memory():
    array = decode(encode({"x": np.arange(6.0).reshape(2, 3)}))["x"]
    assert array.flags.owndata or array.base.flags.owndata
    assert array.flags.writeable
    assert array.flags.aligned
    array += 1


def test_views_and_other_orders_are_written_in_order():
    array = np.arange(24).reshape(2, 3, 4)
    for view in (array[:, ::-1], array.T, np.asfortranarray(array), np.broadcast_to(array, (2, 2, 3, 4))):
        np.testing.assert_array_equal(decode(encode(view)), view)


def test_numpy_scalars_and_tuples_become_plain_values():
    assert decode(encode((np.float32(0.5), np.int64(3), np.bool_(True), (1, 2)))) == [0.5, 3, True, [1, 2]]


class Strange:
    pass


@pytest.mark.parametrize(
    "value",
    [
        Strange(),
        {1, 2},
        {1: "a"},
        {b"a": 1},
        2**64,
        1j,
        np.array([None, Strange()]),
        np.array(["text"]),
        np.zeros(2, "datetime64[s]"),
        np.zeros(2, [("a", "f4")]),
        np.zeros(2, np.complex64),
        np.zeros((1,) * (MAX_AXES + 1)),
    ],
    ids=repr,
)
def test_other_values_are_refused_when_writing(value):
    with pytest.raises(ValueError, match="cannot be written"):
        encode({"x": value})


def nested(depth: int) -> list:
    value: list = []
    for _ in range(depth - 1):
        value = [value]
    return value


def test_depth_is_bounded_in_both_directions():
    decode(encode(nested(MAX_DEPTH)))
    with pytest.raises(ValueError, match="nested deeper"):
        encode(nested(MAX_DEPTH + 2))
    with pytest.raises(ValueError, match="nested deeper"):
        decode(b"\x91" * 100_000 + b"\xc0")


def array_message(dtype_index: int, shape: tuple[int, ...], payload: bytes, code: int = 1) -> bytes:
    header = struct.pack(f"<BB{len(shape)}Q", dtype_index, len(shape), *shape)
    return msgpack.packb(msgpack.ExtType(code, header + payload))


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (array_message(10, (4,), bytes(15)), "15 bytes"),
        (array_message(10, (2**40,), bytes(16)), "shape"),
        (array_message(10, (2**63, 2**63), b""), "shape"),
        (array_message(10, (2**63, 0), b""), "impossible shape"),
        (array_message(10, (2**32, 2**32, 2**32), bytes(16)), "shape"),
        (array_message(12, (4,), bytes(16)), "unknown type"),
        (array_message(10, (1,) * 17, bytes(4)), "unknown type"),
        (array_message(10, (4,), bytes(16), code=2), "unknown type"),
        (array_message(0, (2,), b"\x01\x02"), "truth value"),
        (msgpack.packb(msgpack.ExtType(1, b"")), "not a valid message"),
        (msgpack.packb(msgpack.Timestamp(1, 2)), "unknown type"),
        (msgpack.packb({1: 2}), "not a valid message"),
        (msgpack.packb({b"a": 2}), "not a string"),
        (b"\x82\xa1a\x01\xa1a\x02", "repeated key"),
        (b"\xc1", "unknown type"),
        (b"", "not a valid message"),
        (b"\xc0\xc0", "1 bytes follow"),
        (b"\xa2\xff\xfe", "not a valid message"),
        (b"\xdf\xff\xff\xff\xff", "forged length"),
        (b"\xdd\xff\xff\xff\xff\xc0", "forged length"),
        (b"\xc6\xff\xff\xff\xff\xc0", "forged length"),
        (b"\xc9\xff\xff\xff\xff\x01\xc0", "forged length"),
    ],
)
def test_hostile_header_is_refused(content, complaint):
    with pytest.raises(ValueError, match=complaint):
        decode(content)


def test_forged_lengths_allocate_nothing():
    size = 1 << 20
    forged = [
        (b"\xdd" + struct.pack(">I", size - 200)) * 30 + bytes(size),
        array_message(10, (1 << 38,), bytes(1000)),
        b"\xdf" + struct.pack(">I", 2**31) + bytes(1000),
    ]
    tracemalloc.start()
    try:
        for content in forged:
            with pytest.raises(ValueError, match="not a valid message"):
                decode(content)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
