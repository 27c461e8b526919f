"""The stage on a scene of a few Gaussians: plan, conversion, removal, rounding, and what the file gives back."""

import copy

import pytest
import torch
from sw_gaussians.density.mcmc import cap_for
from sw_gaussians.ply import export_ply
from sw_kit import short_training
from sw_kit.short_training import file_of, psnr

from splatwizard_core.api import Camera, View
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.errors import ConfigError, SceneError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.runs.pretrained import checked_start
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_wisp.config import WispConfig
from sw_wisp.conversion import kept_rows
from sw_wisp.method import Wisp
from sw_wisp.removal import unworthy
from sw_wisp.rounding import FINAL, HARD, NOISE, SOFT, Rounding, soft_round
from sw_wisp.stage import priced_pixels
from sw_wisp.worth import Worth

PLAN = """\
Stage | Task                             | Plan
------+----------------------------------+-------------------------
Pre   | update lr                        | range(18001)
Pre   | count bits                       | range(18001)
Pre   | begin noise                      | 1501
Pre   | steps follow the networks        | 4000
Pre   | fix levels                       | [6000, 9000]
Pre   | draw positions anywhere in cells | 6001
Pre   | place splats in cells            | 11500
Pre   | soft rounding                    | range(13000, 15501)
Pre   | eight bits in networks           | 13000
Pre   | hard rounding                    | 15501
Pre   | measure rate model               | range(1701, 15501, 200)
Pre   | measure rate model               | range(15501, 17000, 100)
Pre   | fix integers                     | 17000
Post  | remove by rate and distortion    | range(2500, 10501, 1000)"""

SHORT = {
    "iterations": 90, "scale_schedule": True, "prune.every": 4_000, "context.rebuild": 1_000, "context.fit": 20,
    "rate_term.lambda_": 3e-6,  # of three small pictures
}  # fmt: skip


def configured(plugins, **values):
    values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
    return Wisp(plugins, apply_overrides(WispConfig(), values, source="test").completed(plugins, {}))


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(directory=None, stop_after=None, losses=None, on_step=None, **values):
        method = configured(plugins, **values)
        model, steps = short_training.train(
            method, toy.scene, rasterizer, model=lambda: None, trained={"3dgs": toy.truth}.__getitem__,
            checkpoint_every=40, directory=directory, stop_after=stop_after, on_step=on_step,
        )  # fmt: skip
        if losses is not None:
            losses += steps
        return method, model

    return run


@pytest.fixture(scope="module", params=["none", "pyramid"])
def whole(train, request):
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # as `one_thread` has it for each test: sums over splats depend on the number
    try:
        return train(context__kind=request.param)
    finally:
        torch.set_num_threads(threads)


def decoded(plugins, data):
    return Wisp(plugins, None).decode(ContainerReader(data, "file.swz"))


def test_plan(plugins):
    (stage,) = Wisp(plugins, WispConfig()).stages()
    assert format_plan(*build_schedulers(stage, PipelineParams())) == PLAN
    assert (stage.iterations, stage.starts_from) == (18_000, "3dgs")


def test_step_sizes_fall_and_end_where_the_numbers_are_fixed(plugins):
    (stage,) = Wisp(plugins, WispConfig()).stages()
    assert stage.rates(0, 2.0)["means"] == pytest.approx(3.2e-5)
    assert stage.rates(9_000, 2.0)["latents"] == pytest.approx(5e-3 * 0.1**0.5)
    assert stage.rates(11_499, 2.0)["means"] > 0
    assert stage.rates(11_500, 2.0)["means"] == 0
    late = stage.rates(17_000, 2.0)
    assert late.pop("network") > 0
    assert not any(late.values())


def test_lambda_rises_over_its_ramp(plugins):
    (stage,) = Wisp(plugins, WispConfig()).stages()
    assert stage.price(2_000) == 0
    assert stage.price(3_000) == pytest.approx(stage.price() / 2)
    assert stage.price(4_000) == stage.price(17_000) == stage.price()


def test_a_bit_is_paid_by_the_pixels_of_all_training_pictures():
    assert priced_pixels(views_of(800, 800, 100)) == 640_000
    assert priced_pixels(views_of(400, 266, 255)) == pytest.approx(2.55 * 106_400)


def test_rate_points_and_presets_resolve():
    assert [resolve(Wisp, "quick", rate).config.rate_term.lambda_ for rate in Wisp.RATES] == sorted(
        (r["rate_term.lambda_"] for r in Wisp.RATES.values()), reverse=True
    )
    photographs = resolve(Wisp, "paper", scene="mipnerf360/garden")
    assert (photographs.pretrained, photographs.config.budget.cap) == ({"preset": "fast"}, None)


