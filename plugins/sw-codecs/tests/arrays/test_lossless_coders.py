"""byte-planes, float-delta and packed-bits: every bit pattern, any shape and width, damage, claims without bytes."""

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from splatwizard_core.errors import BitstreamError
from sw_codecs.arrays import packed_bits
from sw_codecs.arrays.byte_planes import BytePlanes, FloatDelta
from sw_codecs.arrays.packed_bits import PackedBits

DTYPES = ["f2", "f4", "f8", "i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", ">f4", ">i2"]
SHAPES = some.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6)
ODD = [-0.0, 0.0, 1e-45, -1e-45, 1.1754942e-38, np.inf, -np.inf, np.nan, 3.4028235e38, -3.4028235e38, 1.0, -1.0]


def scene(n=20_000):
    """Positions of a surface in Morton order, and colours of its rows."""
    r = np.random.default_rng(0)
    points = r.normal(size=(n, 3))
    points = (points / np.linalg.norm(points, axis=1, keepdims=True)).astype(np.float32)
    return points[FloatDelta.sort(points)], (0.3 * r.normal(size=(n, 3))).astype(np.float16)


@settings(max_examples=120, deadline=None)
@given(st.sampled_from(DTYPES).flatmap(lambda d: some.arrays(d, SHAPES)))
def test_any_array_comes_back_bit_for_bit(array):
    data = BytePlanes().encode(array)
    assert len(data) <= array.nbytes + 6
    found = BytePlanes().decode(data, array.dtype, array.shape)
    assert (found.dtype, found.shape) == (array.dtype.newbyteorder("="), array.shape)
    assert found.astype(array.dtype).tobytes() == array.tobytes()
    found[...] = 0  # it is the caller's own


@settings(max_examples=120, deadline=None)
@given(
    some.arrays(
        "f4",
        some.array_shapes(min_dims=1, max_dims=2, min_side=0, max_side=9),
        elements=st.floats(width=32) | st.sampled_from(ODD),
    )
)
def test_any_floats_come_back_bit_for_bit_from_their_steps(array):
    found = FloatDelta().decode(FloatDelta().encode(array), "f4", array.shape)
    assert found.dtype == np.float32
    assert found.tobytes() == array.tobytes()


def test_every_kind_of_float32_comes_back():
    array = np.array([*ODD, *(np.random.default_rng(1).integers(0, 1 << 32, 3000, np.uint32).view("f4"))], "f4")
    patterns = np.array([0x7FC00001, 0xFFC12345, 0x7F800001, 0x80000000, 0x00000001], np.uint32).view("f4")
    array = np.concatenate([array, patterns])  # quiet and signalling NaN with a payload
    assert FloatDelta().decode(FloatDelta().encode(array), "f4", array.shape).tobytes() == array.tobytes()


def test_planes_and_steps_are_worth_their_trouble():
    points, colors = scene()
    plain = len(zstandard.ZstdCompressor(level=19).compress(points.tobytes()))
    planes, steps = len(BytePlanes().encode(points)), len(FloatDelta().encode(points))
    assert steps < 0.97 * planes < 0.97 * plain
    assert len(FloatDelta().encode(points[np.random.default_rng(2).permutation(len(points))])) > 1.05 * steps
    zipped = len(zstandard.ZstdCompressor(level=19).compress(colors.tobytes()))
    assert len(BytePlanes().encode(colors)) < 0.97 * zipped


def test_noise_is_stored_as_it_is():
    noise = np.random.default_rng(3).integers(0, 1 << 32, (500, 3), np.uint32)
    data = BytePlanes().encode(noise)
    assert data[6:] == noise.tobytes()


def test_damage_to_planes_and_steps_is_found(assert_survives_damage):
    points, colors = scene(40)
    for array in (colors, np.arange(60, dtype=np.int32)):
        assert_survives_damage(
            BytePlanes().encode(array), lambda d, array=array: BytePlanes().decode(d, array.dtype, array.shape), array
        )
    assert_survives_damage(FloatDelta().encode(points), lambda d: FloatDelta().decode(d, "f4", points.shape), points)


