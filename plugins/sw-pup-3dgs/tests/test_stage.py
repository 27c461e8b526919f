"""The plan is the published one: two rounds, fresh Adam, exact counts, no update in the step of a removal."""

from types import SimpleNamespace

import pytest
import torch
from sw_kit.short_training import firings, train_stages

from splatwizard_core.errors import ConfigError, EmptyModel, SceneError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import Protocol, Scene, View
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_pup_3dgs.config import Pup3DGSConfig
from sw_pup_3dgs.method import Pup3DGS
from sw_pup_3dgs.stage import PupStage, start_round

PAPER_PLAN = """\
Stage | Task        | Plan
------+-------------+-------------
Pre   | start round | [1, 5001]
Pre   | update lr   | range(30000)
Post  | PUP prune   | [1, 5001]"""

RAW = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def config_of(**values):
    return apply_overrides(Pup3DGSConfig(), {k.replace("__", "."): v for k, v in values.items()}, source="test")


def stage_of(**values) -> PupStage:
    return PupStage(config_of(**values), load_plugins())


def toy_model(n=200, seed=0):
    g = torch.Generator().manual_seed(seed)
    return GaussianModel(
        torch.rand(n, 3, generator=g) - 0.5, torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, 3, 3, generator=g), torch.randn(n, generator=g),
        torch.rand(n, 3, generator=g) * 0.5 - 3, torch.randn(n, 4, generator=g),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu")


@pytest.fixture(scope="module")
def scene(rasterizer):
    """Photographs that are renders of other Gaussians than the toy model's."""
    made, truth, up = [], toy_model(seed=1), torch.tensor([0.0, 0.0, 1.0])
    for i, angle in enumerate(torch.arange(6) / 6 * 2 * torch.pi):
        eye = torch.stack([3 * angle.cos(), 3 * angle.sin(), torch.tensor(1.0)])
        camera = Camera.look_at(eye, torch.zeros(3), up, width=48, height=40, fov_x=0.8)
        with torch.no_grad():
            image = rasterizer.render(truth.gaussians(camera, rasterizer), camera, RasterOptions()).image
        pixels = (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()
        made.append(View(camera, f"{i}.png", lambda pixels=pixels: pixels))
    return Scene("toy", made, made[:1], None, Protocol("test"))


def trained(stage, model, scene, rasterizer, **options):
    return train_stages([stage], scene, rasterizer, trained={"3dgs": model}.__getitem__, **options).model


def test_the_plan_is_the_papers():
    pre, post = build_schedulers(stage_of(), PipelineParams())
    assert format_plan(pre, post) == PAPER_PLAN


def test_it_removes_at_the_first_step_of_each_round_and_sets_the_rates_at_every_step():
    calendar = firings(stage_of())
    assert calendar == {"start round": [1, 5001], "PUP prune": [1, 5001], "update lr": list(range(1, 10_001))}


def test_a_scaled_plan_and_one_that_is_too_short():
    stage = stage_of(iterations=1000, scale_schedule=True)
    assert firings(stage)["PUP prune"] == [1, 500]
    assert dict(stage.removals()) == {1: 0.8, 500: 0.5}
    with pytest.raises(ConfigError, match="too close together"):
        stage_of(iterations=1, scale_schedule=True)


def rates_at(stage, scene, steps):
    model = toy_model()
    optimizer = stage.create_optimizer(model, scene)
    pre, _ = build_schedulers(stage, PipelineParams())
    task = next(r.task for r in pre.registrations if r.name == "update lr")
    found = {}
    for step in steps:
        task(optimizer, scene, step)
        found[step] = {name: group.lr for name, group in optimizer.groups.items()}
    return found


def test_the_rates_of_the_authors_code_begin_anew_in_each_round(scene):
    rates = rates_at(stage_of(), scene, [1, 399, 400, 5000, 5001, 5400, 10_000])
    extent = scene.extent
    assert rates[1]["means"] / extent == pytest.approx(3.09e-6, rel=2e-3)
    assert rates[5000]["means"] / extent == pytest.approx(1.6e-6, rel=1e-9)
    assert rates[5001] == rates[1]
    assert rates[5400] == rates[400]
    assert rates[10_000] == rates[5000]
    assert rates[399]["opacity_logits"] == 0.05
    assert rates[400]["opacity_logits"] == pytest.approx(0.05 * 0.95)
    assert rates[5000]["quats"] == pytest.approx(1e-3 * 0.95**12)
    assert [rates[1][n] for n in RAW[1:]] == pytest.approx([2.5e-3, 1.25e-4, 0.05, 5e-3, 1e-3])


def test_the_preset_of_the_splatwizard_paper_holds_the_rates_constant(scene):
    stage = PupStage(resolve(Pup3DGS, "splatwizard").config, load_plugins())
    rates = rates_at(stage, scene, [1, 5000, 9999])
    assert rates[1] == rates[5000] == rates[9999]
    assert rates[1]["means"] / scene.extent == pytest.approx(1.6e-6)


@pytest.mark.parametrize("preset", [*Pup3DGS.PRESETS])
@pytest.mark.parametrize("rate", [*Pup3DGS.RATES])
def test_every_preset_resolves_at_every_rate_point(preset, rate):
    config = resolve(Pup3DGS, preset, rate).config
    assert config.prune.fractions == Pup3DGS.RATES[rate]["prune.fractions"]
    assert len(firings(PupStage(config, load_plugins()))["PUP prune"]) == 2


def test_rate_points_remove_what_the_readme_says():
    left = dict.fromkeys(Pup3DGS.RATES, 1.0)
    for rate, values in Pup3DGS.RATES.items():
        for share in values["prune.fractions"]:
            left[rate] *= 1 - share
    assert {rate: round(100 - 100 * share, 6) for rate, share in left.items()} == {
        "r1": 95, "r2": 92.5, "r3": 90, "r4": 85, "r5": 80, "r6": 60,
    }  # fmt: skip
    assert Pup3DGS.RATES[Pup3DGS.DEFAULT_RATE]["prune.fractions"] == Pup3DGSConfig().prune.fractions


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"prune__steps": [1]}, "names 1 rounds"),
        ({"prune__steps": [5, 5]}, "ascend"),
        ({"prune__steps": [0, 5]}, "ascend"),
        ({"prune__fractions": [0.5, 1.0]}, "shares"),
        ({"prune__settings__resolution": 3}, "one of 1, 2, 4, 8"),
        ({"prune__pruner": "pupp"}, "no pruner is called 'pupp'; installed: .*pup-3dgs"),
    ],
)
def test_bad_plans_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        stage_of(**values)


