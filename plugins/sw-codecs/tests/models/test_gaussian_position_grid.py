"""The position grid: exact on its own cells, fine where the scene is, tolerant of floaters."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sw_codecs.models.position_grid import PositionGrid


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 60),
    bits=st.integers(8, 21),
    seed=st.integers(0, 2**31),
    spread=st.floats(1e-6, 1e6),
    shift=st.floats(-100, 100),
    tail=st.floats(0.1, 6),
)
def test_cell_centres_fall_into_their_cells_and_errors_grow_with_distance_only(n, bits, seed, spread, shift, tail):
    rng = np.random.default_rng(seed)
    # Student's t with few degrees of freedom: the far floaters that trained scenes have.
    points = (rng.standard_t(tail, size=(n, 3)).clip(-1e7, 1e7) + shift) * spread
    grid = PositionGrid.fit(points, bits)
    cells = grid.quantize(points)
    assert cells.min() >= 0
    assert cells.max() < 2**bits
    found = grid.dequantize(cells).astype(np.float64)
    u = np.abs(points - grid.center) / grid.width
    # Half a cell, times 2^octave beyond the linear part; the octave of the cell may be one higher than the point's.
    cell = 2 * np.asarray(grid.top) * np.asarray(grid.width) / 2.0**bits
    bound = 0.5 * cell * np.maximum(2 * u, 1.0)
    rounding = 1e-6 * (np.abs(points) + np.abs(grid.center) + np.abs(found))  # float32
    assert (np.abs(found - points) <= bound + rounding).all()


def test_requantising_the_decoded_points_gives_the_same_cells():
    points = np.random.default_rng(0).standard_t(1.5, size=(5000, 3))
    grid = PositionGrid.fit(points, 16)
    cells = grid.quantize(points)
    assert np.array_equal(grid.quantize(grid.dequantize(cells)), cells)


def test_a_floater_costs_a_few_bits_and_not_all():
    rng = np.random.default_rng(0)
    scene = rng.uniform(-1, 1, size=(1000, 3))
    with_floater = np.concatenate([scene, [[1e4, 0, 0]]])
    errors = []
    for points in (scene, with_floater):
        grid = PositionGrid.fit(points, 16)
        errors.append(np.abs(grid.dequantize(grid.quantize(points)) - points)[:1000].max())
    # 1e4 is 13.3 octaves away: a uniform grid would be 10^4 times coarser.
    assert errors[1] < 16 * errors[0]
    assert errors[0] < 1e-4


def test_floaters_on_both_sides_keep_their_sign_and_magnitude():
    points = np.array([[x, 0.0, 0.0] for x in (-1e4, -1, -0.5, 0, 0.5, 1, 1e4)])
    grid = PositionGrid.fit(points, 16)
    found = grid.dequantize(grid.quantize(points))[:, 0]
    np.testing.assert_allclose(found[[0, 6]], [-1e4, 1e4], rtol=1e-3)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.zeros((1, 3)),
        np.full((4, 3), 7.5),
        np.array([[0, 0, 0], [1, 0, 0], [2, 0, 1e-12]], float),
        np.array([[1e30, -1e30, 0], [0, 0, 0]]),
    ],
)
def test_degenerate_sets_have_a_grid(points):
    grid = PositionGrid.fit(points, 12)
    assert all(w > 0 for w in grid.width)
    assert all(t >= 1 for t in grid.top)
    found = grid.dequantize(grid.quantize(points))
    assert np.isfinite(found).all()
    reach = np.abs(points).max(initial=1.0)
    np.testing.assert_allclose(found, points, atol=1e-3 * reach)
