"""A short training on pictures of the source, with a clock of its own."""

import itertools

import pytest
import torch
from sw_compress.coders import Quantized
from sw_compress.refining import NOISE, near, noisy, refine
from sw_compress.rows import select
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import Camera
from splatwizard_core.tooling import load_plugins
from sw_rasterizers.native import MODULE
from sw_rasterizers.standard import StandardRasterizer

RASTERIZER = StandardRasterizer() if MODULE.available() is None else ReferenceRasterizer()
LEVELS = {"positions": 0.0, **dict.fromkeys(("opacity", "scale", "quat", "dc", "rest"), 0.0)}


def looking(*eye: float) -> Camera:
    up = torch.tensor([0.0, -1.0, 0.0])
    return Camera.look_at(torch.tensor(eye), torch.zeros(3), up, width=48, height=48, fov_x=0.8)


CAMERAS = [
    looking(*eye) for eye in ((0.1, 0.2, -3.0), (0.5, -0.4, -2.8), (0, 0.6, -3.1), (-0.5, 0.1, -2.9), (0.3, -0.2, -3.2))
]


@pytest.fixture(scope="module")
def coder() -> Quantized:
    return Quantized(load_plugins(), {})


def refined(part, source, coder, *, seconds: float):
    ticks = itertools.count()
    return refine(part, source, CAMERAS, RASTERIZER, coder, LEVELS, seconds=seconds, clock=lambda: float(next(ticks)))


def test_what_went_is_made_up_for(ball, coder):
    source = ball(120, degree=1)
    part = select(source, torch.arange(0, 120, 2))
    before = {name: getattr(part, name).clone() for name in part.RAW}
    found = refined(part, source, coder, seconds=200)
    assert found.after > found.before + 0.5
    assert found.model.num_rows == 60
    assert 20 < found.steps <= 100
    assert not found.model.means.requires_grad
    assert all(torch.equal(before[name], getattr(part, name)) for name in part.RAW)  # that one is left as it is


def test_it_is_never_worse_than_it_began(ball, coder):
    source = ball(80, degree=0)
    found = refined(source, source, coder, seconds=6)
    assert found.after >= found.before


def test_noise_is_as_wide_as_the_steps_and_gone_after(ball, coder):
    model = ball(200)
    params = {name: getattr(model, name) for name in NOISE}
    before = {name: value.clone() for name, value in params.items()}
    steps = coder.steps(LEVELS)
    factors = torch.ones(model.num_rows)
    factors[0] = 4
    with noisy(params, steps, torch.Generator().manual_seed(0), factors):
        for name in ("opacity_logits", "log_scales", "sh_dc", "sh_rest"):
            off = (params[name] - before[name]).abs()
            assert 0.4 * steps[NOISE[name]] < off[1:].max() <= 0.501 * steps[NOISE[name]]
            assert off[0].max() <= 2.001 * steps[NOISE[name]]
    for name, value in params.items():
        assert torch.allclose(value, before[name], atol=1e-6)


def test_a_camera_beside_another_looks_nearly_the_same_way():
    draws = torch.Generator().manual_seed(0)
    for camera in CAMERAS:
        other = near(camera, torch.zeros(3), draws)
        distance = camera.center.norm()
        assert 0 < (other.center - camera.center).norm() <= 0.0301 * distance
        assert torch.allclose(other.R @ other.R.T, torch.eye(3), atol=1e-5)
        assert torch.dot(other.R[2], camera.R[2]) > 0.996
