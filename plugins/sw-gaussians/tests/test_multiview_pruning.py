"""Blame of several views: against a loop over pixels, and what late pruning does with it."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.fast_tasks import PruneByViews
from sw_gaussians.multiview_pruning import badly_drawn, draw_views, multiview_error_scores, normalized_scores
from sw_reference.rasterizer import ReferenceRasterizer

from splatwizard_core.api import (
    Camera,
    EmptyModel,
    GaussianModel,
    ParamGroup,
    PipelineParams,
    RasterOptions,
    SplatOptimizer,
    TaskLog,
    photometric_loss,
    stream,
)

SIZE = 12
BLACK = torch.zeros(3)
RASTERIZER = ReferenceRasterizer()
PPL = PipelineParams()


class Picture:
    """A view whose photograph is a tensor [3,H,W]."""

    def __init__(self, camera: Camera, image: torch.Tensor) -> None:
        self.camera, self._image = camera, image

    def image(self, background=None, device="cpu") -> torch.Tensor:
        return self._image


def model_of(means: torch.Tensor, opacities: torch.Tensor, seed: int = 0) -> GaussianModel:
    n, random = len(means), stream(seed, "model")
    return GaussianModel(
        means, torch.randn(n, 1, 3, generator=random), torch.zeros(n, 3, 3), torch.logit(opacities),
        torch.randn(n, 3, generator=random) * 0.3 - 1.5, torch.randn(n, 4, generator=random),
    )  # fmt: skip


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    random = stream(1, "means")
    opacities = torch.tensor([0.99] * 8 + [0.5, 0.2, 0.05, 0.02])  # the first eight hide what is behind them
    means = torch.randn(12, 3, generator=random) * torch.tensor([0.3, 0.3, 0.8])
    means[-1] = torch.tensor([0.0, 50.0, 0.0])  # no view shows it
    return model_of(means, opacities)


@pytest.fixture(scope="module")
def views() -> list[Picture]:
    random = stream(2, "pictures")
    eyes = ([0.0, 0.0, -3.0], [2.0, 0.5, -2.0])
    cameras = [
        Camera.look_at(
            torch.tensor(eye), torch.zeros(3), torch.tensor([0.0, -1.0, 0.0]), width=SIZE, height=SIZE, fov_x=0.8
        )
        for eye in eyes
    ]
    return [Picture(camera, torch.rand(3, SIZE, SIZE, generator=random)) for camera in cameras]


def plain_counts(model: GaussianModel, view: Picture, threshold: float) -> torch.Tensor:
    """Pixels [N] of one view that are badly drawn and have a Gaussian in them, one pixel after the other."""
    n, camera = model.num_rows, view.camera
    alone = []
    for i in range(n):
        single = GaussianModel(*(getattr(model, name).detach()[i : i + 1] for name in GaussianModel.RAW))
        drawn = RASTERIZER.render(single.gaussians(camera, RASTERIZER), camera, RasterOptions(alpha=True))
        alone.append(drawn.alpha[0].detach())
    depths = (model.means.detach() @ camera.R.T + camera.tau)[:, 2]
    image = RASTERIZER.render(model.gaussians(camera, RASTERIZER), camera, RasterOptions(background=BLACK)).image
    image = image.detach()
    error = [[float((image - view.image())[:, y, x].abs().mean()) for x in range(SIZE)] for y in range(SIZE)]
    low, high = min(map(min, error)), max(map(max, error))
    counts = torch.zeros(n, dtype=torch.int64)
    for y in range(SIZE):
        for x in range(SIZE):
            if (error[y][x] - low) / (high - low) <= threshold:
                continue
            light = 1.0
            for i in depths.argsort().tolist():
                alpha = float(alone[i][y, x])
                if alpha < 1 / 255:
                    continue
                if light * (1 - alpha) < 1e-4:
                    break
                light *= 1 - alpha
                counts[i] += 1
    return counts


@pytest.mark.parametrize("threshold", [0.1, 0.6])
def test_scores_are_what_a_loop_over_pixels_counts_times_the_losses(model, views, threshold):
    found = multiview_error_scores(model, views, RASTERIZER, BLACK, threshold=threshold)
    each = [plain_counts(model, view, threshold) for view in views]
    assert float(found[-1]) == 0 < float(found[0])
    scores = torch.zeros(model.num_rows)
    for view, counts in zip(views, each, strict=True):
        drawn = RASTERIZER.render(
            model.gaussians(view.camera, RASTERIZER), view.camera, RasterOptions(background=BLACK)
        )
        scores += photometric_loss(drawn.image, view.image()).total.detach() * counts
    assert torch.allclose(found, scores, rtol=1e-5)
    assert model.means.grad is None


def test_what_is_drawn_equally_well_everywhere_is_not_badly_drawn():
    image = torch.full((3, 4, 4), 0.5)
    assert not badly_drawn(image, torch.zeros(3, 4, 4), 0.1).any()
    image[:, 1, 2] = 1.0
    assert badly_drawn(image, torch.zeros(3, 4, 4), 0.1).nonzero().tolist() == [[1, 2]]


def test_normalized_scores_are_shares_that_one_outlier_does_not_decide():
    assert normalized_scores(torch.tensor([1.0, 2.0, 5.0])).tolist() == [0.0, 0.25, 1.0]
    scores = torch.arange(2000.0)
    scores[-1] = 1e9
    assert normalized_scores(scores)[999] == pytest.approx(0.5, abs=1e-3)


def test_normalized_scores_are_shares_of_the_largest_where_hardly_any_have_a_score():
    scores = torch.zeros(2000)
    scores[:2] = torch.tensor([1.0, 4.0])
    assert normalized_scores(scores)[:3].tolist() == [0.25, 1.0, 0.0]
    assert not normalized_scores(torch.full((5,), 3.0)).any()


def test_scores_that_are_not_finite_count_as_zero():
    scores = torch.tensor([float("nan"), 1.0, 4.0, float("inf"), 0.0])
    assert normalized_scores(scores).tolist() == [0.0, 0.25, 1.0, 0.0, 0.0]


def test_scores_are_of_the_pictures_and_the_loss_that_are_trained(model, views):
    white = torch.full((3,), 3.0)  # drawings above 1, which a clamped training does not see
    settings = {"lambda_dssim": 0.5, "padding": "valid"}
    found = multiview_error_scores(model, views[:1], RASTERIZER, white, clamp=True, **settings)
    plain = multiview_error_scores(model, views[:1], RASTERIZER, white)
    camera, truth = views[0].camera, views[0].image()
    drawn = RASTERIZER.render(model.gaussians(camera, RASTERIZER), camera, RasterOptions(background=white)).image
    loss = photometric_loss(drawn.detach().clamp(0, 1), truth, **settings).total
    pixels = found / loss
    assert torch.allclose(pixels, pixels.round(), atol=1e-3)
    assert not torch.equal(pixels.round(), (plain / photometric_loss(drawn.detach(), truth).total).round())


def test_scores_without_a_view_are_an_error(model):
    with pytest.raises(ValueError, match="at least one"):
        multiview_error_scores(model, [], RASTERIZER, BLACK)


def test_views_are_drawn_once_each_and_all_where_there_are_no_more():
    views = list(range(20))
    drawn = draw_views(views, 8, stream(3, "views"))
    assert len(set(drawn)) == 8
    assert drawn == draw_views(views, 8, stream(3, "views")) != draw_views(views, 8, stream(4, "views"))
    assert sorted(draw_views(views[:3], 8, stream(3, "views"))) == [0, 1, 2]


def optimizer_of(model: GaussianModel) -> SplatOptimizer:
    return SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in GaussianModel.RAW])


def scene_of(views) -> SimpleNamespace:
    return SimpleNamespace(train=views, background=BLACK, points=None, extent=10.0)


def test_late_pruning_takes_the_faint_and_the_guilty(model, views):
    own = model_of(model.means.detach().clone(), model.opacities.detach())
    stays = (own.opacities >= 0.1) & (normalized_scores(multiview_error_scores(own, views, RASTERIZER, BLACK)) <= 0.5)
    assert 0 < int(stays.sum()) < int((own.opacities >= 0.1).sum())
    expected = own.means.detach()[stays]
    call = (scene_of(views), SimpleNamespace(iterations=100))
    task = PruneByViews(views=2, most=0.5)
    task(own, optimizer_of(own), *call, 100, TaskLog(), RASTERIZER, PPL)
    assert own.num_rows == 12  # no update follows the last step
    log = TaskLog()
    task(own, optimizer_of(own), *call, 60, log, RASTERIZER, PPL)
    assert torch.equal(own.means, expected)
    with pytest.raises(EmptyModel):
        PruneByViews(views=1, min_opacity=1.0)(own, optimizer_of(own), *call, 60, TaskLog(), RASTERIZER, PPL)
    with pytest.raises(ValueError, match="views is 0"):
        PruneByViews(views=0)
