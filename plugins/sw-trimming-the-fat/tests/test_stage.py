"""The plan is the published one; removals keep rows together; too few views are an error, not a quiet nothing."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.statistics import accumulate_statistics
from sw_kit.short_training import firings, train_stages

from splatwizard_core.errors import ConfigError, SceneError, TaskError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View
from splatwizard_core.training.optimizer import SplatOptimizer
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.tasks import TaskContext
from sw_trimming_the_fat.config import TrimmingTheFatConfig
from sw_trimming_the_fat.method import TrimmingTheFat
from sw_trimming_the_fat.stage import PruneBelowBoth, TrimmingStage

PAPER_PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+----------------------
Pre   | update lr                   | range(30000)
Post  | collect gradient statistics | range(100)
Post  | gradient aware prune        | range(100, 5000, 500)"""

ROWS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def stage_of(**values) -> TrimmingStage:
    values = {k.replace("__", "."): v for k, v in values.items()}
    return TrimmingStage(apply_overrides(TrimmingTheFatConfig(), values, source="test"), load_plugins())


def views_around(count=6, size=64):
    up, target = torch.tensor([0.0, 0.0, 1.0]), torch.zeros(3)
    angles = torch.arange(count) / count * 2 * torch.pi
    eyes = torch.stack([3 * angles.cos(), 3 * angles.sin(), torch.ones(count)], 1)
    return [Camera.look_at(eye, target, up, width=size, height=size, fov_x=0.8) for eye in eyes]


