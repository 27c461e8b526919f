"""The score against closed forms: what a Gaussian's value does to a picture, and nothing else."""

import pytest
import torch
from sw_gaussians.finetune.pruning import lowest

from splatwizard_core.gaussians.inputs import rgb_to_dc
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions, ScoreSpec
from splatwizard_core.scene.camera import Camera
from sw_speedy_splat.score import SpeedyScore


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu", prefer=["reference"])


def camera(width: int = 24, height: int = 16, back: float = 4.0) -> Camera:
    eye, target, up = torch.tensor([0.0, 0, -back]), torch.zeros(3), torch.tensor([0.0, 1, 0])
    return Camera.look_at(eye, target, up, width=width, height=height, fov_x=0.6)


def splats(means, opacities, colors, scale: float = 0.1) -> GaussianModel:
    means, opacities = torch.tensor(means).float().reshape(-1, 3), torch.tensor(opacities).float()
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return GaussianModel(
        means, rgb_to_dc(torch.tensor(colors).float().reshape(-1, 3))[:, None], torch.zeros(n, 15, 3),
        torch.logit(opacities), torch.full((n, 3), scale).log(), quats,
    )  # fmt: skip


def cloud(n: int = 60, seed: int = 0) -> GaussianModel:
    g = torch.Generator().manual_seed(seed)
    model = splats(
        (torch.rand(n, 3, generator=g) - 0.5).tolist(),
        (0.1 + 0.8 * torch.rand(n, generator=g)).tolist(),
        torch.rand(n, 3, generator=g).tolist(),
    )
    model.log_scales.data += 0.5 * torch.randn(n, 3, generator=g)
    model.sh_rest.data += 0.1 * torch.randn(n, 15, 3, generator=g)
    return model


def test_one_gaussian_on_black_is_its_pixels_times_its_squared_light(rasterizer):
    model, view = splats([[0, 0, 0]], [0.6], [[0.2, 0.5, 0.7]]), camera()
    spec = RasterOptions(scores=(ScoreSpec("hits", "hits"),))
    with torch.no_grad():
        hits = rasterizer.accumulate(model.gaussians(view, rasterizer), [view], spec).scores["hits"]
    assert int(hits) > 20
    (found,) = SpeedyScore().score(model, [view], rasterizer).tolist()
    assert found == pytest.approx(int(hits) * (0.6 * 1.4) ** 2, rel=1e-5)


def test_two_gaussians_on_one_pixel(rasterizer):
    """The last one shows the background, the first one what is behind it."""
    view = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(3), torch.zeros(3))
    front, back, behind = torch.tensor([0.9, 0.1, 0.3]), torch.tensor([0.2, 0.8, 0.4]), torch.tensor([0.1, 0.3, 0.0])
    model = splats([[0, 0, 2.0], [0, 0, 3.0]], [0.5, 0.7], [front.tolist(), back.tolist()])
    found = SpeedyScore().score(model, [view], rasterizer, behind).double()
    first = 0.5 * (front - (0.7 * back + 0.3 * behind)).sum()
    second = 0.7 * 0.5 * (back - behind).sum()
    assert torch.allclose(found, torch.stack([first, second]).double() ** 2, atol=1e-6)


def test_the_value_of_each_pixel_by_central_differences(rasterizer):
    """A change of the opacity changes value times opacity alike at every pixel: dC/dg = dC/do o / g."""
    view = Camera(1, 1, 1.0, 1.0, 0.5, 0.5, torch.eye(3), torch.zeros(3))
    colors = [[0.9, 0.1, 0.3], [0.2, 0.8, 0.4], [0.5, 0.5, 0.9]]
    opacities, means = [0.5, 0.7, 0.3], [[0, 0, 2.0], [0, 0, 3.0], [0, 0, 4.0]]

    def light(values) -> float:
        with torch.no_grad():
            model = splats(means, values, colors)
            return float(rasterizer.render(model.gaussians(view, rasterizer), view, RasterOptions()).image.sum())

    found = SpeedyScore().score(splats(means, opacities, colors), [view], rasterizer)
    for i, o in enumerate(opacities):
        up, down = ([v + (d if j == i else 0) for j, v in enumerate(opacities)] for d in (1e-2, -1e-2))
        assert float(found[i]) == pytest.approx(((light(up) - light(down)) / 2e-2 * o) ** 2, rel=1e-3)


def test_a_gaussian_of_the_backgrounds_colour_does_not_matter(rasterizer):
    color = [0.3, 0.5, 0.7]
    found = SpeedyScore().score(splats([[0, 0, 0]], [0.6], [color]), [camera()], rasterizer, torch.tensor(color))
    assert float(found) == pytest.approx(0, abs=1e-9)


def test_opposite_differences_of_two_channels_cancel_unless_they_are_squared_apart(rasterizer):
    model, behind = splats([[0, 0, 0]], [0.6], [[0.7, 0.3, 0.5]]), torch.tensor([0.5, 0.5, 0.5])
    views = [camera()]
    assert float(SpeedyScore().score(model, views, rasterizer, behind)) == pytest.approx(0, abs=1e-9)
    apart = float(SpeedyScore("per_channel").score(model, views, rasterizer, behind))
    black = float(SpeedyScore().score(splats([[0, 0, 0]], [0.6], [[0.2, 0, 0]]), views, rasterizer))
    assert apart == pytest.approx(2 * black, rel=1e-4)


