"""Every installed provider of a coding contract, of whichever package of ours, keeps it."""

import numpy as np
import pytest
import torch

from splatwizard_core.api import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from sw_codecs import testing
from sw_codecs.testing import EntropyCase

PLUGINS = load_plugins()
KINDS = ("entropy model", "context model", "coder")


def ours(names):
    """Names in one registry or view that packages of ours provide: a stranger's package has tests of its own."""
    entries = {entry.name: entry for kind in KINDS for entry in PLUGINS.registries[kind]}
    return [name for name in names if is_ours(entries[name].distribution)]


def own(names):
    """Names in one registry or view that this package provides."""
    entries = {entry.name: entry for kind in KINDS for entry in PLUGINS.registries[kind]}
    return [name for name in names if entries[name].distribution == "sw-codecs"]


def rng(seed=0):
    return np.random.default_rng(seed)


def gaussian_case(n):
    """Symbols that follow their distributions; parameters as integers with 12 fractional bits."""
    r = rng()
    mean, scale = r.normal(0, 20, n), r.uniform(0.5, 8, n)
    symbols = np.rint(r.normal(mean, scale)).astype(np.int64)
    model = PLUGINS.entropy_models.load("gaussian-exact")
    floats = model.FloatContext(torch.from_numpy(mean), torch.from_numpy(scale))
    integers = model.IntegerContext(*(np.rint(4096 * each).astype(np.int64) for each in (mean, scale)))
    return EntropyCase(symbols, integers, floats, integers)


def rows_case(n):
    r, rows = rng(), (n + 4) // 5
    mean, scale, step = r.normal(0, 20, (rows, 5)), r.uniform(0.5, 8, (rows, 5)), r.uniform(0.5, 1.5, (rows, 1))
    symbols = np.rint(r.normal(mean, scale) / step).astype(np.int64)
    context = PLUGINS.entropy_models.load("conditional-gaussian").Context(
        *(np.rint(4096 * each).astype(np.int64) for each in (mean, scale, step))
    )
    return EntropyCase(symbols, context, context, context)


def row_mixtures_case(n):
    r, rows = rng(), (n + 4) // 5
    parameters = [r.normal(0, 20, (rows, 5)), r.uniform(0.5, 8, (rows, 5)), r.normal(9, 20, (rows, 5)),
                  r.uniform(0.5, 8, (rows, 5)), r.normal(0, 2, (rows, 5)), r.uniform(0.5, 1.5, (rows, 1))]  # fmt: skip
    mean, scale, second_mean, second_scale, logit, step = parameters
    first = r.random((rows, 5)) < 1 / (1 + np.exp(-logit))
    values = np.where(first, r.normal(mean, scale), r.normal(second_mean, second_scale))
    context = PLUGINS.entropy_models.load("conditional-mixture").Context(
        *(np.rint(4096 * each).astype(np.int64) for each in parameters)
    )
    return EntropyCase(np.rint(values / step).astype(np.int64), context, context, context)


def columns_case(n):
    rows = (n + 1) // 2
    symbols = np.rint(rng().normal(0, [3, 40], (rows, 2))).astype(np.int64)
    return EntropyCase(symbols, None, None, symbols.shape)


def categorical_case(n):
    index = rng(1).integers(0, 2, n)
    symbols = np.minimum(rng().geometric(np.array([0.6, 0.2])[index]) - 1, 31)
    context = PLUGINS.entropy_models.load("categorical").Context(32, index=index, tables=2)
    return EntropyCase(symbols, context, context, context)


def bernoulli_case(n):
    return EntropyCase(rng().random(n) < 0.3, None, None, n)


ENTROPY_CASES = {
    "columns": columns_case,
    "categorical": categorical_case,
    "bernoulli": bernoulli_case,
    "gaussian-exact": gaussian_case,
    "conditional-gaussian": rows_case,
    "conditional-mixture": row_mixtures_case,
}
"""Context and symbols for each entropy model, since these differ; a new model needs one here."""

CONTEXT_INPUTS = {
    "integer-mlp": lambda load: (
        load.from_module(torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.ReLU(), torch.nn.Linear(4, 2))),
        torch.arange(30).reshape(10, 3),
    ),
}

