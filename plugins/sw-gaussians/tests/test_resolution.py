"""The resolution schedule: what spectra say, how scales fall, and how views are handed out."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from sw_gaussians.config import GaussianTraining
from sw_gaussians.density.budget import BudgetControl
from sw_gaussians.resolution import (
    ResolutionPlan,
    ResolutionSampler,
    SmallPictures,
    Spectrum,
    amplitudes,
    first_scale,
    plan_of_views,
    resolution_plan,
    shrunk,
)
from sw_gaussians.stage import ThreeDGSStage

from splatwizard_core.api import Camera, CameraSampler, PipelineParams, View, stream
from splatwizard_core.training.scheduler import build_schedulers

SIDE = 256


def picture(exponent: float, side: int = SIDE) -> torch.Tensor:
    """[1,H,W] whose amplitudes fall as frequency^-exponent, with random phases."""
    noise = torch.fft.fft2(torch.randn(side, side, generator=stream(0, "noise"), dtype=torch.float64))
    f = torch.fft.fftfreq(side, dtype=torch.float64) * side
    radius = (f[:, None] ** 2 + f[None] ** 2).sqrt().clamp_min(1.0)
    return torch.fft.ifft2(noise / noise.abs() * radius**-exponent).real[None].float()


def spectrum(image: torch.Tensor) -> Spectrum:
    return Spectrum(amplitudes(image))


def test_a_quarter_of_a_picture_with_falling_spectrum_is_at_a_quarter_of_its_side():
    found = spectrum(picture(1.0))
    assert found.scale_of(found.within(1) / 4) == pytest.approx(4.0, rel=0.05)


def test_a_quarter_of_white_noise_is_at_half_its_side():
    found = spectrum(picture(0.0))
    assert found.scale_of(found.within(1) / 4) == pytest.approx(2.0, rel=0.02)


def test_windows_are_sums_of_the_middle():
    amplitude = torch.rand(7, 10, generator=stream(0, "amplitude"))
    found = Spectrum(amplitude)
    assert found.within(1) == pytest.approx(float(amplitude.sum()))
    assert found.within(2) == pytest.approx(float(amplitude[2:5, 3:8].sum()))  # 3 x 5 around (3, 5)


def test_scales_fall_to_one_and_pixels_grow_linearly_between():
    image = spectrum(picture(1.0))
    assert first_scale(image) == pytest.approx(4.0, rel=0.05)
    plan = resolution_plan(first_scale(image), image, full_at=8000)
    assert plan.scales[0] == first_scale(image)
    assert list(plan.times) == sorted(set(plan.times))
    assert list(plan.scales) == sorted(plan.scales, reverse=True)
    assert (plan.scale(0), plan.scale(8000), plan.scale(20_000)) == (plan.scales[0], 1.0, 1.0)
    between = ResolutionPlan((0, 100), (2.0, 1.0))
    assert between.scale(50) == pytest.approx((1 / 0.625) ** 0.5)
    assert resolution_plan(2.0, image, full_at=8000).scales[0] == 2.0
    assert resolution_plan(1.0, image, full_at=8000) == ResolutionPlan((0,), (1.0,))


def views(sizes=((24, 16), (24, 16))) -> list[View]:
    eye = torch.eye(3)
    made = []
    for i, (width, height) in enumerate(sizes):
        camera = Camera(width, height, 20.0, 20.0, width / 2, height / 2, eye, torch.zeros(3))
        pixels = np.random.default_rng(i).integers(0, 255, (height, width, 3), dtype=np.uint8)
        made.append(View(camera, f"{i}.png", lambda pixels=pixels: pixels))
    return made


def sampler(plan: ResolutionPlan, **settings) -> ResolutionSampler:
    inner = CameraSampler(views(), stream(0, "sampler"))
    return ResolutionSampler(inner, lambda: plan, rounds=range(10, 120, 10), **settings)


def test_views_are_drawn_as_always_and_keep_their_field_of_view():
    plain = CameraSampler(views(), stream(0, "sampler"))
    small = sampler(ResolutionPlan((0, 40), (2.0, 1.0)))
    for step in range(1, 60):
        expected, view = plain.next(step), small.next(step)
        assert view.name == expected.name
        assert view.camera.fov_x == pytest.approx(expected.camera.fov_x)
        assert view.image().shape == (3, view.camera.height, view.camera.width)
        if step <= 10:
            assert (view.camera.width, view.camera.height) == (12, 8)
            assert torch.equal(view.image(), shrunk(expected.image(), 8, 12))
        if step > 40:
            assert view.camera.width == 24


def test_the_scale_changes_only_where_statistics_start_again():
    drawn = sampler(ResolutionPlan((0, 40), (2.0, 1.0)))
    scales = [drawn.scale(step) for step in range(1, 51)]
    assert [len(set(scales[i : i + 10])) for i in range(0, 50, 10)] == [1] * 5
    assert scales[::10] == sorted(set(scales), reverse=True)


def test_pictures_without_detail_are_whole_from_the_start():
    flat = spectrum(torch.full((1, 8, 8), 0.5))
    for image in (flat, spectrum(torch.zeros(1, 8, 8))):
        assert resolution_plan(4.0, image, full_at=100) == ResolutionPlan((0,), (1.0,))


@pytest.mark.parametrize("iterations", [500, 900, 4_500, 6_100, 10_000])
def test_statistics_of_every_round_of_the_preset_fast_are_of_one_resolution(iterations):
    config = GaussianTraining.model_validate({
        "iterations": iterations, "scale_schedule": True, "pictures": {"schedule": "dash"},
    })  # fmt: skip
    control = BudgetControl(start=900, stop=24_000, interval=750)
    stage = ThreeDGSStage(config, control, pictures=SmallPictures)
    _, post = build_schedulers(stage, PipelineParams())
    (entry,) = (entry for entry in post.registrations if entry.name == "densify to budget")
    last = round(0.8 * iterations)
    rounds = [step for step in range(1, last + 1) if entry.due(step)]
    assert list(stage.densifications) == rounds
    pictures = views()
    scene = SimpleNamespace(train=pictures, background=None)
    drawn = stage.create_sampler(scene, stream(0, "sampler"))
    drawn._plan = ResolutionPlan((0, last), (4.0, 1.0))
    for past, now in itertools.pairwise([0, *rounds]):
        assert len({drawn.scale(step) for step in range(past + 1, now + 1)}) == 1, now
    assert len({drawn.scale(step) for step in rounds}) == len(rounds)
    assert (drawn.scale(last) > 1, drawn.scale(last + 1)) == (True, 1.0)


def test_whole_scales_are_an_option():
    drawn = sampler(ResolutionPlan((0, 100), (4.0, 1.0)), rounding="floor")
    assert {drawn.scale(step) for step in range(1, 120)} == {4.0, 2.0, 1.0}


def test_its_state_is_that_of_the_sampler_inside():
    first, second = (sampler(ResolutionPlan((0, 40), (2.0, 1.0))) for _ in range(2))
    first.next(1)
    second.load_state_dict(first.state_dict())
    assert [first.next(step).name for step in range(2, 30)] == [second.next(step).name for step in range(2, 30)]


def test_pictures_of_other_sizes_count_at_the_median():
    plan = plan_of_views(views(((24, 16), (24, 16), (48, 32))), full_at=100)
    assert plan.times[-1] == 100
    assert plan.scales[-1] == 1.0
