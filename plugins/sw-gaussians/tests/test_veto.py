"""Evidence of several views: counts against a loop over pixels, and what the veto and the late pruning do with it."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.budget import densify_to_budget
from sw_gaussians.fast_tasks import DensifyToBudget, PruneByViews
from sw_gaussians.fragments import add_buffer
from sw_gaussians.start import logit
from sw_gaussians.veto import ViewEvidence, badly_drawn, draw_views, view_evidence
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
def test_evidence_is_what_a_loop_over_pixels_counts(model, views, threshold):
    found = view_evidence(model, views, RASTERIZER, BLACK, threshold=threshold)
    each = [plain_counts(model, view, threshold) for view in views]
    assert torch.equal(found.counts, each[0] + each[1])
    assert int(found.counts[-1]) == 0 < int(found.counts[0])
    blame = torch.zeros(model.num_rows)
    for view, counts in zip(views, each, strict=True):
        drawn = RASTERIZER.render(
            model.gaussians(view.camera, RASTERIZER), view.camera, RasterOptions(background=BLACK)
        )
        blame += photometric_loss(drawn.image, view.image()).total.detach() * counts
    assert torch.allclose(found.blame, blame, rtol=1e-5)
    assert model.means.grad is None


def test_what_is_drawn_equally_well_everywhere_is_not_badly_drawn():
    image = torch.full((3, 4, 4), 0.5)
    assert not badly_drawn(image, torch.zeros(3, 4, 4), 0.1).any()
    image[:, 1, 2] = 1.0
    assert badly_drawn(image, torch.zeros(3, 4, 4), 0.1).nonzero().tolist() == [[1, 2]]


def test_wanted_is_the_whole_number_of_pixels_a_view_above_the_least():
    evidence = ViewEvidence(torch.tensor([0, 11, 12, 40]), torch.zeros(4), views=2)
    assert evidence.wanted(5).tolist() == [False, False, True, True]


def test_guilt_is_a_share_that_one_outlier_does_not_decide():
    few = ViewEvidence(torch.zeros(3), torch.tensor([1.0, 2.0, 5.0]), views=1)
    assert few.guilt().tolist() == [0.0, 0.25, 1.0]
    blame = torch.arange(2000.0)
    blame[-1] = 1e9
    assert ViewEvidence(torch.zeros(2000), blame, views=1).guilt()[999] == pytest.approx(0.5, abs=1e-3)


def test_guilt_is_a_share_of_the_largest_where_hardly_any_have_blame():
    blame = torch.zeros(2000)
    blame[:2] = torch.tensor([1.0, 4.0])
    assert ViewEvidence(torch.zeros(2000), blame, views=1).guilt()[:3].tolist() == [0.25, 1.0, 0.0]
    assert not ViewEvidence(torch.zeros(5), torch.full((5,), 3.0), views=1).guilt().any()


def test_blame_that_is_not_finite_is_none():
    blame = torch.tensor([float("nan"), 1.0, 4.0, float("inf"), 0.0])
    assert ViewEvidence(torch.zeros(5), blame, views=1).guilt().tolist() == [0.0, 0.25, 1.0, 0.0, 0.0]


def test_evidence_is_of_the_pictures_and_the_loss_that_are_trained(model, views):
    white = torch.full((3,), 3.0)  # drawings above 1, which a clamped training does not see
    settings = {"lambda_dssim": 0.5, "padding": "valid"}
    found = view_evidence(model, views[:1], RASTERIZER, white, clamp=True, **settings)
    plain = view_evidence(model, views[:1], RASTERIZER, white)
    assert not torch.equal(found.counts, plain.counts)
    camera, truth = views[0].camera, views[0].image()
    drawn = RASTERIZER.render(model.gaussians(camera, RASTERIZER), camera, RasterOptions(background=white)).image
    loss = photometric_loss(drawn.detach().clamp(0, 1), truth, **settings).total
    assert torch.allclose(found.blame, loss * found.counts, rtol=1e-5)


def test_evidence_without_a_view_is_an_error(model):
    with pytest.raises(ValueError, match="at least one"):
        view_evidence(model, [], RASTERIZER, BLACK)


def test_views_are_drawn_once_each_and_all_where_there_are_no_more():
    views = list(range(20))
    drawn = draw_views(views, 8, stream(3, "views"))
    assert len(set(drawn)) == 8
    assert drawn == draw_views(views, 8, stream(3, "views")) != draw_views(views, 8, stream(4, "views"))
    assert sorted(draw_views(views[:3], 8, stream(3, "views"))) == [0, 1, 2]


def optimizer_of(model: GaussianModel) -> SplatOptimizer:
    return SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in GaussianModel.RAW])


def hot(n: int) -> GaussianModel:
    """Gaussians on a line, small, of which each would be copied."""
    row = torch.arange(float(n))
    model = GaussianModel(
        row[:, None].repeat(1, 3), row[:, None, None].repeat(1, 1, 3), torch.zeros(n, 3, 3),
        torch.full((n,), logit(0.5)), torch.full((n, 3), -3.0), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
    )  # fmt: skip
    add_buffer(model)
    model.grad_accum.fill_(1e-3)
    model.denom.fill_(1)
    model.fragments[:, 1], model.fragments[:, 2] = 1.0, 10
    return model


@pytest.mark.parametrize(
    ("growth", "target", "company"), [(0.0, 100, [1, 4]), (2.0, 100, [1, 4]), (0.5, 100, 1), (0.0, 9, 1)]
)
def test_only_what_is_wanted_gets_company_and_counts_as_evidence(growth, target, company):
    model, wanted = hot(8), torch.tensor([0, 1, 0, 0, 1, 0, 0, 0], dtype=torch.bool)
    report = densify_to_budget(
        model, optimizer_of(model), step=1, extent=10.0, target=target, growth=growth, wanted=wanted
    )
    added = model.means[8:, 0].tolist()
    assert report.cloned == len(added)
    assert set(added) <= {1, 4}
    assert len(added) == company if isinstance(company, int) else added == company


def test_a_veto_of_all_leaves_the_model_as_it_is():
    model = hot(4)
    densify_to_budget(
        model, optimizer_of(model), step=1, extent=10.0, target=9, wanted=torch.zeros(4, dtype=torch.bool)
    )
    assert model.means[:, 0].tolist() == [0, 1, 2, 3]


def scene_of(views) -> SimpleNamespace:
    return SimpleNamespace(train=views, background=BLACK, points=None, extent=10.0)


def test_the_task_vetoes_by_the_views_that_it_draws(model, views):
    own = model_of(model.means.detach().clone(), model.opacities.detach())
    add_buffer(own)
    own.grad_accum.fill_(1e-3)
    own.denom.fill_(1)
    own.fragments[:, 1], own.fragments[:, 2] = 1.0, 10
    wanted = view_evidence(own, views, RASTERIZER, BLACK).wanted(5)
    assert 0 < int(wanted.sum()) < own.num_rows
    task = DensifyToBudget(first=0, last=10, cap=100, growth=0.0, veto_views=2, percent_dense=1.0)
    task(own, optimizer_of(own), scene_of(views), SimpleNamespace(iterations=100), 10, TaskLog(), RASTERIZER, PPL)
    assert own.num_rows == 12 + int(wanted.sum())
    with pytest.raises(ValueError, match="veto_views is -1"):
        DensifyToBudget(veto_views=-1)


def test_late_pruning_takes_the_faint_and_the_guilty(model, views):
    own = model_of(model.means.detach().clone(), model.opacities.detach())
    guilt = view_evidence(own, views, RASTERIZER, BLACK).guilt()
    stays = (own.opacities >= 0.1) & (guilt <= 0.5)
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
