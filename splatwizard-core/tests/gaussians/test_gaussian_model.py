"""The explicit Gaussian model: initialisation from points, what a renderer gets, and its state."""

import json
import logging
import math

import pytest
import torch

from splatwizard_core.errors import SceneError, ShapeError, SplatwizardError
from splatwizard_core.gaussians.knn import mean_squared_neighbor_distance
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud

CAMERA = Camera.look_at(
    torch.tensor([0.0, 0.0, -3.0]), torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]), width=8, height=8, fov_x=1.0
)


def some_model(n: int = 5, degree: int = 3, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    k = (degree + 1) ** 2
    return GaussianModel(
        torch.randn(n, 3, generator=g),
        torch.randn(n, 1, 3, generator=g),
        torch.randn(n, k - 1, 3, generator=g),
        torch.randn(n, generator=g),
        torch.randn(n, 3, generator=g),
        torch.randn(n, 4, generator=g),
    )


def lattice(side: int) -> torch.Tensor:
    axis = torch.arange(side, dtype=torch.float32)
    return torch.cartesian_prod(axis, axis, axis)


def test_interior_of_a_unit_lattice_has_sigma_one_exactly():
    points = lattice(5)
    model = GaussianModel.from_points(PointCloud(points, torch.full_like(points, 0.5)))
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
    model = GaussianModel.from_points(PointCloud(torch.zeros(1, 3), torch.zeros(1, 3)))
    torch.testing.assert_close(model.scales, torch.full((1, 3), math.sqrt(1e-7)))


def test_start_values_are_those_of_the_paper():
    rgb = torch.tensor([[1.0, 0.5, 0.0], [0.25, 0.75, 0.5]])
    model = GaussianModel.from_points(PointCloud(torch.tensor([[0.0, 0, 0], [1, 0, 0]]), rgb))
    torch.testing.assert_close(0.5 + 0.28209479177387814 * model.sh_dc[:, 0], rgb)
    assert not model.sh_rest.any()
    assert model.sh_rest.shape == (2, 15, 3)
    assert model.active_sh_degree == 0
    assert model.quats.tolist() == [[1, 0, 0, 0]] * 2
    torch.testing.assert_close(model.opacity_logits, torch.full((2,), -2.1972246))


def test_points_that_are_not_finite_are_dropped_and_counted(caplog):
    xyz = torch.tensor([[0.0, 0, 0], [math.nan, 0, 0], [1, 0, 0], [0, math.inf, 0]])
    with caplog.at_level(logging.WARNING):
        model = GaussianModel.from_points(PointCloud(xyz, torch.full((4, 3), 0.25)))
    assert model.num_rows == 2
    assert "dropped 2 of 4 start points" in caplog.text


def test_missing_colours_are_grey_with_a_warning(caplog):
    with caplog.at_level(logging.WARNING):
        model = GaussianModel.from_points(PointCloud(torch.rand(4, 3)))
    assert not model.sh_dc.any()
    assert "no colours" in caplog.text


def test_no_usable_point_is_a_scene_error():
    with pytest.raises(SceneError, match="no usable start point"):
        GaussianModel.from_points(PointCloud(torch.full((3, 3), math.nan), torch.zeros(3, 3)))


def test_from_tensors_copies():
    source = some_model()
    tensors = {name: p.detach() for name, p in source.named_parameters()}
    model = GaussianModel.from_tensors(**tensors, active_sh_degree=1)
    assert model.active_sh_degree == 1
    tensors["means"].zero_()
    assert model.means.any()


@pytest.mark.parametrize("name", ["means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats"])
def test_tensors_that_do_not_fit_are_named(name):
    tensors = {n: p.detach() for n, p in some_model().named_parameters()}
    tensors[name] = tensors[name][:4] if name != "means" else tensors[name][:, :2]
    with pytest.raises(ShapeError, match=name):
        GaussianModel(**tensors)


def test_seven_coefficients_are_no_sh_degree():
    tensors = {n: p.detach() for n, p in some_model().named_parameters()}
    tensors["sh_rest"] = tensors["sh_rest"][:, :7]
    with pytest.raises(ShapeError, match="7 coefficients"):
        GaussianModel(**tensors)


def test_a_renderer_gets_activated_values_and_colours_in_two_tensors():
    model = some_model()
    model.active_sh_degree = 2
    g = model.gaussians(CAMERA, None)
    g.validate()
    assert g.means is model.means
    assert g.quats is model.quats
    assert g.sh.dc is model.sh_dc
    assert g.sh.rest is model.sh_rest
    assert g.sh.active_degree == 2
    torch.testing.assert_close(g.opacities, 1 / (1 + torch.exp(-model.opacity_logits)))
    torch.testing.assert_close(g.scales.log(), model.log_scales)


def test_degree_zero_has_no_higher_coefficients():
    model = some_model(degree=0)
    assert model.max_sh_degree == 0
    g = model.gaussians(CAMERA, None)
    g.validate()
    assert g.sh.rest is None


def test_rows_name_every_tensor_of_a_primitive():
    model = some_model()
    assert set(model.ROWS) == set(model.state_dict())
    assert all(getattr(model, name).shape[0] == model.num_rows for name in model.ROWS)
    assert sum(p.numel() for p in model.parameters()) == 59 * model.num_rows


def test_state_survives_a_change_of_rows():
    model = some_model(7)
    model.active_sh_degree = 1
    model.split_seed = 2**62 + 1
    model.next_split_generator()
    extra = json.loads(json.dumps(model.state_dict_extra()))
    other = some_model(3, seed=5)
    other.load_resized(model.state_dict())
    other.load_state_dict_extra(extra)
    assert other.digest() == model.digest()
    draws = [torch.rand(4, generator=m.next_split_generator()) for m in (model, other)]
    assert torch.equal(*draws)


def test_every_split_draws_from_another_stream():
    model = some_model()
    first, second = (torch.rand(4, generator=model.next_split_generator()) for _ in range(2))
    assert not torch.equal(first, second)


def test_a_model_names_its_primitives():
    class Anchors(SplatModel):
        ROW_LABEL = "anchors"

    assert (SplatModel.ROW_LABEL, GaussianModel.ROW_LABEL, Anchors.ROW_LABEL) == ("gaussians", "gaussians", "anchors")


def test_rows_that_are_not_finite_are_counted_and_all_of_them_are_an_error():
    model = GaussianModel.from_points(PointCloud(torch.rand(5, 3), torch.rand(5, 3)))
    assert model.check_finite() == 0
    with torch.no_grad():
        model.means[1, 2] = torch.nan
        model.log_scales[1:3] = torch.inf
    assert model.check_finite() == 2
    with torch.no_grad():
        model.opacity_logits.fill_(torch.nan)
    with pytest.raises(SplatwizardError, match="all 5 gaussians of the model hold values that are not finite"):
        model.check_finite()