ARRAYS = {
    "byte-planes": np.arange(60, dtype=np.float32).reshape(20, 3) / 7,
    "float-delta": np.arange(60, dtype=np.float32).reshape(20, 3) / 7,
    "packed-bits": np.arange(40, dtype=np.int64) * 1000,
}

QUICK = {
    "importance-vq": {"iterations": 5, "batch": 100},
    "vectree": {"iterations": 5, "batch": 100},
    "raht": {"vq_steps": 5},
}
"""Settings with which a coder that trains a codebook takes no minutes."""


@pytest.mark.parametrize("name", own(PLUGINS.entropy_models.names))
def test_entropy_models(name):
    testing.check_entropy_model(PLUGINS.entropy_models.load(name), ENTROPY_CASES[name])


@pytest.mark.parametrize("name", own(PLUGINS.context_models.names))
def test_context_models(name):
    testing.check_context_model(*CONTEXT_INPUTS[name](PLUGINS.context_models.load(name)))


@pytest.mark.parametrize("name", ours(PLUGINS.entropy_coders.names))
def test_entropy_coders(name):
    counts = np.array([9, 8, 7, 6, 5, 4, 3, 2, 1])
    testing.check_entropy_coder(PLUGINS.entropy_coders.load(name), counts, rng().integers(0, 9, 300))


@pytest.mark.parametrize("name", ours(PLUGINS.position_codecs.names))
def test_position_codecs(name):
    points = rng().integers(0, 1 << 10, (200, 3))
    testing.check_position_codec(PLUGINS.position_codecs.load(name), np.concatenate([points, points[:20]]), 10)


@pytest.mark.parametrize("name", ours(PLUGINS.array_coders.names))
def test_array_coders(name):
    testing.check_array_coder(PLUGINS.array_coders.load(name), ARRAYS.get(name, ARRAYS["byte-planes"]))


@pytest.mark.parametrize("name", ours(PLUGINS.vector_coders.names))
def test_vector_coders(name):
    vectors = rng().normal(size=(200, 6)).astype(np.float32)
    testing.check_vector_coder(PLUGINS.vector_coders.load(name), PLUGINS, vectors, **QUICK.get(name, {}))


@pytest.mark.parametrize("n", [0, 300])
@pytest.mark.parametrize("name", ours(PLUGINS.gaussian_codecs.names))
def test_gaussian_codecs(name, n):
    g = torch.Generator().manual_seed(3)
    tails = ((3,), (1, 3), (8, 3), (), (3,), (4,))
    model = GaussianModel(*(torch.randn(n, *tail, generator=g) for tail in tails))
    codec = PLUGINS.gaussian_codecs.load(name)
    decoded = testing.check_gaussian_codec(codec, PLUGINS, model, **QUICK.get(name, {}))
    assert decoded.num_rows <= n
    assert all(bool(torch.isfinite(parameter).all()) for parameter in decoded.parameters())
    if n:
        assert decoded.num_rows > 0


def test_every_coder_says_what_it_codes():
    views = (PLUGINS.entropy_coders, PLUGINS.position_codecs, PLUGINS.array_coders, PLUGINS.vector_coders)
    typed = [name for view in (*views, PLUGINS.gaussian_codecs) for name in view.names]
    assert sorted(ours(typed)) == ours(PLUGINS.coders.names)


class Broken:
    """A coder of arrays that keeps nothing but the number of its bytes."""

    def encode(self, array):
        return array.tobytes()

    def decode(self, data, dtype, shape):
        return np.zeros(shape, dtype)


class Dicing(Broken):
    def encode(self, array):
        return np.random.default_rng().bytes(8)


@pytest.mark.parametrize(
    ("coder", "reason"), [(Broken, "bit for bit"), (Dicing, "repeatable"), (dict, "lacks .*encode")]
)
def test_a_provider_that_breaks_the_contract_is_told_how(coder, reason):
    with pytest.raises(AssertionError, match=reason):
        testing.check_array_coder(coder, ARRAYS["byte-planes"])