def test_it_refuses_to_start_from_points():
    assert stage_of().starts_from == "3dgs"
    with pytest.raises(SceneError, match="trained 3dgs scene"):
        Pup3DGS(load_plugins(), Pup3DGSConfig()).create_model(SimpleNamespace(path="somewhere"), None)


def test_a_round_begins_with_an_adam_that_knows_nothing(scene):
    model = toy_model()
    optimizer = stage_of().create_optimizer(model, scene)
    for parameter in model.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    assert optimizer.moments("means")[2] == 1
    rate = optimizer.lr("quats")
    start_round(optimizer)
    assert all(optimizer.moments(name) is None for name in RAW)
    assert optimizer.lr("quats") == rate
    optimizer.step()
    assert optimizer.moments("means")[2] == 1


def test_counts_and_nothing_is_updated_in_the_step_of_a_removal(scene, rasterizer):
    model, counts = toy_model(), {}
    stage = stage_of(iterations=8, prune__steps=[1, 5], prune__settings__resolution=1)
    found = trained(
        stage, model, scene, rasterizer, on_step=lambda _, record: counts.update({record.step: record.num_rows})
    )
    assert counts == {1: 40, 2: 40, 3: 40, 4: 40, 5: 20, 6: 20, 7: 20, 8: 20}
    assert found.num_rows == 20
    only_pruned = trained(
        stage_of(iterations=2, prune__steps=[1, 5], prune__settings__resolution=1), model, scene, rasterizer
    )
    # Step 1 removes, step 2 is the last, which updates nothing: the survivors are rows of the model as it was.
    rows = {tuple(row) for row in model.means.detach().tolist()}
    assert {tuple(row) for row in only_pruned.means.detach().tolist()} <= rows


@pytest.mark.parametrize("stop", [1, 5, 8, 9])  # at a removal, within a round, before and at the next removal
def test_stopped_and_resumed_equals_one_go(scene, rasterizer, tmp_path, stop):
    values = {"iterations": 12, "prune__steps": [1, 9]}
    whole = trained(stage_of(**values), toy_model(), scene, rasterizer)
    with pytest.raises(TrainingStopped):
        trained(stage_of(**values), toy_model(), scene, rasterizer, directory=tmp_path, stop_after=stop)
    found = trained(stage_of(**values), toy_model(), scene, rasterizer, directory=tmp_path)
    assert found.digest() == whole.digest()
    assert found.num_rows == 20


