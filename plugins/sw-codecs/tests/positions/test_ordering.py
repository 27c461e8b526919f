"""Morton order of points: that of the position codecs, arrays and tensors alike, floats on a grid."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from splatwizard_core.plugins import load_plugins
from sw_codecs.positions import morton
from sw_codecs.positions.ordering import spatial_order


def grid(bits):
    return np.stack(np.meshgrid(*[np.arange(1 << bits)] * 3, indexing="ij"), -1).reshape(-1, 3)


@pytest.mark.parametrize("bits", [3, 21])
def test_morton_order_is_that_of_the_position_codecs(bits):
    cells = np.random.default_rng(0).integers(0, 1 << bits, (3000, 3))  # with 3 bits, most cells are there twice
    assert np.array_equal(spatial_order(cells, bits=bits), morton.sort(cells))


@pytest.mark.parametrize("name", ["octree", "byte-planes", "float-delta"])
def test_a_method_asks_a_codec_for_the_order(name):
    cells = np.random.default_rng(3).integers(0, 1 << 10, (500, 3))
    sort = load_plugins().coders.load(name).sort
    assert np.array_equal(sort(cells), morton.sort(cells))
    assert np.array_equal(sort(torch.from_numpy(cells)).numpy(), morton.sort(cells))


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 21), st.data())
def test_a_tensor_is_ordered_as_the_array_is_and_nothing_is_lost(bits, data):
    rows = data.draw(st.lists(st.tuples(*[st.integers(0, 2**bits - 1)] * 3), max_size=20))
    cells = np.array(rows, np.int64).reshape(-1, 3)
    order = spatial_order(cells, bits=bits)
    assert sorted(order.tolist()) == list(range(len(rows)))
    tensor = spatial_order(torch.from_numpy(cells), bits=bits)
    assert (tensor.dtype, tensor.tolist()) == (torch.int64, order.tolist())


@pytest.mark.parametrize("dtype", [np.float32, np.float64, np.float16])
def test_floats_follow_the_cells_of_their_bounding_box(dtype):
    cells = grid(3)
    points = (cells * 0.25 - 7).astype(dtype)  # the grid of 3 bits, moved and scaled
    shuffled = np.random.default_rng(1).permutation(len(points))
    order = spatial_order(points[shuffled], bits=3)
    assert np.array_equal(shuffled[order], spatial_order(cells, bits=3))
    tensor = spatial_order(torch.from_numpy(points[shuffled]).requires_grad_(), bits=3)
    assert tensor.tolist() == order.tolist()


def test_an_ordered_cloud_has_short_steps():
    points = np.random.default_rng(2).normal(size=(20_000, 3)).astype(np.float32)

    def step(order):
        return float(np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean())

    assert step(spatial_order(points)) < 0.1 * step(np.arange(len(points)))


def test_odd_clouds_are_ordered_too():
    for points in (np.zeros((0, 3), np.float32), np.ones((4, 3)), np.array([[-1e308, 0, 0], [1e308, 0, 1]])):
        assert spatial_order(points).tolist() == list(range(len(points)))
    assert spatial_order(np.array([[1, 0, 0], [0, 0, 0]], np.uint8)).tolist() == [1, 0]
    assert spatial_order(torch.empty(0, 3)).tolist() == []


@pytest.mark.parametrize(
    "points",
    [np.zeros((2, 2)), np.zeros(3), np.array([[0, 0, np.nan]]), np.array([[0, 0, -1]]), np.array([[0, 0, 1 << 21]])],
)
def test_what_has_no_order_is_refused(points):
    with pytest.raises(ValueError):
        spatial_order(points)


@pytest.mark.parametrize("bits", [0, 22])
def test_widths_out_of_range_are_refused(bits):
    with pytest.raises(ValueError, match=r"1\.\.21"):
        spatial_order(np.zeros((1, 3)), bits=bits)
