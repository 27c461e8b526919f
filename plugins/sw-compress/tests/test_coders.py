"""Sizes from entropies against files that were written."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from sw_compress.coders import FIXED_BYTES, LEVELS, POSITION_BITS, POSITIONS, Quantized, columns_bits, octree_bits

from splatwizard_core.tooling import load_plugins
from sw_codecs.entropy.columns import Columns
from sw_codecs.positions import morton
from sw_codecs.positions.octree import Octree


@pytest.fixture(scope="module")
def model(ball):
    return ball(3000)


@pytest.fixture(scope="module")
def coder() -> Quantized:
    return Quantized(load_plugins(), {})


@pytest.mark.parametrize("level", [0.0, 2.0, -2.0])
def test_the_estimate_of_a_file_is_near(model, coder, tmp_path, level: float):
    levels = dict.fromkeys(coder.attributes(model), level)
    sizes = coder.sizes(model)
    estimate = FIXED_BYTES + sum(
        float(size[np.flatnonzero(coder.levels(name) == level)[0]]) for name, size in sizes.items()
    )
    assert coder.encode(model, levels, tmp_path / "a.swz") == pytest.approx(estimate, rel=0.06)


def test_rounding_is_what_the_file_decodes_to(model, coder, tmp_path):
    from splatwizard_core.tooling import open_model

    levels = dict.fromkeys(coder.attributes(model), 1.0)
    coder.encode(model, levels, tmp_path / "a.swz")
    decoded, _ = open_model(tmp_path / "a.swz", coder.plugins, torch.device("cpu"))
    rounded = coder.rounded(model, levels)
    grid = replace(coder.rounding(model).grid, bits=POSITION_BITS - 1)
    order = morton.sort(grid.quantize(rounded.means.numpy()))
    for name in model.RAW:
        found = getattr(rounded, name)[torch.from_numpy(order)]
        assert torch.allclose(getattr(decoded, name), found, rtol=1e-6, atol=1e-7), name


def test_sizes_fall_with_the_level(model, coder):
    for name, size in coder.sizes(model).items():
        assert len(size) == len(coder.levels(name))
        fine = size[coder.levels(name) <= 3]  # beyond, a scale has two or three values
        assert all(np.diff(fine) <= 0.002 * size[0]), name


def test_attributes_without_spherical_harmonics(coder, ball):
    flat = ball(50, degree=0)
    assert "rest" not in coder.attributes(flat)
    assert set(coder.sizes(flat)) == {POSITIONS, "dc", "opacity", "scale", "quat"}


def test_columns_are_estimated_within_a_few_per_cent():
    random = np.random.default_rng(0)
    symbols = np.rint(random.laplace(0, 6, (20_000, 3))).astype(np.int32)
    assert columns_bits(torch.from_numpy(symbols)) / 8 == pytest.approx(len(Columns().encode(symbols)), rel=0.03)


def test_an_octree_is_estimated_within_a_few_per_cent():
    points = np.random.default_rng(1).normal(2**9, 60, (20_000, 3)).astype(np.int64).clip(0, 1023)
    codes = np.sort(morton.encode(points))
    for bits in (10, 9, 7):
        real = len(Octree().encode(morton.decode(codes >> 3 * (10 - bits)), bits))
        found = octree_bits(torch.from_numpy(codes), 10)[bits] / 8
        assert found == pytest.approx(real, rel=0.08)  # counts of duplicates are coded apart


def test_levels_stay_within_what_settings_allow(coder, model):
    assert coder.settings(coder.finest(model)).position_bits <= 21
    coarsest = {name: float(coder.levels(name)[-1]) for name in coder.attributes(model)}
    assert coder.settings(coarsest).position_bits == 8
    assert float(LEVELS[0]) < 0 < POSITION_BITS