def toy_model(n=300, seed=0):
    """Half of the Gaussians are all but invisible, with distinct opacities (0.005 to 0.007)."""
    g = torch.Generator().manual_seed(seed)
    logits = torch.rand(n, generator=g) * 2 + 0.5
    weak = torch.randperm(n, generator=g)[: n // 2]
    logits[weak] = torch.logit(0.005 + 0.002 * torch.rand(n // 2, generator=g))
    quats = torch.randn(n, 4, generator=g)
    return GaussianModel(
        torch.rand(n, 3, generator=g) - 0.5, torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, 15, 3, generator=g), logits, torch.rand(n, 3, generator=g) * 0.5 - 3.2, quats,
    ), weak  # fmt: skip


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu")


def pictured(model, rasterizer, count=6):
    """A scene whose photographs are renders of `model`."""
    made = []
    for i, camera in enumerate(views_around(count)):
        with torch.no_grad():
            image = rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions()).image
        pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
        made.append(View(camera, f"{i}.png", lambda pixels=pixels: pixels))
    return Scene("toy", made, made[:1], None, Protocol("test"))


def trained(stage, model, scene, rasterizer, **options):
    return train_stages([stage], scene, rasterizer, trained={"3dgs": model}.__getitem__, **options).model


def test_the_plan_is_the_papers_table():
    pre, post = build_schedulers(stage_of(), PipelineParams())
    assert format_plan(pre, post) == PAPER_PLAN


def test_it_removes_ten_times_and_looks_at_99_steps():
    calendar = firings(stage_of())
    assert calendar["gradient aware prune"] == [100, 600, 1100, 1600, 2100, 2600, 3100, 3600, 4100, 4600]
    assert calendar["collect gradient statistics"] == list(range(1, 100))
    assert set(calendar) == {"update lr", "collect gradient statistics", "gradient aware prune"}
    assert calendar["update lr"] == list(range(1, 15_001))


def test_collecting_comes_before_pruning_in_one_step():
    _, post = build_schedulers(stage_of(prune__window=100), PipelineParams())
    assert [r.name for r in post.registrations if r.due(100)] == ["collect gradient statistics", "gradient aware prune"]


def test_a_scaled_plan():
    calendar = firings(stage_of(iterations=1500, scale_schedule=True))
    assert calendar["gradient aware prune"] == list(range(10, 500, 50))
    assert calendar["collect gradient statistics"] == list(range(1, 10))


@pytest.mark.parametrize("iterations", [1, 3, 200])
@pytest.mark.parametrize("refresh", ["once", "every_interval"])
def test_a_run_of_hardly_any_steps_has_statistics_at_its_first_removal(iterations, refresh):
    stage = stage_of(iterations=iterations, scale_schedule=True, prune__refresh=refresh)
    calendar = firings(stage)
    assert calendar["gradient aware prune"][0] == 1
    assert calendar["collect gradient statistics"][0] == 1
    _, post = build_schedulers(stage, PipelineParams())
    order = [r.name for r in post.registrations if r.due(1)]
    assert order[-2:] == ["collect gradient statistics", "gradient aware prune"]


def test_a_shortest_run_removes_what_its_one_view_says(rasterizer):
    model, _ = toy_model()
    scene = pictured(model, rasterizer, count=1)
    found = trained(stage_of(iterations=1, scale_schedule=True), model, scene, rasterizer)
    assert 0 < found.num_rows < 300


def test_removals_in_successive_steps_have_statistics_of_their_own_and_none_at_all_is_a_plan():
    values = {"prune__refresh": "every_interval", "prune__start": 3, "prune__interval": 1}
    calendar = firings(stage_of(**values, prune__stop=6))
    assert calendar["gradient aware prune"] == [3, 4, 5]
    assert calendar["clear gradient statistics"] == [1, 4, 5]
    assert calendar["collect gradient statistics"] == [1, 2, 4, 5]
    assert firings(stage_of(**values, prune__stop=0))["gradient aware prune"] == []


def test_gradients_may_be_averaged_anew_before_each_removal():
    calendar = firings(stage_of(prune__refresh="every_interval"))
    removals = calendar["gradient aware prune"]
    assert calendar["clear gradient statistics"] == [at - 99 for at in removals]
    assert calendar["collect gradient statistics"] == [step for at in removals for step in range(at - 99, at)]
    close = firings(stage_of(prune__refresh="every_interval", prune__interval=50, prune__stop=300))
    assert close["clear gradient statistics"] == [1, 101, 151, 201]  # never before a removal


def test_the_authors_flow_reads_what_the_3dgs_training_left():
    stage = TrimmingStage(resolve(TrimmingTheFat, "official").config, load_plugins())
    calendar = firings(stage)
    assert "collect gradient statistics" not in calendar
    assert calendar["gradient aware prune"] == list(range(1, 5000, 500))
    model, _ = toy_model()
    model.grad_accum += 5
    model.denom += 2
    context = SimpleNamespace(model=model)
    assert float(stage.begin(context).grad_accum.min()) == 5
    assert float(stage_of().begin(context).grad_accum.max()) == 0


def test_the_means_move_at_the_end_of_the_schedule_of_3dgs():
    scene = Scene("t", [View(c, f"{i}") for i, c in enumerate(views_around())], [], None, Protocol("test"))
    model, _ = toy_model()
    optimizer = stage_of().create_optimizer(model, scene)
    assert {n: g.lr for n, g in optimizer.groups.items()} == pytest.approx({
        "means": 1.6e-6 * scene.extent, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05,
        "log_scales": 5e-3, "quats": 1e-3,
    })  # fmt: skip
    assert all(group.eps == 1e-15 for group in optimizer.groups.values())


@pytest.mark.parametrize("preset", [*TrimmingTheFat.PRESETS])
@pytest.mark.parametrize("rate", [*TrimmingTheFat.RATES])
def test_every_preset_resolves_at_every_rate_point(preset, rate):
    config = resolve(TrimmingTheFat, preset, rate).config
    assert config.prune.level == TrimmingTheFat.RATES[rate]["prune.level"]
    assert len(firings(TrimmingStage(config, load_plugins()))["gradient aware prune"]) == 10


def test_rate_points_are_ordered_and_the_default_is_the_published_level():
    levels = [values["prune.level"] for values in TrimmingTheFat.RATES.values()]
    assert levels == sorted(levels, reverse=True)
    assert TrimmingTheFat.RATES[TrimmingTheFat.DEFAULT_RATE]["prune.level"] == TrimmingTheFatConfig().prune.level


def test_it_refuses_to_start_from_points_and_names_the_pruners_there_are():
    assert stage_of().starts_from == "3dgs"
    with pytest.raises(SceneError, match="trained 3dgs scene"):
        TrimmingTheFat(load_plugins(), TrimmingTheFatConfig()).create_model(SimpleNamespace(path="somewhere"), None)
    with pytest.raises(ConfigError, match=r"no pruner is called 'fat'; installed: .*opacity"):
        stage_of(prune__pruner="fat")
    with pytest.raises(ConfigError, match=r"prune\.refresh"):
        stage_of(prune__statistics="checkpoint", prune__refresh="every_interval")


def with_statistics(model, scene, rasterizer):
    """The model after one pass over the views with a loss that every pixel is in."""
    generator = torch.Generator().manual_seed(1)
    for view in scene.train:
        result = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, RasterOptions(grad2d=True))
        (result.image * torch.randn(result.image.shape, generator=generator)).sum().backward()
        accumulate_statistics(model, result.grad2d.value, result.radii)
    model.zero_grad()
    return model


