"""The score: what blocks give, and what the world's scale, rotation and views do to it.

That the blocks are what they are said to be is held by the tests of the rasterizers, against autograd at each pixel.
"""

import math
from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.scores import view_fisher

from splatwizard_core.errors import ConfigError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.camera import Camera
from sw_pup_3dgs.score import FLOOR, FisherScore, log_determinants, reduced, unpacked

RAW = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu")


def views(count=6, size=64, radius=3.0, dtype=torch.float64):
    up, target = torch.tensor([0.0, 0.0, 1.0], dtype=dtype), torch.zeros(3, dtype=dtype)
    found = []
    for i in range(count):
        angle = 2 * math.pi * i / count
        eye = torch.tensor([radius * math.cos(angle), radius * math.sin(angle), 1.0 + 0.3 * (i % 2)], dtype=dtype)
        found.append(Camera.look_at(eye, target, up, width=size, height=size, fov_x=0.8))
    return found


def model_of(n=40, degree=1, seed=0, dtype=torch.float64, scale=-2.5):
    g = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=g, dtype=dtype)

    k = (degree + 1) ** 2
    return GaussianModel(
        0.35 * normal(n, 3), normal(n, 1, 3), 0.2 * normal(n, k - 1, 3), normal(n), scale + 0.3 * normal(n, 3),
        normal(n, 4),
    )  # fmt: skip


def scores(model, cameras, rasterizer, resolution=1, background=None):
    return FisherScore(resolution).score(model, cameras, rasterizer, background)


def raw(model, **changes):
    return GaussianModel(**{**{name: getattr(model, name).detach() for name in RAW}, **changes})


def random_blocks(n=20, seed=0):
    g = torch.Generator().manual_seed(seed)
    factors = torch.randn(n, 9, 6, generator=g, dtype=torch.float64)
    full = factors.mT @ factors
    row, column = torch.triu_indices(6, 6)
    return full, full[:, row, column]


def test_packing_is_the_upper_triangle_row_by_row():
    packed = torch.arange(21.0)[None]
    full = unpacked(packed)[0]
    assert torch.equal(full, full.T)
    assert full[0].tolist() == [0, 1, 2, 3, 4, 5]
    assert full[1].tolist() == [1, 6, 7, 8, 9, 10]
    assert float(full[5, 5]) == 20


def test_the_score_is_the_logarithm_of_the_determinant():
    full, packed = random_blocks()
    torch.testing.assert_close(log_determinants(packed), torch.linalg.slogdet(full).logabsdet)
    assert log_determinants(packed.float()).dtype == torch.float64


def test_many_blocks_are_done_in_parts(monkeypatch):
    _, packed = random_blocks(11)
    whole = log_determinants(packed)
    monkeypatch.setattr("sw_pup_3dgs.score.AT_ONCE", 4)
    assert torch.equal(log_determinants(packed), whole)
    assert log_determinants(packed[:0]).shape == (0,)


def test_zeros_score_minus_infinity_and_rank_5_the_floor():
    full, _ = random_blocks(1)
    values, vectors = torch.linalg.eigh(full[0])
    values[0] = 0
    row, column = torch.triu_indices(6, 6)
    singular = (vectors * values @ vectors.T)[row, column]
    found = log_determinants(torch.stack([torch.zeros(21), singular]))
    assert found[0] == -math.inf
    assert math.isfinite(found[1])
    assert found[1] >= 6 * math.log(FLOOR)
    assert found[1] < float(values[1:].log().sum()) + math.log(1e-13)


def test_a_block_that_is_not_finite_is_an_error():
    _, packed = random_blocks(3)
    packed[1, 4] = math.inf
    with pytest.raises(ValueError, match="of 1 Gaussians are not finite"):
        log_determinants(packed)


