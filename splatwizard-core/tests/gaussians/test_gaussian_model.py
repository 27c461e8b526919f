"""The explicit Gaussian model: what a renderer gets, and its state."""

import json

import pytest
import torch

from splatwizard_core.errors import ShapeError, SplatwizardError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.scene.camera import Camera

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
    model = some_model()
    assert model.check_finite() == 0
    with torch.no_grad():
        model.means[1, 2] = torch.nan
        model.log_scales[1:3] = torch.inf
    assert model.check_finite() == 2
    with torch.no_grad():
        model.opacity_logits.fill_(torch.nan)
    with pytest.raises(SplatwizardError, match="all 5 gaussians of the model hold values that are not finite"):
        model.check_finite()