def test_a_shape_that_the_bytes_do_not_have_is_refused_before_any_memory_is_taken():
    for array in (np.zeros(1000, np.float32), np.random.default_rng(4).normal(size=100).astype("f4")):
        data = BytePlanes().encode(array)
        for shape in ((len(array) + 1,), (1 << 45,), (0,), (len(array), 2)):
            with pytest.raises(BitstreamError):
                BytePlanes().decode(data, "f4", shape)
        with pytest.raises(BitstreamError):
            BytePlanes().decode(data, "f2", array.shape)


def test_a_frame_of_another_or_an_unknown_length_is_refused():
    head = BytePlanes().encode(np.zeros(100, np.uint8))[:6]
    unknown = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(100))
    longer = zstandard.ZstdCompressor().compress(bytes(1 << 26))
    for frame in (unknown, longer, b"", b"nonsense", zstandard.ZstdCompressor().compress(bytes(100)) + b"more"):
        with pytest.raises(BitstreamError):
            BytePlanes().decode(head + frame, "u1", (100,))


def test_what_has_no_planes_is_refused():
    for array in (np.zeros(3, bool), np.zeros(3, complex), np.float32(1), np.array(["a"]), np.array([None])):
        with pytest.raises(ValueError):
            BytePlanes().encode(array)
    for array in (np.zeros(3), np.zeros((1, 1, 1), np.float32), np.float32(1), np.zeros(3, np.int32)):
        with pytest.raises(ValueError):
            FloatDelta().encode(array)
    with pytest.raises(ValueError):
        BytePlanes().decode(b"", "O", (1,))
    with pytest.raises(ValueError):
        FloatDelta().decode(b"", "f8", (1,))


@settings(max_examples=150, deadline=None)
@given(st.integers(1, 16).flatmap(lambda w: st.tuples(st.just(w), st.lists(st.integers(0, 2**w - 1), max_size=40))))
def test_indices_of_any_width_come_back(case):
    width, values = case
    packed = PackedBits(1 << width)
    data = packed.encode(np.array(values, np.int64))
    # By hand: the digits in a row, most significant first.
    digits = "".join(f"{value:0{width}b}" for value in values)
    assert data == int(digits.ljust((len(digits) + 7) // 8 * 8, "0") or "0", 2).to_bytes((len(digits) + 7) // 8, "big")
    assert packed.decode(data, np.uint16, (len(values),)).tolist() == values


def test_indices_come_back_over_several_blocks(monkeypatch):
    monkeypatch.setattr(packed_bits, "BLOCK", 64)
    for n in (63, 64, 65, 1000):
        values = np.random.default_rng(n).integers(0, 1 << 13, n)
        data = PackedBits(8192).encode(values)
        assert len(data) == (13 * n + 7) // 8
        assert np.array_equal(PackedBits(8192).decode(data, np.int64, (n,)), values)


def test_packed_bits_refuse_other_lengths_padding_and_values():
    data = PackedBits(8).encode(np.array([1, 2, 3]))
    for hostile in (data + b"\x00", data[:1], b"", data[:1] + bytes([data[1] | 1])):
        with pytest.raises(BitstreamError):
            PackedBits(8).decode(hostile, np.int64, (3,))
    with pytest.raises(BitstreamError):
        PackedBits(8).decode(data, np.int64, (1 << 50,))
    for values in ([8], [-1], [0.5], [[1]]):
        with pytest.raises(ValueError):
            PackedBits(8).encode(np.array(values))
    for dtype in (np.int8, np.uint8, np.float64):
        with pytest.raises(ValueError, match="hold"):
            PackedBits(512).decode(b"", dtype, (0,))


def test_the_width_of_an_index():
    assert [PackedBits(size).width for size in (1, 2, 3, 4, 5, 64, 8192, 65536)] == [1, 1, 2, 2, 3, 6, 13, 16]
    for size in (0, -3, 65537):
        with pytest.raises(ValueError):
            PackedBits(size)