@pytest.mark.parametrize("scene", ["nerf_synthetic/lego", "blender:a/folder", "demo:tiny"])
def test_rendered_scenes_start_from_mcmc(scene):
    found = resolve(Wisp, "paper", scene=scene)
    assert (found.pretrained["preset"], found.pretrained["density.settings.cap"]) == ("mcmc", "none")
    assert (found.config.budget.density, found.config.budget.cap) == (1, None)
    assert resolve(Wisp, "fast", scene=scene).pretrained == {"preset": "fast"}


def test_there_is_no_start_from_points(plugins, toy):
    with pytest.raises(SceneError, match="trained 3dgs scene"):
        Wisp(plugins, WispConfig()).create_model(toy.scene, torch.Generator())


def test_conversion_keeps_the_worthiest_up_to_the_cap():
    change = torch.tensor([5.0, 0.1, 3.0, 0.0, 2.0, 7.0, 4.0, 1.0, 6.0, 9.0], dtype=torch.float64)
    cost = change.clone()
    cost[torch.tensor([1, 5, 7])] = -1.0
    config = apply_overrides(WispConfig(), {"budget.cap": 4, "budget.cap_factor": 0.5}, source="test")
    views = views_of(8, 8)
    assert kept_rows(Worth(change, cost, 1.0), views, config).tolist() == [5, 8, 9]  # 1.5 x 0.5 x 4
    rest = kept_rows(Worth(change, cost, 1.0), views, WispConfig()).tolist()
    assert rest == [0, 2, 4, 5, 6, 7, 8, 9]  # the pictures are as good without four, two of ten may go


def views_of(width, height, count=1):
    camera = Camera(width=width, height=height, fx=30.0, fy=30.0, cx=16.0, cy=12.0, R=torch.eye(3), tau=torch.zeros(3))
    return [View(camera, "a", lambda: None)] * count


def test_without_a_cap_as_many_begin_as_the_pixels_ask_for():
    assert cap_for(views_of(800, 800, 100)) == 250_000
    assert cap_for(views_of(1, 1)) == 31
    costs = torch.linspace(1, 2, 100, dtype=torch.float64)
    assert len(kept_rows(Worth(costs, costs, 1.0), views_of(3, 3), WispConfig())) == round(1.5 * 0.8 * 9)
    assert len(kept_rows(Worth(costs, costs, 1.0), views_of(4, 4, 10), WispConfig())) == 100


def test_a_run_from_before_the_density_goes_on_without_one(tmp_path):
    written, file = resolve(Wisp, "paper", scene="mipnerf360/garden").toml(), tmp_path / "config.toml"
    assert "density = 0.006\n" in written
    file.write_text(written.replace("density = 0.006\n", ""))
    assert resolve(Wisp, config_file=file).config.budget.density == 1
    file.write_text('preset = "paper"\nscene = "mipnerf360/garden"\n')  # of a user
    assert resolve(Wisp, config_file=file).config.budget.density == 0.006


def test_photographs_begin_with_few_splats_per_pixel():
    config = resolve(Wisp, "paper", scene="mipnerf360/garden").config
    costs = torch.linspace(1, 2, 900, dtype=torch.float64)
    assert len(kept_rows(Worth(costs, costs, 1.0), views_of(200, 200), config)) == round(1.5 * 0.8 * 240)
    assert config.budget.density * 27e6 == pytest.approx(cap_for(views_of(1000, 1000, 27)), rel=0.01)


def test_conversion_keeps_the_pictures(train, toy, rasterizer):
    _, model = train(iterations=1, scale_schedule=False, budget__worthless=0.0)
    # 12 of 45 dimensions of random SH coefficients are left.
    assert model.num_rows == toy.truth.num_rows
    assert psnr(model.eval(), toy.scene, rasterizer) > 26


def test_what_costs_more_than_it_is_worth_goes_worst_first():
    rise, bits = torch.tensor([1.0, 0.1, 5.0, -2.0, 0.3]), torch.tensor([10.0, 10.0, 10.0, 10.0, 1.0])
    assert unworthy(rise, bits, 0.05, 1.0).tolist() == [3, 1]
    assert unworthy(rise, bits, 0.2, 1.0).tolist() == [3, 1, 0]
    assert unworthy(rise, bits, 0.2, 0.4).tolist() == [3, 1]
    assert unworthy(rise, bits, 0.0, 1.0).tolist() == [3]


def test_soft_rounding_goes_from_nothing_to_rounding():
    y = torch.linspace(-2.45, 2.45, 99)
    assert (soft_round(y, 1.0) - y).abs().max() < 0.02
    sharp = soft_round(y, 60.0)
    far = (y - y.floor() - 0.5).abs() > 0.1
    assert torch.allclose(sharp[far], y.round()[far], atol=1e-3)


