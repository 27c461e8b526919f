"""Streams of the exact mode: the same bytes from the kernel and from the library, and no trust in their table."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from sw_codecs.bits.packing import ByteReader, write_varint
from sw_codecs.entropy import exact_streams
from sw_codecs.entropy.lattice import lattice

N = 2 * exact_streams.STREAM + 777


def drawn(n, seed=0):
    """Symbols, some of them escapes, with the integer parts of their means and the numbers of their tables."""
    r = np.random.default_rng(seed)
    mean, scale = r.integers(-400_000, 400_000, (n, 1)), np.exp(r.uniform(0, 12.5, (n, 1))).astype(np.int64)
    centre, number = lattice(mean, scale, r.integers(64, 16_385, (n, 1)))
    symbols = centre + np.rint(r.normal(size=n) * scale[:, 0] / 2000).astype(np.int64)
    symbols[::97] += r.integers(-(2**29), 2**29, len(symbols[::97]))
    return symbols, centre, number


@pytest.fixture(scope="module")
def long():
    """Three streams: their symbols and parameters."""
    return drawn(N)


@pytest.mark.parametrize("family", ["gaussian", "laplace"])
def test_kernel_and_library_write_the_same_bytes_and_read_them(family, long, kernels):
    coded = {}
    for compiled in (True, False):
        kernels(compiled)
        coded[compiled] = exact_streams.encode(family, *long)
    assert coded[True] == coded[False]
    for compiled in (True, False):
        kernels(compiled)
        assert np.array_equal(exact_streams.decode(family, coded[True], *long[1:]), long[0])
    bits = exact_streams.table_bits(family, *long).sum()
    assert bits / 8 < len(coded[True]) < 1.002 * bits / 8 + 100


def test_words_that_do_not_decode_are_noticed_while_encoding(kernels, monkeypatch):
    kernels(False)
    write = exact_streams._encoded_in_turn

    def damaged(*given):
        content, rows = write(*given)
        return bytes([content[0] ^ 1]) + content[1:], rows

    monkeypatch.setattr(exact_streams, "_encoded_in_turn", damaged)
    with pytest.raises(RuntimeError, match="encoded"):
        exact_streams.encode("gaussian", *drawn(500))


def test_symbols_and_bytes_do_not_depend_on_the_number_of_threads(long, kernels):
    kernels(True)
    kept, found = torch.get_num_threads(), set()
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            data = exact_streams.encode("gaussian", *long)
            found.add((data, exact_streams.decode("gaussian", data, *long[1:]).tobytes()))
    finally:
        torch.set_num_threads(kept)
    assert len(found) == 1


parameters = st.lists(
    st.tuples(
        st.integers(-(2**35), 2**35) | st.integers(-40_000, 40_000),
        st.integers(-(2**47), 2**47) | st.integers(-1, 400_000),
        st.integers(64, 16_384) | st.sampled_from([64, 4096, 16_384]),
        st.booleans(),
    ),
    min_size=1,
    max_size=70,
)


@settings(max_examples=60, deadline=None)
@given(parameters)
def test_the_lattice_of_the_kernel_is_integer_arithmetic(rows):
    """One row of many columns, and as many rows of one."""
    mean, scale, step, there = (np.array(each) for each in zip(*rows, strict=True))
    centre, number = [], []
    thresholds = exact_streams.exact_tables().thresholds.tolist()
    for mu, sigma, m, ok in zip(mean.tolist(), scale.tolist(), step.tolist(), there.tolist(), strict=True):
        eighths = (8 * mu + m // 2) // m
        if ok:
            centre.append((eighths + 4) // 8)
            level = sum(t < (max(sigma, 0) << 12) // m for t in thresholds)
            number.append(level * 8 + eighths + 4 - 8 * centre[-1])
    found = lattice(mean[:, None], scale[:, None], step[:, None], there[:, None])
    assert [each.tolist() for each in found] == [centre, number]
    alone = lattice(mean[None], scale[None], step[:1, None])
    again = lattice(mean[:, None], scale[:, None], np.full((len(mean), 1), step[0]))
    assert all(np.array_equal(a, b) for a, b in zip(alone, again, strict=True))


@pytest.mark.parametrize("compiled", [True, False])
def test_damage_is_found(compiled, kernels, assert_survives_damage):
    symbols, centre, number = drawn(60, seed=1)
    kernels(compiled)
    data = exact_streams.encode("gaussian", symbols, centre, number)
    assert_survives_damage(data, lambda d: exact_streams.decode("gaussian", d, centre, number), symbols)


def damaged(data, change):
    """Three streams whose table was changed."""
    reader = ByteReader(data)
    head = bytes(reader.take(6))
    rows = [[reader.integer(4), reader.varint(2**40), reader.varint(2**40)] for _ in range(3)]
    change(rows)
    table = b"".join(row[0].to_bytes(4, "little") + write_varint(row[1]) + write_varint(row[2]) for row in rows)
    return head + table + bytes(reader.take(reader.left))


def moved(rows):
    rows[0][1] += 4
    rows[1][1] -= 4


def swapped(rows):
    rows[0], rows[1] = rows[1], rows[0]


def huge(rows):
    rows[1][1] = 2**39


def odd(rows):
    rows[0][1] -= 1
    rows[0][2] += 1


def no_escapes(rows):
    rows[2][1] += rows[2][2] // 4 * 4
    rows[2][2] %= 4


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("change", [moved, swapped, huge, odd, no_escapes, list.pop])
def test_a_table_of_streams_is_not_believed(change, compiled, long, kernels):
    kernels(True)
    data = exact_streams.encode("gaussian", *long)
    kernels(compiled)
    with pytest.raises(BitstreamError):
        exact_streams.decode("gaussian", damaged(data, change), *long[1:])


def test_more_symbols_than_there_are_bytes_for_are_refused_at_once():
    zeros = np.zeros(N, np.int64)
    with pytest.raises(BitstreamError, match="cannot hold 3 streams"):
        exact_streams.decode("gaussian", exact_streams.prefix() + bytes(17), zeros, zeros)


def test_a_later_version_is_named():
    with pytest.raises(BitstreamError, match="coded with exact tables 3"):
        exact_streams.decode("gaussian", b"\x03" + exact_streams.prefix()[1:], np.zeros(0), np.zeros(0))