def event(model, scene, rasterizer, task, step=100):
    optimizer = SplatOptimizer(model, TrimmingStage(TrimmingTheFatConfig(), load_plugins())
                               .create_optimizer(model, scene).groups.values())  # fmt: skip
    for name in ROWS:
        getattr(model, name).grad = torch.randn_like(getattr(model, name))
    optimizer.step()
    context = TaskContext(
        PipelineParams(), TrimmingTheFatConfig(), model, scene, optimizer, CameraIterator(scene.train), rasterizer
    )
    scores = task.pruner.score(model, [], None)
    before = {name: getattr(model, name).detach().clone() for name in model.ROWS}
    grads = {name: getattr(model, name).grad.clone() for name in ROWS}
    moments = {name: [m.clone() for m in optimizer.moments(name)[:2]] for name in ROWS}
    task(context.model, context.optimizer, context.cameras, context.rasterizer, context.scene, step, context.log)
    return optimizer, scores, before, grads, moments


def test_an_event_takes_rows_out_of_everything_and_leaves_the_survivors_as_they_are(rasterizer):
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    with_statistics(model, scene, rasterizer)
    task = PruneBelowBoth(load_plugins().pruners.load("trimming-the-fat")(), 0.425, 99)
    optimizer, scores, before, grads, moments = event(model, scene, rasterizer, task)
    left = scores >= 0.425
    assert 0 < int((~left).sum()) < 300
    for name in model.ROWS:
        assert torch.equal(getattr(model, name), before[name][left]), name
    for name in ROWS:
        assert torch.equal(getattr(model, name).grad, grads[name][left]), name  # still updated in this step
        for now, then in zip(optimizer.moments(name)[:2], moments[name], strict=True):
            assert torch.equal(now, then[left]), name


@torch.no_grad()
def psnr(model, reference, rasterizer):
    errors = []
    for camera in views_around():
        images = [rasterizer.render(m.gaussians(camera, rasterizer), camera, RasterOptions()).image
                  for m in (model, reference)]  # fmt: skip
        errors.append((images[0] - images[1]).square().mean())
    return float(-10 * torch.stack(errors).mean().log10())


def without(model, rows):
    return GaussianModel(*(getattr(model, name).detach()[~rows] for name in ROWS))


def test_what_goes_first_is_what_nobody_misses(rasterizer):
    model, weak = toy_model(n=400)
    scene = pictured(model, rasterizer)
    with_statistics(model, scene, rasterizer)
    scores = load_plugins().pruners.load("trimming-the-fat")().score(model, [], rasterizer)
    rows = scores < 0.45
    count = int(rows.sum())
    assert count > 100
    assert set(rows.nonzero().flatten().tolist()) <= set(weak.tolist())
    strongest = torch.zeros(400, dtype=torch.bool)
    strongest[scores.argsort(descending=True)[:count]] = True
    assert psnr(without(model, rows), model, rasterizer) > 40
    assert psnr(without(model, strongest), model, rasterizer) < 30


SMALL = {"iterations": 26, "prune__window": 6, "prune__start": 7, "prune__stop": 30, "prune__interval": 6}