def test_rounding_of_each_phase():
    draws = torch.Generator().manual_seed(0)
    values = torch.randn(2_000, 3, generator=draws)
    mean, steps = torch.full_like(values, 0.1), torch.tensor([0.5, 1.0, 0.25]).expand(2_000, 3)

    def drawn(rounding):
        return rounding.drawn(values, mean, steps, rounding.noise(values))

    noisy = drawn(Rounding(NOISE)) - values
    assert (noisy.abs() <= steps / 2).all()
    assert torch.allclose(noisy.std(0), steps[0] / 12**0.5, rtol=0.05)
    hard = drawn(Rounding(HARD))
    k = (hard - mean) / steps
    assert torch.allclose(k, k.round(), atol=1e-5)
    assert ((hard - values).abs() <= steps / 2 + 1e-6).all()
    assert torch.allclose(drawn(Rounding(SOFT, 8.0)), hard, atol=0.51 * steps.max())
    assert torch.equal(drawn(Rounding(FINAL)), values)


def test_short_training_ends_with_integers_in_cells(whole):
    _, model = whole
    assert model.phase == FINAL
    forecast, drawn = model.predicted()
    assert torch.equal(drawn, model.numbers())
    if model.rate.CONTEXT == ("levels",):  # networks in integers are not quite those in floats
        k = (drawn - forecast.mean) / forecast.steps
        assert torch.allclose(k, k.round(), atol=2e-3)  # float32 values of up to a few hundred steps
    cells = model.cube.cells(model.means, model.levels)
    assert torch.equal(model.cube.centres(model.levels, cells), model.means.detach())


def test_fresh_decoder_draws_what_training_drew(whole, plugins, toy, rasterizer):
    method, model = whole
    model = copy.deepcopy(model).eval()
    found = decoded(plugins, file_of(method, model))
    assert isinstance(found, GaussianModel)
    part = type(found).from_tensors(**{name: each.detach()[:3] for name, each in found.named_parameters()})
    assert part.num_rows == 3
    assert part.parameter_hash() != found.parameter_hash()
    assert found.num_rows == model.num_rows
    camera = toy.scene.test[0].camera
    with torch.no_grad():
        ours, theirs = (
            rasterizer.render(m.gaussians(camera, rasterizer), camera, RasterOptions()).image for m in (found, model)
        )
    assert torch.allclose(ours, theirs, atol=2e-4)  # covariance by Jacobi in float32, or scales by a library


def test_estimated_bits_are_those_of_the_file(whole):
    method, model = whole
    data = file_of(method, model.eval())
    sections = ContainerReader(data, "file.swz").sections
    estimated = (model.bits().sum() + model.place_bits().sum()).item() / 8
    real = sections["packet.01"] + sections["packet.02"]
    # 90 steps leave networks that go far astray at single splats, where integers are clamped and floats are not.
    assert estimated == pytest.approx(real, rel=0.03 if model.rate.CONTEXT == ("levels",) else 0.1)


def test_more_lambda_leaves_fewer_splats_and_a_smaller_file(train):
    few, many = (train(context__kind="none", rate_term__lambda_=value) for value in (1e-4, 3e-7))
    assert few[1].num_rows < many[1].num_rows
    assert len(file_of(*few)) < len(file_of(*many))


def test_resumed_training_is_the_uninterrupted_one(train, whole, tmp_path):
    kind = {"context__kind": "none" if whole[1].rate.CONTEXT == ("levels",) else "pyramid"}
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=50, **kind)
    _, resumed = train(directory=tmp_path, **kind)
    assert resumed.digest() == whole[1].digest()


@pytest.mark.parametrize("rule", ["mid", "sensitivity"])
def test_rules_of_levels(train, rule):
    _, model = train(positions__rule=rule, iterations=1, scale_schedule=False)
    assert model.levels.min() >= 3
    assert model.levels.max() <= 18
    assert len(model.levels.unique()) > 1


def test_a_file_takes_the_place_of_the_scene_that_the_preset_would_train(plugins, toy, tmp_path):
    ply = tmp_path / "scene.ply"
    export_ply(toy.truth, ply)
    assert resolve(Wisp, "paper", plugins=plugins).pretrained
    found = checked_start(plugins, resolve(Wisp, "paper", sets={"init": str(ply)}, plugins=plugins))
    assert found.pretrained == {}
    asked = resolve(Wisp, "paper", sets={"init": str(ply), "pretrained.iterations": 9}, plugins=plugins)
    with pytest.raises(ConfigError, match="give one of them"):
        checked_start(plugins, asked)


def test_latents_may_have_steps_of_their_own(train):
    _, alike = train(iterations=1, scale_schedule=False)
    _, own = train(iterations=1, scale_schedule=False, appearance__steps="sensitivity", appearance__spread=1.5)
    ratio = own.rate.base_steps / alike.rate.base_steps
    assert torch.equal(ratio[:10], torch.ones(10, dtype=torch.float64))
    assert len(ratio[10:].unique()) > 3
    assert ratio.min() >= 1 / 1.5 - 1e-9
    assert ratio.max() <= 1.5 + 1e-9
