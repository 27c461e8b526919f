"""leaf-octree as a position codec: any count at a place; smaller than `octree` where cells have neighbours."""

import numpy as np
import pytest
import torch

from splatwizard_core.api import BitstreamError, GaussianModel
from sw_codecs import testing
from sw_codecs.positions.octree import Octree
from sw_wisp.leaf_octree import LeafOctree
from sw_wisp.octree import MOST_IN_A_CELL


def sorted_points(n: int, bits: int, seed: int = 0) -> np.ndarray:
    """Points [n,3] of so many bits an axis, in order; a tenth of them twice."""
    points = np.random.default_rng(seed).integers(0, 1 << bits, (n - n // 10, 3))
    points = np.concatenate([points, points[: n // 10]])
    return points[LeafOctree.sort(points)]


@pytest.mark.parametrize("bits", [1, 2, 3, 4, 10, 18, 19, 21])
def test_it_keeps_the_contract(bits):
    testing.check_position_codec(LeafOctree, sorted_points(100, bits)[::-1].copy(), bits)


@pytest.mark.parametrize("bits", [1, 3, 18, 21])
def test_more_points_at_a_place_than_a_cell_of_wisp_holds(bits):
    points = np.repeat([[0, 0, 1], [(1 << bits) - 1] * 3], 5 * MOST_IN_A_CELL, axis=0)
    assert np.array_equal(LeafOctree().decode(LeafOctree().encode(points, bits)), points)


def test_points_that_no_level_of_wisp_tells_apart():
    corner = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.concatenate([corner, corner + (1 << 21) - 8])  # in two cells of level 18
    points = points[LeafOctree.sort(points)]
    assert np.array_equal(LeafOctree().decode(LeafOctree().encode(points, 21)), points)


def test_a_sheet_takes_less_than_under_octree():
    x, y = np.random.default_rng(0).integers(0, 256, (2, 4000))
    points = np.stack([x, y, x // 3 + y // 5], axis=-1)
    points = points[LeafOctree.sort(points)]
    assert len(LeafOctree().encode(points, 8)) < 0.95 * len(Octree().encode(points, 8))


def test_damage_is_found():
    points = sorted_points(12, 6)
    testing.check_damage(LeafOctree().encode(points, 6), LeafOctree().decode, points, masks=(0x41,))


@pytest.mark.parametrize(
    ("place", "value", "reason"),
    [(0, 9, "upgrade sw-wisp"), (1, 22, "bits an axis"), (2, 7, "at level 7"), (2, 2, "at level 2")],
)
def test_a_head_that_makes_no_sense_is_refused(place, value, reason):
    data = bytearray(LeafOctree().encode(sorted_points(12, 6), 6))
    data[place] = value
    with pytest.raises(BitstreamError, match=reason):
        LeafOctree().decode(bytes(data))


def test_gaussians_take_it_for_their_positions(plugins):
    model = GaussianModel(*(torch.randn(50, *tail) for tail in ((3,), (1, 3), (8, 3), (), (3,), (4,))))
    testing.check_gaussian_codec(
        plugins.gaussian_codecs.load("gaussians-quantized"), plugins, model, positions="leaf-octree"
    )
