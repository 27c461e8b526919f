"""The first Gaussians of a scene: sizes from exact neighbours, the values of the paper, and points that are no use."""

import logging
import math

import pytest
import torch
from sw_gaussians.knn import mean_squared_neighbor_distance
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.errors import SceneError
from splatwizard_core.scene.scene import PointCloud


def lattice(side: int) -> torch.Tensor:
    axis = torch.arange(side, dtype=torch.float32)
    return torch.cartesian_prod(axis, axis, axis)


def test_interior_of_a_unit_lattice_has_sigma_one_exactly():
    points = lattice(5)
    model = gaussians_from_points(PointCloud(points, torch.full_like(points, 0.5)))
    interior = ((points > 0) & (points < 4)).all(dim=1)
    assert torch.equal(model.log_scales[interior], torch.zeros(int(interior.sum()), 3))


def test_three_nearest_distances_agree_with_brute_force():
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(1))
    squared = torch.cdist(points.double(), points.double()) ** 2
    squared.fill_diagonal_(math.inf)
    expected = squared.sort(dim=1).values[:, :3].mean(dim=1)
    torch.testing.assert_close(mean_squared_neighbor_distance(points).double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize(
    ("points", "expected"),
    [
        # Two at one place, a third 2 away: the twins see {0, 4}, the third {4, 4}.
        ([[0, 0, 0], [0, 0, 0], [2, 0, 0]], [2.0, 2.0, 4.0]),
        ([[1, 2, 3]], [0.0]),
        ([[0, 0, 0], [0, 3, 0]], [9.0, 9.0]),
        ([[0, 0, 0]] * 5, [0.0] * 5),
    ],
)
def test_few_points_and_duplicates_use_the_neighbours_there_are(points, expected):
    found = mean_squared_neighbor_distance(torch.tensor(points, dtype=torch.float32))
    assert found.tolist() == expected


def test_coincident_points_get_the_smallest_sigma():
    model = gaussians_from_points(PointCloud(torch.zeros(1, 3), torch.zeros(1, 3)))
    torch.testing.assert_close(model.scales, torch.full((1, 3), math.sqrt(1e-7)))


def test_start_values_are_those_of_the_paper():
    rgb = torch.tensor([[1.0, 0.5, 0.0], [0.25, 0.75, 0.5]])
    model = gaussians_from_points(PointCloud(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), rgb))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * model.sh_dc[:, 0], rgb)
    assert not model.sh_rest.any()
    assert model.sh_rest.shape == (2, 15, 3)
    assert model.active_sh_degree == 0
    assert model.quats.tolist() == [[1, 0, 0, 0]] * 2
    torch.testing.assert_close(model.opacity_logits, torch.full((2,), -2.1972246))


def test_points_that_are_not_finite_are_dropped_and_counted(caplog):
    xyz = torch.tensor([[0.0, 0, 0], [math.nan, 0, 0], [1, 0, 0], [0, math.inf, 0]])
    with caplog.at_level(logging.WARNING):
        model = gaussians_from_points(PointCloud(xyz, torch.full((4, 3), 0.25)))
    assert model.num_rows == 2
    assert "dropped 2 of 4 start points" in caplog.text


def test_missing_colours_are_grey_with_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        model = gaussians_from_points(PointCloud(torch.rand(4, 3)))
    assert not model.sh_dc.any()
    assert "no colours" in caplog.text


def test_no_usable_point_is_a_scene_error():
    with pytest.raises(SceneError, match="no usable start point"):
        gaussians_from_points(PointCloud(torch.full((3, 3), math.nan), torch.zeros(3, 3)))