@pytest.mark.parametrize("factor", [1, 2, 4, 8])
def test_reduced_views_are_rounded_up_and_keep_their_field_of_view(factor):
    camera = replace(views(1)[0], width=65, height=47)
    small = reduced(camera, factor)
    assert (small.width, small.height) == (math.ceil(65 / factor), math.ceil(47 / factor))
    assert small.tan_half_fov == pytest.approx(camera.tan_half_fov, rel=1e-12)


def test_only_the_published_resolutions_are_taken():
    with pytest.raises(ConfigError, match="one of 1, 2, 4, 8"):
        FisherScore(3)
    assert load_plugins().pruners.load("pup-3dgs")().resolution == 4


def test_off_screen_and_hidden_gaussians_score_minus_infinity(rasterizer):
    camera = views(1, radius=3.0)[0]
    inward = -camera.center / camera.center.norm()
    means = torch.stack([camera.center + 1.0 * inward] * 4 + [torch.zeros(3), 30 * inward.flip(0), torch.zeros(3)])
    means[6] = camera.center + 0.8 * inward  # in front of the wall
    n = len(means)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    log_scales = torch.full((n, 3), math.log(0.05))
    log_scales[:4] = math.log(1.5)  # opaque and wider than the picture
    logits = torch.full((n,), 3.0)
    logits[:4] = 15.0
    model = GaussianModel(means.float(), torch.randn(n, 1, 3), torch.zeros(n, 0, 3), logits, log_scales, quats)
    found = scores(model, [camera.to(dtype=torch.float32)], rasterizer)
    assert found[4] == -math.inf  # behind the wall
    assert found[5] == -math.inf  # beside the picture
    assert math.isfinite(found[6])


def test_one_view_without_view_dependence_gives_rank_5_and_two_views_give_6():
    model, (first, second) = model_of(2, degree=0, scale=-1.5), views(2, size=6)
    single = ReferenceRasterizer()

    def block(camera):
        def draw(inputs):
            return single.render(inputs, camera, RasterOptions()).image

        return unpacked(view_fisher(draw, model.gaussians(camera, single)))

    one = torch.linalg.eigvalsh(block(first))
    both = torch.linalg.eigvalsh(block(first) + block(second))
    assert bool((one[:, 0].abs() / one[:, 5] < 1e-10).all())
    assert bool((both[:, 0] / both[:, 5] > 1e-8).all())


def test_the_scale_of_the_world_shifts_every_score_by_the_same(rasterizer):
    model, cameras, s = model_of(), views(), 4.0  # a power of two: the same floating-point numbers all the way
    larger = raw(model, means=model.means.detach() * s, log_scales=model.log_scales.detach() + math.log(s))
    moved = [replace(camera, tau=camera.tau * s) for camera in cameras]
    here, there = scores(model, cameras, rasterizer), scores(larger, moved, rasterizer)
    # d / d mean shrinks by s, three times; d / d log scale does not.
    torch.testing.assert_close(there - here, torch.full_like(here, -6 * math.log(s)), atol=1e-3, rtol=0)


def test_a_rotation_of_the_world_changes_no_score(rasterizer):
    model, cameras = model_of(degree=0), views()
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    half = [math.cos(0.35), math.sin(0.35)]
    w, x, y, z = torch.nn.functional.normalize(model.quats.detach()).unbind(1)
    quats = torch.stack([  # (cos, 0, 0, sin) times the quaternion
        half[0] * w - half[1] * z, half[0] * x - half[1] * y, half[0] * y + half[1] * x, half[0] * z + half[1] * w,
    ], 1)  # fmt: skip
    turned = raw(model, means=model.means.detach() @ turn.T, quats=quats)
    moved = [replace(camera, R=camera.R @ turn.T) for camera in cameras]
    torch.testing.assert_close(scores(turned, moved, rasterizer), scores(model, cameras, rasterizer), atol=2e-3, rtol=0)


