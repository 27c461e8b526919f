"""Coder `deflate`: a plain zlib stream that gives every bit back and refuses what it did not write."""

import zlib

import numpy as np
import pytest

from splatwizard_core.api import BitstreamError
from sw_codecs.arrays.deflate import Deflate
from sw_codecs.testing import check_array_coder


@pytest.mark.parametrize(
    "array",
    [
        np.arange(700, dtype=np.uint8).reshape(100, 7),
        np.random.default_rng(0).normal(size=(50, 3)).astype(np.float16),
        np.arange(40, dtype=">u4"),
        np.zeros((0, 5), np.int64),
    ],
    ids=["u8", "f16", "big-endian", "empty"],
)
def test_it_keeps_the_contract(array):
    check_array_coder(Deflate, array)


def test_the_bytes_are_a_zlib_stream_of_the_values():
    values = np.arange(1000, dtype=np.uint16)
    data = Deflate().encode(values)
    assert data[0] == 1
    assert zlib.decompress(data[1:]) == values.astype("<u2").tobytes()


def test_a_bomb_is_not_inflated_and_what_follows_the_stream_is_refused():
    bomb = bytes([1]) + zlib.compress(bytes(10_000_000), 9)
    with pytest.raises(BitstreamError, match="100 bytes"):
        Deflate().decode(bomb, np.uint8, (100,))
    data = Deflate().encode(np.arange(10, dtype=np.uint8))
    for bad in (data + b"x", b"\x02" + data[1:], b"", data[:3] + b"\xff" + data[4:]):
        with pytest.raises(BitstreamError):
            Deflate().decode(bad, np.uint8, (10,))


def test_numbers_without_an_axis_and_objects_are_no_arrays():
    for bad in (np.float32(1), np.array(["a"])):
        with pytest.raises(ValueError, match="deflate is of"):
            Deflate().encode(bad)
