"""Fixed-width packing, varints, zigzag, magnitude classes and Exp-Golomb codes invert."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.bits import exp_golomb
from sw_codecs.bits import packing as bits

unsigned = st.integers(0, 2**64 - 1) | st.sampled_from([2**k + d for k in range(1, 64) for d in (-1, 0, 1)])
signed = st.integers(-(2**63), 2**63 - 1)


@given(st.lists(signed, max_size=20))
def test_zigzag_inverts_over_all_64_bits(values):
    array = np.array(values, np.int64)
    assert bits.unzigzag(bits.zigzag(array)).tolist() == values


def test_zigzag_orders_by_magnitude():
    assert bits.zigzag(np.array([0, -1, 1, -2, 2])).tolist() == [0, 1, 2, 3, 4]


@given(st.lists(unsigned, min_size=1, max_size=20))
def test_bit_length_is_that_of_python(values):
    assert bits.bit_length(np.array(values, np.uint64)).tolist() == [v.bit_length() for v in values]


@given(st.lists(unsigned, min_size=1, max_size=20), st.integers(0, 6))
def test_class_and_raw_bits_give_the_value_back(values, mantissa):
    array = np.array(values, np.uint64)
    classes, extra = bits.split_classes(array, mantissa)
    assert (bits.class_bits(classes, mantissa) == extra).all()
    raw = array & ((np.uint64(1) << extra.astype(np.uint64)) - np.uint64(1))
    assert ((bits.class_floor(classes, mantissa) | raw) == array).all()


def test_classes_have_no_gaps_and_rise():
    classes = bits.split_classes(np.arange(5000), 3)[0]
    assert set(np.diff(classes)) == {0, 1}
    assert classes[:16].tolist() == list(range(16))


@given(st.integers(0, 64).flatmap(lambda w: st.tuples(st.just(w), st.lists(st.integers(0, 2**w - 1), max_size=20))))
def test_fixed_width_packing_inverts(case):
    width, values = case
    array = np.array(values, np.uint64)
    data = bits.pack_fixed(array, width)
    assert len(data) == bits.packed_size(len(values), width)
    assert bits.unpack_fixed(data, len(values), width).tolist() == values


def test_unpacking_refuses_wrong_lengths_and_padding():
    data = bits.pack_fixed(np.array([1, 2, 3]), 3)
    with pytest.raises(BitstreamError):
        bits.unpack_fixed(data + b"\x00", 3, 3)
    with pytest.raises(BitstreamError):
        bits.unpack_fixed(data[:1] + b"\xff", 3, 3)


@given(st.integers(0, 2**64 - 1), signed)
def test_varints_invert(value, number):
    reader = bits.ByteReader(bits.write_varint(value) + bits.write_signed(number))
    assert reader.varint(2**64 - 1) == value
    assert reader.signed() == number
    reader.finish()


@pytest.mark.parametrize("data", [b"", b"\x80", b"\x80\x00", b"\xff" * 10, b"\xff" * 11, b"\x05"])
def test_bad_varints_are_refused(data):
    with pytest.raises(BitstreamError):
        bits.ByteReader(data).varint(4)


@settings(deadline=None)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 2**36)), max_size=30))
def test_exp_golomb_inverts(values):
    negative = np.array([v[0] for v in values], bool)
    magnitudes = np.array([v[1] for v in values], np.int64)
    found = exp_golomb.decode(exp_golomb.encode(negative, magnitudes), len(values))
    assert found[0].tolist() == negative.tolist()
    assert found[1].tolist() == magnitudes.tolist()


def test_exp_golomb_codes_worked_out_by_hand():
    # +0 -> 0 1; -3 -> 1 00 100: bits 0 1 1 0 0 1 0 0 from the least significant
    assert exp_golomb.encode(np.array([False, True]), np.array([0, 3])) == bytes([0b00100110])


@settings(deadline=None, max_examples=200)
@given(st.binary(max_size=12), st.integers(0, 60))
def test_exp_golomb_decodes_any_bytes_or_refuses(data, count):
    try:
        negative, magnitudes = exp_golomb.decode(data, count)
    except BitstreamError:
        return
    assert exp_golomb.encode(negative, magnitudes) == data
