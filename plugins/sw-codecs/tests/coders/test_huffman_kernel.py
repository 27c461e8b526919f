"""The compiled Huffman decoder against the library's, a symbol at a time."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatwizard_core.api import BitstreamError
from sw_codecs.coders import huffman
from sw_codecs.coders.arithmetic import HEADER
from sw_codecs.coders.huffman import HuffmanCoder
from sw_codecs.coders.model_spec import Table, Tables
from sw_codecs.fast import kernel_operations
from sw_codecs.native import CODECS

pytestmark = pytest.mark.skipif(CODECS.available() is not None, reason=str(CODECS.available()))


@pytest.fixture(params=["kernel", "loop"])
def way(request, monkeypatch):
    CODECS.load()
    monkeypatch.setattr(huffman, "_has_kernel", lambda: request.param == "kernel")
    return request.param


def fibonacci(n):
    found = [1, 1]
    while len(found) < n:
        found.append(sum(found[-2:]))
    return found


RANDOM = np.random.default_rng(7)
TABLES = {
    "two symbols": np.array([[1, 5]]),
    "equal counts": np.ones((3, 37), np.int64),
    "zeros and ties": RANDOM.integers(0, 3, (20, 61)),
    "one count": np.array([[0, 0, 7, 0, 0]]),
    "codes of 71 bits": np.array([fibonacci(72)]),
    "wide counts": np.exp(RANDOM.uniform(0, 20, (5, 300))).astype(int),
    "more tables than symbols of one": RANDOM.integers(1, 9, (3000, 4)),
}


@pytest.mark.parametrize("counts", TABLES.values(), ids=TABLES)
def test_it_decodes_what_the_library_does(counts, way):
    n = 3000
    index, symbols = RANDOM.integers(0, len(counts), n), RANDOM.integers(0, counts.shape[1], n)
    symbols[:2] = 0, counts.shape[1] - 1
    spec = Tables(counts, index)
    data = HuffmanCoder().encode(symbols, spec)
    assert np.array_equal(HuffmanCoder().decode(data, n, spec), symbols)
    found = HuffmanCoder().decode(data, n, spec)
    assert found.dtype == np.int32


def test_damage_is_found(assert_survives_damage, way):
    counts = np.array([[5, 3, 1, 1], [1, 1, 9, 2]])
    index, symbols = np.arange(60) % 2, RANDOM.integers(0, 4, 60)
    spec = Tables(counts, index)
    data = HuffmanCoder().encode(symbols, spec)
    assert_survives_damage(data, lambda d: HuffmanCoder().decode(d, 60, spec), symbols)


@pytest.mark.parametrize("words", [0, 1, 5])
def test_too_few_words_are_named(words, way):
    spec = Table(np.array([2, 1, 1]))
    data = bytearray(HuffmanCoder().encode(np.arange(300) % 3, spec))
    n, kmin, kmax, _, crc = HEADER.unpack(data[: HEADER.size])
    short = HEADER.pack(n, kmin, kmax, 4 * words, crc) + data[HEADER.size : HEADER.size + 4 * words]
    with pytest.raises(BitstreamError):
        HuffmanCoder().decode(short, 300, spec)


def test_the_op_refuses_a_table_that_is_not_there():
    CODECS.load()
    counts, payload = torch.ones(2, 3), torch.zeros(8, dtype=torch.uint8)
    with pytest.raises(RuntimeError, match="a symbol has table 2 of 2"):
        kernel_operations.huffman_decode(payload, counts, torch.tensor([0, 2]))
    with pytest.raises(RuntimeError, match="malformed counts"):
        kernel_operations.huffman_decode(payload, counts[:, :1].contiguous(), torch.tensor([0]))
    assert len(kernel_operations.huffman_decode(payload[:0], counts, torch.tensor([0]))) == 0


def test_without_a_build_nothing_is_compiled(monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    monkeypatch.setattr(type(CODECS), "load_built", lambda self: (_ for _ in ()).throw(huffman.NativeBuildError("off")))
    symbols, spec = np.arange(300) % 3, Table(np.array([2, 1, 1]))
    assert np.array_equal(HuffmanCoder().decode(HuffmanCoder().encode(symbols, spec), 300, spec), symbols)
