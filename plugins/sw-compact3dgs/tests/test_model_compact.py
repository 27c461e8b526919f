"""The model that trains: masks, colours, and shapes of codebooks."""

import math
from dataclasses import replace

import torch
from compact_models import PLUGINS, make, method
from sw_compact3dgs.model import PLAIN, QUANTIZED, SMALLEST_SCALE
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.rendering.rasterizer import RasterOptions

RASTERIZER = ReferenceRasterizer()


def test_the_mask_is_straight_through():
    quantizer = PLUGINS.quantizers.load("ste-mask")(method().config.mask.threshold)
    m = torch.tensor([1.0, -4.59, -4.60, math.log(0.01 / 0.99) + 1e-3, -9.0], requires_grad=True)
    mask = quantizer.forward(m)
    assert mask.tolist() == [1, 1, 0, 1, 0]
    mask.sum().backward()
    soft = torch.sigmoid(m.detach())
    torch.testing.assert_close(m.grad, soft * (1 - soft))


def test_a_large_weight_turns_every_mask_off():
    """From 1 to logit(0.01) = -4.595 Adam needs 560 steps of 0.01 at least, and 1,410 as the sigmoid gets flat."""
    from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

    model = make(n=20, off=0)
    with torch.no_grad():
        model.mask_logits.fill_(method().config.mask.init)
    optimizer = SplatOptimizer(model, [ParamGroup("mask_logits", method().config.mask.lr)])
    steps = 0
    while bool(model.mask_on().any()) and steps < 2000:
        optimizer.zero_grad()
        (100 * torch.sigmoid(model.mask_logits).mean()).backward()
        optimizer.step()
        steps += 1
    assert 1400 <= steps <= 1420


def test_colours_are_those_of_the_field_and_only_visible_ones_are_asked_for():
    model, cam = make(), front_camera()
    with torch.no_grad():
        model.means[10:14, 2] = -50  # behind the camera
        inputs = model.gaussians(cam, RASTERIZER)
        everything = model.color.coefficients(model.color.features(model.means), model.means, cam.center)
    dc = inputs.sh.dc[:, 0]
    seen = RASTERIZER.visible_filter(inputs, cam) > 0
    assert not bool(seen[10:14].any())
    assert bool((dc[~seen] == 0).all())
    torch.testing.assert_close(dc[seen], everything[seen])
    assert inputs.colors is None
    inputs.validate()


def test_colours_change_with_the_view():
    model = make()
    near = front_camera()
    far = replace(near, tau=near.tau + torch.tensor([0.4, 0.0, 0.0]))
    with torch.no_grad():
        a, b = (model.gaussians(cam, RASTERIZER).sh.dc for cam in (near, far))
    assert float((a - b).abs().max()) > 1e-4


def test_shapes_of_the_last_phase_are_sums_of_entries_with_gradient_one():
    model, cam = make(), front_camera()
    inputs = model.gaussians(cam, RASTERIZER)
    on = model.mask_on()
    entries = model.scale_vq.forward(model.scales).detach().clamp_min(SMALLEST_SCALE)
    torch.testing.assert_close(inputs.scales[on], entries[on])
    assert bool((inputs.scales[~on] == 0).all())
    assert bool((inputs.opacities[~on] == 0).all())
    inputs.scales.sum().backward()
    expected = model.scales.detach() * on[:, None]  # d exp
    torch.testing.assert_close(model.log_scales.grad, expected)
    assert model.scale_vq.codebooks.grad is None
    inputs = model.gaussians(cam, RASTERIZER)
    inputs.extras["codebooks"].backward()
    assert float(model.scale_vq.codebooks.grad.abs().sum()) > 0
    torch.testing.assert_close(model.log_scales.grad, expected)


def test_a_sum_of_entries_below_zero_is_drawn_as_a_tiny_scale():
    model = make()
    with torch.no_grad():
        model.scale_vq.codebooks.fill_(-1.0)
        scales = model.gaussians(front_camera(), RASTERIZER).scales[model.mask_on()]
    assert bool((scales == SMALLEST_SCALE).all())


def test_the_first_phase_draws_the_shapes_as_they_are():
    model = make()
    model.phase = PLAIN
    with torch.no_grad():
        inputs = model.gaussians(front_camera(), RASTERIZER)
    assert "codebooks" not in inputs.extras
    on = model.mask_on()
    assert torch.equal(inputs.scales[on], model.scales.detach()[on])


def test_codebooks_start_from_rows_and_one_pass():
    """64 drawn rows for a stage, and one iteration of Lloyd: some error is left, less with every stage."""
    model = make(n=600, size=8, stages=5)
    model.fit_codebooks(1)
    x, errors = model.scales.detach(), []
    for stages in range(1, 6):
        total = sum(model.scale_vq.codebooks.detach()[s][model.scale_vq.assign(x)[:, s]] for s in range(stages))
        errors.append(float((x - total).square().mean()))
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] > 0


def test_values_drawn_from_the_entries_leave_no_error():
    model = make(n=64, size=64, stages=2, off=0)
    with torch.no_grad():
        model.log_scales.copy_(model.log_scales[torch.arange(64) % 16])
    model.fit_codebooks(20)
    x = model.scales.detach()
    torch.testing.assert_close(model.scale_vq.forward(x), x, atol=1e-6, rtol=1e-5)


def test_state_comes_back():
    model, other = make(seed=1), make(n=7, seed=2, off=0)
    other.phase = PLAIN
    other.load_resized(model.state_dict())
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.phase == QUANTIZED
    assert other.digest() == model.digest()


def test_the_image_has_gradients_for_everything():
    model, cam = make(), front_camera()
    image = RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions()).image
    image.square().sum().backward()
    for name, parameter in model.named_parameters():
        if name in ("sh_dc", "sh_rest", "scale_vq.codebooks", "quat_vq.codebooks"):
            assert parameter.grad is None, name
        else:
            assert bool(torch.isfinite(parameter.grad).all()), name
            assert float(parameter.grad.abs().sum()) > 0, name
