"""The coder `residual-vq`: what comes back, what it costs, what it refuses."""

import numpy as np
import pytest
import torch

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.quantizers.residual_quantizer import ResidualVectorQuantizer
from sw_codecs.vectors.residual_vq import HEADER, ResidualVQ

PLUGINS = load_plugins()
N, D = 700, 3


def vectors(n: int = N, d: int = D) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(n, d)).astype(np.float32)


def make(**settings) -> ResidualVQ:
    return ResidualVQ(PLUGINS, **{"size": 16, "stages": 4, "iterations": 3, **settings})


def encode(coder: ResidualVQ, x: np.ndarray) -> dict[str, bytes]:
    return coder.encode(x, np.ones(len(x)))


@pytest.mark.parametrize("coder", ["huffman", "range", "rans", "packed-bits"])
@pytest.mark.parametrize("half", [False, True])
def test_every_coder_of_indices_gives_the_same_vectors(coder, half):
    x = vectors()
    found = ResidualVQ(PLUGINS).decode(encode(make(coder=coder, half=half), x), N, D)
    expected = ResidualVQ(PLUGINS).decode(encode(make(half=half), x), N, D)
    assert np.array_equal(found, expected)
    assert np.abs(found - x).mean() < 0.2 * np.abs(x).mean()


def test_trained_codebooks_are_kept_to_the_bit():
    x, books = vectors(), torch.randn(4, 16, D, generator=torch.Generator().manual_seed(1))
    coder = make(codebooks=books)
    quantizer = ResidualVectorQuantizer(16, 4, dim=D)
    quantizer.codebooks.data = books
    parts = encode(coder, x)
    assert parts["codebooks"] == books.numpy().tobytes()
    found = ResidualVQ(PLUGINS).decode(parts, N, D)
    assert torch.equal(torch.from_numpy(found), quantizer.forward(torch.from_numpy(x)).detach())


def test_codebooks_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="codebooks"):
        encode(make(codebooks=torch.zeros(4, 16, D + 1)), vectors())


def test_more_stages_leave_less():
    x = vectors()
    errors = [
        np.square(ResidualVQ(PLUGINS).decode(encode(make(stages=s), x), N, D) - x).mean() for s in (1, 2, 3, 4, 6)
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.02 * errors[0]


def test_packed_indices_take_six_bits_and_huffman_within_one_bit_of_the_entropy():
    x = np.square(vectors(5000))  # uneven use of the entries
    packed = encode(make(size=64, stages=6, coder="packed-bits"), x)
    assert len(packed["indices"]) == 5000 * 6 * 6 // 8
    assert len(packed["codebooks"]) == 6 * 64 * D * 4
    coder = make(size=64, stages=6)
    symbols = coder._unpack(packed["indices"], 5000, 6, 64, "packed-bits")
    entropy = 0.0
    for stage in symbols.T:
        share = np.bincount(stage, minlength=64) / len(stage)
        entropy -= float((share[share > 0] * np.log2(share[share > 0])).sum())
    bits = 8 * len(encode(coder, x)["indices"]) / 5000
    assert entropy < bits < entropy + 6  # a bit for each of six symbols, tables included


def test_every_index_comes_back():
    """64^6 sums: the indices of all stages are independent of each other."""
    symbols = np.random.default_rng(2).integers(0, 64, (900, 6))
    coder = make(size=64, stages=6)
    assert np.array_equal(coder._unpack(coder._pack(symbols), 900, 6, 64, "huffman"), symbols)
    constant = np.zeros((50, 6), np.int64)  # alphabets of a single symbol
    assert np.array_equal(coder._unpack(coder._pack(constant), 50, 6, 64, "huffman"), constant)


def test_importance_moves_the_codebooks_and_none_is_equal_importance():
    x = vectors()
    weights = np.zeros(N)
    weights[:100] = 1
    near = ResidualVQ(PLUGINS).decode(make().encode(x, weights), N, D)[:100]
    even = ResidualVQ(PLUGINS).decode(make().encode(x, np.zeros(N)), N, D)[:100]
    assert np.square(near - x[:100]).mean() < np.square(even - x[:100]).mean()
    assert make().encode(x, np.zeros(N)) == make().encode(x, np.full(N, 3.0))


def test_damage_is_an_error():
    parts = encode(make(), vectors())
    rest = parts["header"][HEADER.size :]

    def header(*values, name=rest):
        return {**parts, "header": HEADER.pack(*values) + name}

    for bad in (
        header(2, 0, 4, 16, N), header(1, 2, 4, 16, N), header(1, 1, 4, 16, N), header(1, 0, 0, 16, N),
        header(1, 0, 4, 0, N), header(1, 0, 4, 17, N), header(1, 0, 3, 16, N), header(1, 0, 4, 16, N + 1),
        header(1, 0, 17, 16, N), header(1, 0, 4, 16, N, name=b""), header(1, 0, 4, 16, N, name=b"octree"),
        header(1, 0, 4, 16, N, name=b"\xff"), header(1, 0, 4, 16, N, name=b"packed-bits"),
        {**parts, "header": b""}, {**parts, "indices": b""}, {**parts, "codebooks": parts["codebooks"] + b"1234"},
        {**parts, "codebooks": b"\xff" * len(parts["codebooks"])},  # NaN
    ):  # fmt: skip
        with pytest.raises(BitstreamError):
            ResidualVQ(PLUGINS).decode(bad, N, D)
    nothing = encode(make(), vectors()[:0])
    with pytest.raises(BitstreamError, match="empty"):
        ResidualVQ(PLUGINS).decode({**nothing, "indices": b"1"}, 0, D)


def test_wrong_use_is_refused():
    for wrong in ({"size": 0}, {"size": 1 << 16}, {"stages": 0}, {"stages": 17}, {"iterations": -1}):
        with pytest.raises(ValueError, match="must be"):
            ResidualVQ(PLUGINS, **wrong)
    with pytest.raises(ValueError, match="finite"):
        encode(make(), np.full((5, 3), np.nan, np.float32))
