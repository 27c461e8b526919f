"""Small payloads of every format version, written once and never rewritten: every later version must decode them.

`python plugins/sw-codecs/tests/test_golden_codecs.py` writes what is missing in golden/, never what is there.
"""

from pathlib import Path

import numpy as np
import pytest

from sw_codecs.arrays.byte_planes import BytePlanes, FloatDelta
from sw_codecs.arrays.packed_bits import PackedBits
from sw_codecs.coders.arithmetic import RangeCoder, RansCoder
from sw_codecs.coders.huffman import HuffmanCoder
from sw_codecs.coders.model_spec import Tables
from sw_codecs.entropy.bernoulli import Bernoulli
from sw_codecs.entropy.categorical import Categorical, CategoricalContext
from sw_codecs.entropy.columns import Columns
from sw_codecs.entropy.gaussian_exact import GaussianExact, IntegerContext
from sw_codecs.positions import morton
from sw_codecs.positions.octree import Octree

GOLDEN = Path(__file__).parent / "golden"

i = np.arange(300, dtype=np.int64)
mixed = i * 2654435761 % 4294967296 >> 20  # 0..4095, by integer arithmetic alone
points = np.stack([mixed * 5, (mixed * mixed) % 20_000, i // 3 * 200], 1)
points = np.concatenate([points, points[::17]])
points = points[morton.sort(points)]
symbols = (mixed >> 9) + (mixed & 1)
tables = Tables(np.array([[9, 8, 7, 6, 5, 4, 3, 2, 1], [1, 1, 1, 1, 1, 50, 1, 1, 1]]), i % 2)
context = IntegerContext((mixed - 2048) * 11, mixed * 3, 64 + mixed)
residuals = (mixed - 2048) // 300
matrix = np.stack(
    [
        i * 0 + 7,
        mixed & 15,
        mixed,
        i * 3 + (mixed & 3),
        np.where(mixed < 300, 10**9, -5),
        (mixed - 2048) ** 3,
        mixed << 47,
    ],
    axis=1,
)
halves = np.stack([mixed // 16, i * 7 - 1000, mixed & 3], 1).astype(np.int16).reshape(100, 3, 3)
hashes = (i.astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
hashes = ((hashes ^ (hashes >> np.uint64(29))) * np.uint64(0xBF58476D1CE4E5B9)).view(np.int64)  # nothing for zstd
# Ascending, both signs, and every kind of float but NaN: 0, -0, a denormal, the largest, an infinity.
floats = (np.stack([mixed - 2048, i * 3, -i], 1) / 64).astype(np.float32)
floats[:5, 0] = [0.0, -0.0, 1e-45, 3.4028235e38, -np.inf]
categorical = CategoricalContext(9, index=i % 3, tables=3)

CASES = {
    "columns_v1": (lambda: Columns().encode(matrix), lambda d: Columns().decode(d, matrix.shape), matrix),
    "categorical_v1": (
        lambda: Categorical().encode(symbols, categorical),
        lambda d: Categorical().decode(d, categorical),
        symbols,
    ),
    "bernoulli_v1": (lambda: Bernoulli().encode(mixed < 900), lambda d: Bernoulli().decode(d, 300), mixed < 900),
    **dict.fromkeys(
        ("gaussian_exact_v1", "gaussian_exact_v2"),
        (
            lambda: GaussianExact().encode(residuals, context),
            lambda d: GaussianExact().decode(d, context),
            residuals,
        ),
    ),
    "octree_v1": (lambda: Octree().encode(points, 16), Octree().decode, points),
    "byte_planes_v1": (
        lambda: BytePlanes().encode(halves),
        lambda d: BytePlanes().decode(d, halves.dtype, halves.shape),
        halves,
    ),
    "byte_planes_plain_v1": (
        lambda: BytePlanes().encode(hashes),
        lambda d: BytePlanes().decode(d, hashes.dtype, hashes.shape),
        hashes,
    ),
    "float_delta_v1": (
        lambda: FloatDelta().encode(floats),
        lambda d: FloatDelta().decode(d, np.float32, floats.shape),
        floats,
    ),
    "packed_bits_v1": (
        lambda: PackedBits(4096).encode(mixed),
        lambda d: PackedBits(4096).decode(d, np.int64, (300,)),
        mixed,
    ),
    "range": (lambda: RangeCoder().encode(symbols, tables), lambda d: RangeCoder().decode(d, 300, tables), symbols),
    "rans": (lambda: RansCoder().encode(symbols, tables), lambda d: RansCoder().decode(d, 300, tables), symbols),
    "huffman": (
        lambda: HuffmanCoder().encode(symbols, tables),
        lambda d: HuffmanCoder().decode(d, 300, tables),
        symbols,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_golden_payloads_still_decode(name):
    _, decode, expected = CASES[name]
    assert np.array_equal(decode((GOLDEN / f"{name}.bin").read_bytes()), expected)


if __name__ == "__main__":
    GOLDEN.mkdir(exist_ok=True)
    for name, (encode, _, _) in CASES.items():
        if not (GOLDEN / f"{name}.bin").exists():
            (GOLDEN / f"{name}.bin").write_bytes(encode())