def test_channels_apart_are_the_sum_of_three_pictures_of_one_channel(rasterizer):
    model = cloud()
    views = [camera(), camera(back=3.0)]
    with torch.no_grad():
        one = [splats(model.means.tolist(), [0.5] * 60, [[0.5] * 3] * 60) for _ in range(3)]
        total = torch.zeros(60)
        for channel, only in enumerate(one):
            for name in ("opacity_logits", "log_scales", "quats", "sh_dc", "sh_rest"):
                getattr(only, name).copy_(getattr(model, name))
            others = [c for c in range(3) if c != channel]
            only.sh_dc[..., others] = rgb_to_dc(torch.zeros(1))
            only.sh_rest[..., others] = 0
            total += SpeedyScore().score(only, views, rasterizer).clamp_min(0)
    found = SpeedyScore("per_channel").score(model, views, rasterizer).clamp_min(0)
    assert torch.allclose(found, total, rtol=1e-4, atol=1e-5)


def test_what_no_pixel_shows_goes_first(rasterizer):
    hidden = splats(
        [[0, 0, -1.0], [0, 0, -0.9], [0, 0, -0.8], [0, 0, 1.0], [9.0, 0, 0]],
        [0.995, 0.995, 0.995, 0.9, 0.9], [[0.5] * 3] * 5, scale=5.0,
    )  # fmt: skip
    hidden.log_scales.data[4] = -5
    found = SpeedyScore().score(hidden, [camera()], rasterizer)
    assert found[2:].tolist() == [-torch.inf] * 3  # behind 0.99 and 0.99 no light is left
    assert lowest(found, 3).tolist() == [False, False, True, True, True]
    assert SpeedyScore().score(hidden, [], rasterizer).tolist() == [-torch.inf] * 5


def test_scores_add_over_views_and_do_not_depend_on_the_order_of_gaussians(rasterizer):
    model, near, far = cloud(), camera(back=3.0), camera()
    both = SpeedyScore().score(model, [near, far], rasterizer)
    apart = [SpeedyScore().score(model, [view], rasterizer).clamp_min(0) for view in (near, far)]
    assert torch.allclose(both.clamp_min(0), apart[0] + apart[1], rtol=1e-5)
    twice = SpeedyScore().score(model, [near, far, near, far], rasterizer)
    assert torch.allclose(twice, 2 * both, rtol=1e-5)
    order = torch.randperm(60, generator=torch.Generator().manual_seed(1))
    tensors = (model.means, model.sh_dc, model.sh_rest, model.opacity_logits, model.log_scales, model.quats)
    shuffled = GaussianModel.from_tensors(*(t[order] for t in tensors))
    assert torch.allclose(SpeedyScore().score(shuffled, [near, far], rasterizer), both[order], rtol=1e-4)


@pytest.mark.parametrize("mode", ["sum", "per_channel"])
def test_a_scoring_leaves_model_and_gradients_alone(rasterizer, mode):
    model = cloud()
    before = model.digest()
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 3.0)
    SpeedyScore(mode).score(model, [camera()], rasterizer)
    assert model.digest() == before
    assert all(bool((parameter.grad == 3).all()) for parameter in model.parameters())


def test_the_lowest_change_the_picture_less_than_any_others(rasterizer):
    views = [camera(), camera(back=3.2)]

    def error(model, doomed) -> float:
        with torch.no_grad():
            total = 0.0
            for view in views:
                g = model.gaussians(view, rasterizer)
                whole = rasterizer.render(g, view, RasterOptions()).image
                tensors = (model.means, model.sh_dc, model.sh_rest, model.opacity_logits, model.log_scales, model.quats)
                left = GaussianModel.from_tensors(*(t[~doomed] for t in tensors))
                total += float(
                    (rasterizer.render(left.gaussians(view, rasterizer), view, RasterOptions()).image - whole)
                    .pow(2)
                    .mean()
                )
            return total

    by_score = by_chance = 0.0
    for seed in range(10):
        model = cloud(seed=seed)
        by_score += error(model, lowest(SpeedyScore().score(model, views, rasterizer), 18))
        by_chance += error(model, lowest(torch.rand(60, generator=torch.Generator().manual_seed(seed)), 18))
    assert by_score < by_chance / 4


def test_only_explicit_gaussians_have_this_score(rasterizer):
    with pytest.raises(TypeError, match="GaussianModel"):
        SpeedyScore().score(SplatModel(), [camera()], rasterizer)


@pytest.mark.cuda
def test_the_score_on_a_gpu_is_that_of_the_cpu():
    model, views = cloud(400), [camera(64, 48), camera(64, 48, 3.0)]
    here = SpeedyScore().score(model, views, NegotiatedRasterizer(load_plugins(), device="cpu"))
    there = SpeedyScore().score(model.cuda(), views, NegotiatedRasterizer(load_plugins(), device="cuda")).cpu()
    assert torch.allclose(here, there, rtol=1e-3, atol=1e-4)
