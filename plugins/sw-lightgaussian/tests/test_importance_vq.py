"""The coder importance-vq: which vectors keep their own, that the parts decode alone, and that bad ones are refused."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.errors import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_lightgaussian.importance_vq import HEADER, RANGE_CODED

PARTS = ["header", "mask", "indices", "codebook", "own"]
QUICK = {"iterations": 30, "batch": 1000}


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


@pytest.fixture(scope="module")
def make(plugins):
    coder = plugins.coders.load("importance-vq")
    return lambda **values: coder(plugins, **{**QUICK, **values})


def clusters(n=600, d=27, count=12, spread=0.05, seed=0):
    r = np.random.default_rng(seed)
    centers = r.normal(size=(count, d))
    rows = centers[r.integers(0, count, n)] + spread * r.normal(size=(n, d))
    return rows.astype(np.float32), r.gamma(1, size=n)


def test_the_important_ones_keep_their_own_and_the_others_are_rows_of_the_codebook(make):
    vectors, importance = clusters()
    coder = make(ratio=0.6)
    coded = coder.quantize(vectors, importance)
    keeps = coded.codes < 0
    assert keeps.sum() == 240  # floor(0.4 * 600), although 1 - 0.6 is not 0.4
    assert importance[keeps].min() >= importance[~keeps].max()
    decoded = coder.decode(coder.encode(vectors, importance), 600, 27)
    assert np.array_equal(decoded[keeps], vectors[keeps].astype(np.float16).astype(np.float32))
    assert np.array_equal(decoded[~keeps], coded.codebook[coded.codes[~keeps]].astype(np.float32))
    # The nearest entry of the codebook as it is stored.
    distances = ((vectors[~keeps, None] - coded.codebook[None].astype(np.float32)) ** 2).sum(-1)
    chosen = distances[np.arange(len(distances)), coded.codes[~keeps]]
    assert chosen == pytest.approx(distances.min(1), rel=1e-4, abs=1e-5)
    assert np.abs(decoded - vectors).max() < 0.6


@pytest.mark.parametrize(("ratio", "n", "kept"), [(0.9, 10, 1), (0.7, 1000, 300), (0.0, 7, 7), (1.0, 7, 0)])
def test_how_many_are_kept_is_what_was_meant(make, ratio, n, kept):
    vectors, importance = clusters(n)
    coder = make(ratio=ratio)
    assert (coder.quantize(vectors, importance).codes < 0).sum() == kept
    decoded = coder.decode(coder.encode(vectors, importance), n, 27)
    assert decoded.shape == (n, 27)
    if kept == n:
        assert np.array_equal(decoded, vectors.astype(np.float16).astype(np.float32))


def test_of_equally_important_vectors_the_first_are_kept(make):
    vectors, _ = clusters(10)
    assert (make(ratio=0.5).quantize(vectors, np.ones(10)).codes < 0).tolist() == [True] * 5 + [False] * 5


def test_one_seed_gives_one_file(make):
    vectors, importance = clusters(2000)
    parts = make().encode(vectors, importance, seed=4)
    assert list(parts) == PARTS
    torch.manual_seed(99)
    assert make().encode(vectors, importance, seed=4) == parts
    assert make().encode(vectors, importance, seed=5) != parts


def test_what_is_unpacked_packs_to_the_same_bytes(make):
    vectors, importance = clusters(900)
    coder = make()
    parts = coder.encode(vectors, importance)
    assert coder.pack(coder.unpack(parts, 900, 27)) == parts


@pytest.mark.parametrize("n", [0, 1, 2, 3, 5])
@pytest.mark.parametrize("ratio", [0.0, 0.6, 1.0])
def test_a_handful_of_vectors(make, n, ratio):
    vectors, importance = clusters(n, d=3)
    coder = make(ratio=ratio)
    decoded = coder.decode(coder.encode(vectors, importance), n, 3)
    assert np.abs(decoded - vectors).max(initial=0) < 3  # fewer codes than vectors: no better


def test_as_many_codes_as_distinct_vectors_lose_only_what_float16_loses(make):
    distinct, _ = clusters(16, count=16)
    vectors = np.repeat(distinct, 8, axis=0)
    coder = make(ratio=1.0, size=128, rows_per_code=1, reseed=0)
    decoded = coder.decode(coder.encode(vectors, np.ones(128)), 128, 27)
    assert np.abs(decoded - vectors).max() < 2e-3


def test_the_codebook_is_never_larger_than_rows_per_code_allow_and_holds_only_what_is_used(make):
    assert make().codebook_size(80_000) == 8192
    assert make().codebook_size(4 * 1000) == 512
    assert make(rows_per_code=1).codebook_size(1000) == 512
    assert make().codebook_size(1) == 2
    vectors, importance = clusters(2000, count=5, spread=0.0)
    coded = make(ratio=1.0).quantize(vectors, importance)
    assert np.array_equal(np.unique(coded.codes), np.arange(len(coded.codebook)))
    assert len(coded.codebook) <= 256


def test_popular_codes_make_short_indices(make):
    r = np.random.default_rng(0)
    centers = r.normal(size=(64, 27))
    rows = centers[np.minimum(r.geometric(0.3, 4000) - 1, 63)].astype(np.float32)
    coder = make(ratio=1.0, size=64, iterations=5)
    parts = coder.encode(rows, np.ones(4000))
    assert HEADER.unpack(parts["header"])[1] == RANGE_CODED
    assert np.array_equal(coder.decode(parts, 4000, 27), coder.quantize(rows, np.ones(4000)).vectors())


def test_values_beyond_float16_are_clamped_and_what_is_no_number_is_refused(make):
    vectors, importance = clusters(20)
    vectors[0, 0] = 1e6
    coder = make(ratio=0.0)
    assert coder.decode(coder.encode(vectors, importance), 20, 27)[0, 0] == 65504
    vectors[0, 0] = np.nan
    with pytest.raises(ValueError, match="not a number"):
        coder.encode(vectors, importance)


def test_unseen_vectors_have_no_weight_and_no_importance_at_all_is_fine(make):
    vectors, importance = clusters(100)
    importance[::2] = -np.inf
    assert set(np.flatnonzero(make(ratio=0.5).quantize(vectors, importance).codes < 0)) == set(range(1, 100, 2))
    make(ratio=0.5).encode(vectors, np.full(100, -np.inf))


def weighted_error(make, training, seed):
    vectors, importance = clusters(2000, count=40, spread=0.2, seed=seed)
    coder = make(ratio=1.0, size=32, iterations=100 if training != "kmeans" else 5, training=training)
    coded = coder.quantize(vectors, importance)
    distance = ((coded.vectors() - vectors) ** 2).sum(1)
    return float((importance * distance).sum() / importance.sum()), len(coded.codebook) / 32


@pytest.mark.parametrize("seed", range(3))
def test_the_default_training_is_no_worse_than_that_of_the_authors_code(make, seed):
    error, used = weighted_error(make, "ema", seed)
    assert error <= weighted_error(make, "official", seed)[0]
    assert weighted_error(make, "kmeans", seed)[0] < 1.2 * error
    assert used > 0.9


def test_a_single_code_is_the_mean_of_the_batches(make):
    vectors, _ = clusters(500)
    coded = make(ratio=1.0, size=1, iterations=60, batch=100_000).quantize(vectors, np.ones(500))
    assert coded.codebook[0] == pytest.approx(vectors.mean(0), abs=0.06)


def test_more_codes_lose_less(make):
    vectors, importance = clusters(2000, count=400, spread=0.1)
    errors = []
    for size in (4, 16, 64, 256):
        coder = make(ratio=1.0, size=size)
        errors.append(float(((coder.decode(coder.encode(vectors, importance), 2000, 27) - vectors) ** 2).mean()))
    assert errors == sorted(errors, reverse=True)


def forged(parts, **header):
    names = ("version", "form", "n", "size", "own")
    fields = {**dict(zip(names, HEADER.unpack(parts["header"]), strict=True)), **header}
    return {**parts, "header": HEADER.pack(*fields.values())}


def test_parts_that_make_no_sense_are_refused(make):
    vectors, importance = clusters(100)
    coder = make()
    parts = coder.encode(vectors, importance)
    wrong = [
        *({name: data for name, data in parts.items() if name != missing} for missing in parts),
        *({**parts, name: parts[name][:-1]} for name in parts),
        *({**parts, name: parts[name] + b"\0"} for name in parts),
        forged(parts, version=2), forged(parts, form=2), forged(parts, size=0), forged(parts, size=4_000_000_000),
        forged(parts, own=101), forged(parts, own=39), forged(parts, size=61),
    ]  # fmt: skip
    for each in wrong:
        with pytest.raises(BitstreamError):
            coder.decode(each, 100, 27)
    for n, d in ((99, 27), (101, 27), (100, 26), (10**9, 27)):
        with pytest.raises(BitstreamError):
            coder.decode(parts, n, d)


@settings(max_examples=50, deadline=None)
@given(st.data())
def test_damage_is_refused_or_gives_finite_vectors(make, data):
    vectors, importance = clusters(60, d=3)
    coder = make(iterations=2)
    parts = coder.encode(vectors, importance)
    name = data.draw(st.sampled_from(PARTS))
    damaged = bytearray(parts[name])
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        decoded = coder.decode({**parts, name: bytes(damaged)}, 60, 3)
    except BitstreamError:
        return
    assert np.isfinite(decoded).all()