@pytest.mark.parametrize("iterations", [2, 3])
def test_a_run_of_hardly_any_steps(scene, rasterizer, iterations):
    stage = stage_of(iterations=iterations, scale_schedule=True, prune__steps=[1, 10_000])
    assert trained(stage, toy_model(), scene, rasterizer).num_rows == 20


def test_the_lowest_scores_go(scene, rasterizer):
    model = toy_model()
    pruner = load_plugins().pruners.load("pup-3dgs")(resolution=2)
    scores = pruner.score(model, [view.camera for view in scene.train], rasterizer, scene.background)
    keep = scores.argsort(stable=True)[100:].sort().values
    found = trained(
        stage_of(iterations=1, prune__steps=[1], prune__fractions=[0.5], prune__settings__resolution=2),
        model,
        scene,
        rasterizer,
    )
    assert torch.equal(found.means, model.means[keep])


def test_the_official_count_takes_one_more_or_all_equal_ones(scene, rasterizer):
    values = {"iterations": 1, "prune__steps": [1], "prune__fractions": [0.5], "prune__count_rule": "official"}
    assert trained(stage_of(**values), toy_model(), scene, rasterizer).num_rows == 100
    assert trained(stage_of(**values), toy_model(201), scene, rasterizer).num_rows == 100


def test_nothing_left_is_an_error(scene, rasterizer):
    hidden = toy_model(10)
    with torch.no_grad():
        hidden.means += 100.0
    stage = stage_of(iterations=2, prune__steps=[1], prune__fractions=[0.5], prune__count_rule="official")
    with pytest.raises(EmptyModel, match="step 1"):
        trained(stage, hidden, scene, rasterizer)


@pytest.mark.parametrize("pruner", ["opacity", "trimming-the-fat", "speedy-splat", "lightgaussian"])
def test_any_pruner_serves_with_the_same_counts(scene, rasterizer, pruner):
    if pruner not in load_plugins().pruners:
        pytest.skip(f"pruner {pruner} is not installed")
    values = {"iterations": 20, "prune__steps": [1, 16], "prune__window": 6, "prune__pruner": pruner}
    found = trained(stage_of(**values), toy_model(), scene, rasterizer)
    assert found.num_rows == 20


def test_a_pruner_that_reads_statistics_waits_until_it_has_some():
    if "trimming-the-fat" not in load_plugins().pruners:
        pytest.skip("no pruner that reads statistics is installed")
    calendar = firings(stage_of(prune__pruner="trimming-the-fat"))
    assert calendar["prune by trimming-the-fat"] == [100, 5001]
    assert calendar["collect gradient statistics"] == [*range(1, 100), *range(4902, 5001)]
    assert calendar["clear gradient statistics"] == [1, 4902]
    assert calendar["start round"] == [1, 5001]


def test_statistics_of_two_close_removals_do_not_mix():
    if "trimming-the-fat" not in load_plugins().pruners:
        pytest.skip("no pruner that reads statistics is installed")
    calendar = firings(stage_of(prune__pruner="trimming-the-fat", prune__steps=[1, 150]))
    assert calendar["prune by trimming-the-fat"] == [100, 150]
    assert calendar["clear gradient statistics"] == [1, 101]  # not at 51, within the window of the first
    assert calendar["collect gradient statistics"] == [*range(1, 100), *range(101, 150)]
    next_step = firings(stage_of(prune__pruner="trimming-the-fat", prune__steps=[1, 101]))
    assert next_step["clear gradient statistics"] == [1, 101]
    assert next_step["collect gradient statistics"] == [*range(1, 100), 101]


def test_the_window_of_statistics_is_scaled_with_the_plan():
    if "trimming-the-fat" not in load_plugins().pruners:
        pytest.skip("no pruner that reads statistics is installed")
    calendar = firings(stage_of(prune__pruner="trimming-the-fat", iterations=1000, scale_schedule=True))
    assert calendar["prune by trimming-the-fat"] == [11, 500]
    assert calendar["collect gradient statistics"] == [*range(1, 11), *range(490, 500)]


def test_a_removal_that_would_wait_beyond_the_end_is_told():
    if "trimming-the-fat" not in load_plugins().pruners:
        pytest.skip("no pruner that reads statistics is installed")
    with pytest.raises(ConfigError, match=r"at step 100, after 99 steps .* ends at step 50: lower prune\.window"):
        stage_of(prune__pruner="trimming-the-fat", iterations=50)
    assert firings(stage_of(iterations=50))["PUP prune"] == [1]  # one round, as published beside the two
