"""Coder `sensitivity-vq`: what is sensitive comes back within half a step, damage is refused, others may use it."""

import numpy as np
import pytest

from splatwizard_core.api import BitstreamError
from splatwizard_core.plugins import load_plugins
from sw_codecs.testing import check_vector_coder
from sw_codecs.vectors.sensitivity_vq import HEADER, SensitivityVQ, index_dtype


@pytest.fixture(scope="module")
def plugins():
    return load_plugins()


def clusters(n=300, d=9, seed=0):
    g = np.random.default_rng(seed)
    centres = g.normal(size=(6, d))
    return (centres[g.integers(6, size=n)] + 0.02 * g.normal(size=(n, d))).astype(np.float32), g.random(n)


SHORT = {"size": 16, "iterations": 20, "batch": 128}


@pytest.mark.parametrize("training", ["batch-mean", "kmeans"])
def test_it_keeps_the_contract(plugins, training):
    check_vector_coder(SensitivityVQ, plugins, clusters()[0], threshold=200, training=training, **SHORT)


def test_sensitive_vectors_are_exact_to_half_a_step_and_the_others_near_to_their_entry(plugins):
    x, sensitivity = clusters()
    coder = SensitivityVQ(plugins, threshold=0.7, training="kmeans", **SHORT)
    parts = coder.encode(x, sensitivity)
    found = SensitivityVQ(plugins).decode(parts, *x.shape)
    steps = np.frombuffer(parts["lattice"], "<f4", x.shape[1])
    own = sensitivity > 0.7
    assert (np.abs(found - x)[own] <= 0.51 * steps).all()
    assert len(np.unique(found[~own], axis=0)) <= 16
    assert np.abs(found - x).max() < 0.3


def test_it_is_a_coder_of_vectors_that_any_method_may_name(plugins):
    assert "sensitivity-vq" in plugins.vector_coders.names
    x, sensitivity = clusters(40)
    made = plugins.vector_coders.load("sensitivity-vq")(plugins)
    assert made.decode(made.encode(x, sensitivity), *x.shape).shape == x.shape


def test_more_than_65536_entries_have_longer_indices():
    assert (index_dtype(1 << 16), index_dtype((1 << 16) + 1)) == (np.dtype(np.uint16), np.dtype(np.uint32))


def test_damage_is_told(plugins):
    x, sensitivity = clusters(50)
    coder = SensitivityVQ(plugins, threshold=0.5, training="kmeans", **SHORT)
    parts = coder.encode(x, sensitivity)
    version, n, size = HEADER.unpack(parts["header"])
    lattice = parts["lattice"]
    for name, data, told in (
        ("header", HEADER.pack(version + 1, n, size), "upgrade sw-codecs"),
        ("header", HEADER.pack(version, n + 1, size), "expected 50"),
        ("header", HEADER.pack(version, n, size - 1), "outside the codebook"),
        ("header", HEADER.pack(version, n, 51), "51 entries"),
        ("lattice", np.full(9, np.nan, "<f4").tobytes() + lattice[36:], "finite"),
        ("lattice", lattice[:36] + np.full(9, 2**30, "<i4").tobytes(), "zero"),
        ("index", parts["entries"], "byte"),
    ):
        with pytest.raises(BitstreamError, match=told):
            coder.decode({**parts, name: data}, *x.shape)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e35])
def test_values_that_no_lattice_holds_are_refused(plugins, bad):
    x, sensitivity = clusters(20)
    x[3, 2] = bad
    with pytest.raises(ValueError, match="within"):
        SensitivityVQ(plugins).encode(x, sensitivity)
