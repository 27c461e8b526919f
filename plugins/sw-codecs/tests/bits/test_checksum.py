"""The checksum is zlib's, whoever computes it."""

import importlib
import sys
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sw_codecs.bits import checksum


@given(st.lists(st.binary(max_size=300), max_size=4), st.integers(0, 2**32 - 1))
def test_it_is_that_of_zlib_piece_after_piece(pieces, start):
    ours = theirs = start
    for piece in pieces:
        ours, theirs = checksum.crc32(piece, ours), zlib.crc32(piece, theirs)
    assert ours == theirs


@pytest.mark.parametrize("dtype", ["<i4", "<i8", "<f8"])
@pytest.mark.parametrize("length", [0, 1, 7, 1 << 12, (1 << 16) + 3])
def test_it_takes_arrays_from_any_address_on(dtype, length):
    bytes_ = np.random.default_rng(length).integers(0, 256, 8 * length + 5, np.uint8)
    values = bytes_[5:][: length * np.dtype(dtype).itemsize].view(dtype)
    assert checksum.crc32(values) == checksum.crc32(memoryview(values)) == zlib.crc32(values.tobytes())


def test_without_the_fast_library_it_is_zlib_itself(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "zlib_ng.zlib_ng", None)
        assert importlib.reload(checksum).crc32 is zlib.crc32
    importlib.reload(checksum)
