"""The voxel grid, and merging: means of those that share a voxel, nobody else changes."""

import numpy as np
import pytest

from sw_codecs.models.voxels import VoxelGrid, one_a_voxel
from sw_codecs.positions import morton


def points_of(n=400, seed=0):
    return np.random.default_rng(seed).normal(0, [3, 1, 0.2], (n, 3)).astype(np.float32)


def merged(codes, rows, importance=None, rule="mean"):
    importance = np.ones(len(codes)) if importance is None else np.asarray(importance, float)
    generator = np.random.default_rng(0)
    return one_a_voxel(np.asarray(codes), rows, importance, rule=rule, generator=generator)


@pytest.mark.parametrize("depth", [1, 8, 14, 19, 20, 21])
@pytest.mark.parametrize("anchor", ["center", "corner"])
def test_every_point_is_within_its_cell(depth, anchor):
    points = points_of()
    grid = VoxelGrid.fit(points, depth, anchor)
    cells = grid.cells(points)
    assert cells.min() == 0
    assert cells.max() == 2**depth - 1  # the far border does not carry into the next axis
    assert np.array_equal(morton.decode(morton.encode(cells)), cells)
    size = (np.array(grid.high) - grid.low) / 2**depth
    error = points - grid.points(cells).astype(np.float64)
    slack = 4e-7 * np.abs(points).max()  # float32 places
    most = size / 2 if anchor == "center" else size
    assert (np.abs(error) <= most + slack).all()
    assert anchor == "center" or (error >= -slack).all()


def test_axes_stay_apart_at_twenty_bits():
    """Cells whose row-major code has more digits than a double."""
    cells = np.array([[700_000, 2**20 - 1, 2**20 - 20]])
    assert np.array_equal(morton.decode(morton.encode(cells)), cells)


def test_a_flat_axis_and_a_single_point_keep_their_places():
    flat = points_of()
    flat[:, 1] = 2.5
    grid = VoxelGrid.fit(flat, 10)
    assert np.array_equal(grid.points(grid.cells(flat))[:, 1], flat[:, 1])
    one = flat[:1]
    grid = VoxelGrid.fit(one, 10)
    assert np.array_equal(grid.points(grid.cells(one)), one)
    assert VoxelGrid.fit(np.zeros((0, 3)), 5).points(np.zeros((0, 3), np.int64)).shape == (0, 3)


def test_as_many_rows_as_distinct_voxels_in_the_order_of_their_codes():
    codes = np.random.default_rng(0).integers(0, 50, 300)
    first, rows, importance = merged(codes, {"code": codes.astype(np.float64)})
    assert np.array_equal(codes[first], np.unique(codes))
    assert np.array_equal(rows["code"], np.unique(codes))
    assert np.array_equal(importance, np.bincount(codes)[np.unique(codes)])


def test_means_are_of_those_that_share_a_voxel_and_the_others_stay_bit_for_bit():
    values = np.array([1.1, 4.0, 2.0, 9.7], np.float32)
    _, rows, importance = merged([7, 3, 3, 1], {"x": values}, importance=[5, 1, 3, 2])
    assert rows["x"].tolist() == [values[3], 3.0, values[0]]
    assert importance.tolist() == [2, 4, 5]
    _, rows, _ = merged([7, 3, 3, 1], {"x": values}, importance=[5, 1, 3, 2], rule="importance")
    assert rows["x"].tolist() == [values[3], (4.0 + 3 * 2.0) / 4, values[0]]
    _, rows, _ = merged([3, 3], {"x": np.array([4.0, 2.0])}, importance=[0, 0], rule="importance")
    assert rows["x"].tolist() == [3.0]


def test_a_random_member_is_kept_whole():
    codes = np.repeat(np.arange(200), 2)
    rows = {"x": np.arange(400.0), "y": -np.arange(400.0)}
    _, found, _ = merged(codes, rows, rule="random")
    assert np.array_equal(found["x"], -found["y"])
    assert np.array_equal(found["x"] // 2, np.arange(200))
    assert 0 < (found["x"] % 2).mean() < 1


def test_rotations_of_opposite_sign_do_not_cancel():
    quats = np.array([[2.0, 0, 0, 0.2], [-3.0, 0, 0, 0.3], [0, 1, 0, 0]], np.float32)
    _, rows, _ = merged([4, 4, 9], {"quats": quats})
    assert rows["quats"][0] == pytest.approx([1, 0, 0, 0], abs=1e-7)
    assert np.array_equal(rows["quats"][1], quats[2])


def test_rows_without_elements_are_merged_too():
    _, rows, _ = merged([4, 4, 9], {"sh_rest": np.zeros((3, 0, 3), np.float32)})
    assert rows["sh_rest"].shape == (2, 0, 3)


def test_nothing_to_merge():
    first, rows, importance = merged(np.zeros(0, np.int64), {"x": np.zeros((0, 3), np.float32)})
    assert len(first) == len(importance) == 0
    assert rows["x"].shape == (0, 3)
