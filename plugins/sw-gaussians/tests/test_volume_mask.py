"""A learned mask takes Gaussians out of the picture, then out of the model."""

import math

import pytest
import torch
from sw_gaussians.density.adc import densify_and_prune
from sw_gaussians.volume_mask import VolumeMaskedGaussians, mask_prune, prune_by_mask

from splatwizard_core.errors import EmptyModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

NAMES = ("means", "opacity_logits", "log_scales", "quats", "mask_logits")
OFF = math.log(0.01 / 0.99)  # -4.59512: the sigmoid is the threshold


class Mask:
    """The gradient of `ste-mask` of sw-codecs, which this package does not require."""

    def forward(self, x):
        soft = torch.sigmoid(x)
        return (soft > 0.01).float() + soft - soft.detach()

    def encode(self, x):
        return (torch.sigmoid(x) > 0.01).long(), {}


def make(logits=(1.0, -5.0, 1.0, -4.7)) -> VolumeMaskedGaussians:
    n = len(logits)
    row = torch.arange(float(n))
    model = VolumeMaskedGaussians(
        row[:, None].repeat(1, 3), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.zeros(n),
        torch.full((n, 3), math.log(0.05)), torch.tensor([[1.0, 0, 0, 0]] * n), quantizer=Mask(),
    )  # fmt: skip
    with torch.no_grad():
        assert model.mask_logits.tolist() == [1.0] * n
        model.mask_logits.copy_(torch.tensor(logits))
    return model


def optimizer_of(model) -> SplatOptimizer:
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.1) for name in NAMES])
    for name in NAMES:
        parameter = getattr(model, name)
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    return optimizer


def test_the_mask_multiplies_scales_and_opacity_and_has_the_gradient_of_the_sigmoid():
    model = make()
    inputs = model.gaussians(None, None)
    torch.testing.assert_close(inputs.opacities, torch.tensor([0.5, 0, 0.5, 0]))
    torch.testing.assert_close(inputs.scales[:, 0], torch.tensor([0.05, 0, 0.05, 0]))
    soft = torch.sigmoid(model.mask_logits)
    torch.testing.assert_close(inputs.extras["mask"], soft)
    inputs.opacities.sum().backward()
    torch.testing.assert_close(model.mask_logits.grad, 0.5 * soft.detach() * (1 - soft.detach()))


def test_what_is_off_goes_and_moments_follow():
    model = make()
    optimizer = optimizer_of(model)
    optimizer.states["means"].tensors["exp_avg"][:, 0] = torch.arange(4.0)
    assert prune_by_mask(model, optimizer, step=5) == 2
    assert model.means[:, 0].round().tolist() == [0, 2]
    assert optimizer.states["means"].tensors["exp_avg"][:, 0].tolist() == [0, 2]
    assert model.grad_accum.shape == (2,)


def test_the_threshold_is_the_sigmoids():
    model = make((OFF - 1e-4, OFF + 1e-4))
    assert model.mask_on().tolist() == [False, True]


def test_nothing_is_updated_at_the_step_of_a_pruning():
    model = make((1.0, 1.0))
    optimizer = optimizer_of(model)
    before = model.means.detach().clone()
    for name in NAMES:
        getattr(model, name).grad = torch.ones_like(getattr(model, name))
    assert prune_by_mask(model, optimizer, step=5) == 0
    optimizer.step()
    assert torch.equal(model.means.detach(), before)


def test_a_mask_without_anything_on_is_an_error():
    model = make((-9.0, -9.0))
    with pytest.raises(EmptyModel):
        prune_by_mask(model, optimizer_of(model), step=7)


def test_clones_and_children_copy_the_mask():
    model = make((2.0, 3.0, 1.0, 1.0))
    with torch.no_grad():
        model.log_scales[1] = math.log(0.5)
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in NAMES])
    model.grad_accum[:2], model.denom[:] = 3e-4, 1
    report = densify_and_prune(model, optimizer, step=600, extent=10.0)
    assert (report["cloned"], report["split"], model.num_rows) == (1, 1, 6)
    assert model.mask_logits.tolist() == [2.0, 1.0, 1.0, 2.0, 3.0, 3.0]


def test_the_task_has_a_name():
    assert load_plugins().tasks.load("mask-prune") is mask_prune