@pytest.mark.parametrize("pruner", ["trimming-the-fat", "opacity", "pup-3dgs", "speedy-splat", "lightgaussian"])
def test_any_pruner_serves(rasterizer, pruner):
    if pruner not in load_plugins().pruners:
        pytest.skip(f"pruner {pruner} is not installed")
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    found = trained(stage_of(**SMALL, prune__pruner=pruner), model, scene, rasterizer)
    if pruner == "trimming-the-fat":
        assert 300 * (1 - 0.425) ** 4 < found.num_rows < 270
        return
    left = 300
    for _ in range(4):
        left -= int(0.425**2 * left + 1e-9)
    assert found.num_rows == left


def test_the_share_for_other_pruners_can_be_set(rasterizer):
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    found = trained(stage_of(**SMALL, prune__pruner="opacity", prune__fraction=0.1), model, scene, rasterizer)
    assert found.num_rows == 300 - 30 - 27 - 24 - 21


def test_training_begins_with_fresh_statistics_and_repeats_itself(rasterizer):
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    first = trained(stage_of(**SMALL), model, scene, rasterizer)
    model.grad_accum += 7
    model.denom += 1
    again = trained(stage_of(**SMALL), model, scene, rasterizer)
    assert first.digest() == again.digest()
    assert float(first.denom.max()) == 6  # the window, though it trained 26 steps


@pytest.mark.parametrize("stop", [4, 7, 15])  # within the window, at a removal, between two
@pytest.mark.parametrize("refresh", ["once", "every_interval"])
def test_stopped_and_resumed_equals_one_go(rasterizer, tmp_path, stop, refresh):
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    values = {**SMALL, "prune__refresh": refresh}
    whole = trained(stage_of(**values), model, scene, rasterizer)
    with pytest.raises(TrainingStopped):
        trained(stage_of(**values), model, scene, rasterizer, directory=tmp_path, stop_after=stop)
    assert trained(stage_of(**values), model, scene, rasterizer, directory=tmp_path).digest() == whole.digest()
    assert whole.num_rows < 300


def test_a_window_that_sees_too_few_views_is_an_error_that_says_what_to_set(rasterizer):
    model, _ = toy_model()
    with torch.no_grad():
        model.means[:200] += torch.tensor([0.0, 0.0, 50.0])  # behind or beside every camera
    scene = pictured(model, rasterizer)
    values = {**SMALL, "prune__window": 2, "prune__start": 3}
    with pytest.raises(TaskError, match=r"67% of the Gaussians have no gradient.*set prune\.window=6 and prune\.start"):
        trained(stage_of(**values), model, scene, rasterizer)


def test_in_a_scaled_run_it_names_steps_of_the_full_one(rasterizer):
    model, _ = toy_model()
    with torch.no_grad():
        model.means[:200] += torch.tensor([0.0, 0.0, 50.0])
    scene = pictured(model, rasterizer)
    values = {"iterations": 150, "scale_schedule": True, "prune__window": 250, "prune__start": 300}
    with pytest.raises(TaskError, match=r"2 steps of statistics .* set prune\.window=649 and"):
        trained(stage_of(**values), model, scene, rasterizer)
    enough = stage_of(**{**values, "prune__window": 649, "prune__start": 650})
    assert (enough.window, enough.removals.start) == (6, 7)


def test_if_every_view_was_seen_the_rule_takes_nothing_and_says_so(rasterizer, caplog):
    model, _ = toy_model()
    with torch.no_grad():
        model.means[:200] += torch.tensor([0.0, 0.0, 50.0])
    scene = pictured(model, rasterizer)
    found = trained(stage_of(**SMALL), model, scene, rasterizer)
    assert found.num_rows == 300
    assert "although every training view was seen" in caplog.text


def test_no_statistics_at_all_are_an_error(rasterizer):
    model, _ = toy_model()
    scene = pictured(model, rasterizer)
    with pytest.raises(TaskError, match="gradient statistics, which must be collected"):
        trained(stage_of(**SMALL, prune__statistics="checkpoint"), model, scene, rasterizer)