def test_a_further_view_lowers_no_score_and_every_view_twice_adds_6_ln_2(rasterizer):
    model, cameras = model_of(), views()
    few, all_, twice = (scores(model, c, rasterizer) for c in (cameras[:5], cameras, cameras + cameras))
    assert bool((all_ >= few - 1e-3).all())
    assert bool((all_ > few + 1e-2).any())
    torch.testing.assert_close(twice - all_, torch.full_like(all_, 6 * math.log(2)), atol=1e-3, rtol=0)
    assert torch.equal(scores(model, [], rasterizer), torch.full_like(all_, -math.inf))


def test_what_looks_like_all_that_is_behind_it_hardly_counts(rasterizer):
    grey = torch.full((3,), 0.5, dtype=torch.float64)
    model = model_of(1, degree=0)
    same = raw(model, sh_dc=torch.zeros(1, 1, 3, dtype=torch.float64))  # 0.5 in every channel
    other = raw(model, sh_dc=torch.full((1, 1, 3), 0.7, dtype=torch.float64))
    found, seen = (float(scores(m, views(), rasterizer, background=grey)[0]) for m in (same, other))
    assert math.isfinite(seen)
    assert found == -math.inf or found < seen - 200


def test_the_background_counts(rasterizer):
    model, cameras = model_of(), views()
    white = scores(model, cameras, rasterizer, background=torch.ones(3, dtype=torch.float64))
    assert float((white - scores(model, cameras, rasterizer)).abs().max()) > 0.1


def test_scoring_leaves_model_and_gradients_alone(rasterizer):
    model, cameras = model_of(dtype=torch.float32), views(dtype=torch.float32)
    for parameter in model.parameters():
        parameter.grad = torch.full_like(parameter, 3.0)
    before = model.digest()
    first = scores(model, cameras, rasterizer, resolution=4)
    assert torch.equal(first, scores(model, cameras, rasterizer, resolution=4))
    assert not first.requires_grad
    assert model.digest() == before
    assert all(bool((parameter.grad == 3).all()) for parameter in model.parameters())


def test_anything_but_explicit_gaussians_is_refused(rasterizer):
    with pytest.raises(TypeError, match="GaussianModel"):
        FisherScore().score(torch.nn.Linear(1, 1), views(), rasterizer)


@torch.no_grad()
def changed_pixels(model, rows, cameras, rasterizer):
    """Mean squared change of the renders without these rows."""
    rest = GaussianModel(*(getattr(model, name).detach()[~rows] for name in RAW))
    errors = [
        (rasterizer.render(rest.gaussians(c, rasterizer), c, RasterOptions()).image
         - rasterizer.render(model.gaussians(c, rasterizer), c, RasterOptions()).image).square().mean()
        for c in cameras
    ]  # fmt: skip
    return float(torch.stack(errors).mean())


def test_the_lowest_half_is_missed_less_than_a_random_half_and_much_less_than_the_highest(rasterizer):
    n = 240
    model, cameras = model_of(n, dtype=torch.float32, scale=-3.0), views(dtype=torch.float32)
    with torch.no_grad():  # as after training: many small and faint ones among a few that carry the picture
        g = torch.Generator().manual_seed(5)
        model.log_scales -= 1.2 * torch.rand(n, 1, generator=g)
        model.opacity_logits += 3 * torch.randn(n, generator=g)
    order = scores(model, cameras, rasterizer, resolution=2).argsort()
    half = torch.zeros(3, n, dtype=torch.bool)
    half[0, order[: n // 2]] = True
    half[1, order[n // 2 :]] = True
    lowest, highest = (changed_pixels(model, half[i], cameras, rasterizer) for i in (0, 1))
    random = []
    for seed in range(10):
        rows = torch.zeros(n, dtype=torch.bool)
        rows[torch.randperm(n, generator=torch.Generator().manual_seed(seed))[: n // 2]] = True
        random.append(changed_pixels(model, rows, cameras, rasterizer))
    assert lowest < sum(random) / 10
    assert 10 * lowest < highest
