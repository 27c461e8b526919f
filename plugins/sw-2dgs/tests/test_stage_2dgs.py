"""The plan of 2DGS, its losses and when they act, its values by data set, its start."""

from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.density.budget import densify_to_budget
from sw_gaussians.ply import export_ply
from sw_gaussians.start import gaussians_from_points, surfels_from_points
from sw_gaussians.surfels import Surface, SurfelModel

from splatwizard_core.api import ParamGroup, SplatOptimizer
from splatwizard_core.base.random_states import seeded
from splatwizard_core.errors import ConfigError, SceneError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.camera import Camera
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.streams import stream
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_2dgs.config import TwoDGSConfig
from sw_2dgs.datasets import surface_of
from sw_2dgs.method import TwoDGS
from sw_2dgs.stage import TwoDGSStage

PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+-----------------------
Pre   | update lr                   | range(30000)
Pre   | increase SH degree          | range(0, 30000, 1000)
Post  | collect gradient statistics | range(15000)
Post  | prune and densify           | range(600, 15000, 100)
Post  | reset opacity               | range(0, 15000, 3000)"""
BLACK = torch.zeros(3)


def configured(**values) -> TwoDGSConfig:
    return apply_overrides(TwoDGSConfig(), {k.replace("__", "."): v for k, v in values.items()}, source="test")


def points(n: int = 200) -> PointCloud:
    g = torch.Generator().manual_seed(2)
    return PointCloud(torch.rand(n, 3, generator=g) - 0.5, torch.rand(n, 3, generator=g))


def scene_of(dataset: str = "demo", name: str = "demo", background: str = "black") -> Scene:
    up, target = torch.tensor([0.0, 1.0, 0.0]), torch.zeros(3)
    eyes = torch.tensor([[0.0, 0, -4], [3.0, 0, -3]])
    views = [
        View(Camera.look_at(e, target, up, width=16, height=16, fov_x=1.0), f"{i}.png") for i, e in enumerate(eyes)
    ]
    return Scene(name, views, views[:1], points(), Protocol(dataset, background=background))


def begun(stage: TwoDGSStage, scene: Scene, model=None) -> SurfelModel:
    model = model or surfels_from_points(points(), generator=torch.Generator().manual_seed(0))
    context = SimpleNamespace(model=model, scene=scene, ppl=PipelineParams(), generator=lambda name: stream(3, name))
    return stage.begin(context)


def test_the_plan_is_that_of_the_authors_code():
    (stage,) = TwoDGS(load_plugins(), TwoDGSConfig()).stages()
    pre, post = build_schedulers(stage, PipelineParams())
    assert format_plan(pre, post, total=stage.iterations) == PLAN
    assert stage.starts_from is None
    assert stage.control.min_opacity(stage.config.lr.opacity) == 0.05


def test_on_a_cpu_surfels_are_drawn_by_the_same_kernel_with_deterministic_sums():
    """Its sums always have one order there; on CUDA they have where that is asked for."""
    view, gradients = scene_of().train[0], []
    for deterministic in (False, True):
        model = surfels_from_points(points(), generator=torch.Generator().manual_seed(0))
        rasterizer = NegotiatedRasterizer(load_plugins(), device="cpu")
        stage = TwoDGSStage(TwoDGSConfig())
        with seeded(0, deterministic=deterministic):
            found = rasterizer.render(
                model.gaussians(view.camera, rasterizer), view.camera, stage.raster_options(1, BLACK)
            )
            found.image.square().mean().backward()
        assert rasterizer.served == {"2dgs"}
        gradients.append({name: parameter.grad for name, parameter in model.named_parameters()})
    assert bool(gradients[0]["means"].any())
    for name, plain in gradients[0].items():
        assert plain is gradients[1][name] is None or torch.equal(plain, gradients[1][name]), name


def least_opacity(**values) -> float:
    stage = TwoDGSStage(configured(**values))
    return stage.control.min_opacity(stage.config.lr.opacity)


def test_a_plan_too_short_to_recover_from_a_reset_prunes_below_it():
    assert least_opacity() == 0.05
    assert least_opacity(iterations=11_000, scale_schedule=True) == 0.05  # 37 steps; 33 lead from 0.01 to 0.05
    assert least_opacity(iterations=9_000, scale_schedule=True) == 0.005
    assert least_opacity(densify__interval=10) == 0.005
    assert least_opacity(densify__interval=10, densify__reset_interval=15_000) == 0.05  # no reset
    assert least_opacity(densify__interval=10, densify__min_opacity=0.001) == 0.001


def test_every_preset_and_rate_point_resolves():
    for preset in TwoDGS.PRESETS:
        for rate in TwoDGS.RATES:
            resolve(TwoDGS, preset, rate=rate, plugins=load_plugins())


@pytest.mark.parametrize(
    ("dataset", "scene", "expected"),
    [
        ("dtu", "scan24", Surface(1, 1000, 0.05)),
        ("mipnerf360", "garden", Surface(0, 0, 0.05)),
        ("tnt-geometry", "Barn", Surface(1, 100, 0.05)),
        ("tnt-geometry", "Courthouse", Surface(1, 10, 0.05)),
        ("nerf_synthetic", "lego", Surface(0, 0, 0)),
        ("demo", "demo", Surface(1, 100, 0.05)),
        ("colmap", "mine", Surface(0, 0, 0.05)),
    ],
)
def test_the_data_set_decides_what_is_unset(dataset, scene, expected):
    assert surface_of(dataset, scene) == expected
    stage = TwoDGSStage(TwoDGSConfig())
    assert begun(stage, scene_of(dataset, scene)).surface == stage.surface == expected


def test_what_the_user_sets_stays():
    stage = TwoDGSStage(configured(surface__depth_ratio=0.5, surface__lambda_dist=0.0))
    assert begun(stage, scene_of("dtu", "scan24")).surface == Surface(0.5, 0.0, 0.05)


def test_losses_act_after_their_steps_and_maps_are_drawn_only_then():
    stage = TwoDGSStage(TwoDGSConfig())
    begun(stage, scene_of())
    assert [stage.weights(step) for step in (1, 3000, 3001, 7000, 7001)] == [
        (0, 0), (0, 0), (100, 0), (100, 0), (100, 0.05),
    ]  # fmt: skip

    def asked(step: int) -> tuple:
        options = stage.raster_options(step, BLACK)
        assert options.grad2d
        return options.distortion, options.normals, options.alpha, set(options.depth)

    assert asked(3000) == (False, False, False, set())
    assert asked(3001) == (True, False, False, set())
    assert asked(7001) == (True, True, True, {"median"})
    assert stage.raster_options(7001, BLACK) is stage.raster_options(7002, BLACK)
    assert stage.raster_options(7003, torch.ones(3)).background.sum() == 3


def test_a_scene_of_weights_of_zero_never_draws_maps():
    stage = TwoDGSStage(TwoDGSConfig())
    begun(stage, scene_of("nerf_synthetic", "lego", "white"))
    options = stage.raster_options(30_000, BLACK)
    maps = (options.distortion, options.normals, options.alpha, set(options.depth))
    assert maps == (False, False, False, set())


def test_steps_of_the_losses_scale_with_the_schedule():
    stage = TwoDGSStage(configured(iterations=3000, scale_schedule=True))
    begun(stage, scene_of())
    assert [stage.weights(step) for step in (300, 301, 700, 701)] == [(0, 0), (100, 0), (100, 0), (100, 0.05)]


def test_quick_has_both_losses_well_before_its_end():
    config = resolve(TwoDGS, "quick").config
    assert config.surface.dist_after < config.surface.normal_after < config.iterations / 2


def test_the_loss_is_the_photometric_one_plus_the_weighted_parts():
    stage = TwoDGSStage(configured(surface__dist_after=0, surface__normal_after=0))
    scene, rasterizer = scene_of(), NegotiatedRasterizer(load_plugins(), device="cpu")
    model = begun(stage, scene)
    picture = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0))
    view = SimpleNamespace(camera=scene.train[0].camera, image=lambda background, device: picture)

    def drawn(step: int):
        options = stage.raster_options(step, BLACK)
        result = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, options)
        return stage.loss(model, view, result, BLACK, step)

    pack = drawn(1)
    assert set(pack.parts) == {"l1", "ssim", "distortion", "normals"}
    plain = drawn(0)  # no step of a training: both weights are 0
    assert set(plain.parts) == {"l1", "ssim"}
    expected = plain.total + 100 * pack.parts["distortion"] + 0.05 * pack.parts["normals"]
    torch.testing.assert_close(pack.total, expected)
    assert 0 < float(pack.parts["normals"]) < 2
    pack.total.backward()
    assert bool(torch.isfinite(model.quats.grad).all())
    assert model.log_scales.grad.shape == (200, 2)


def stage_with(density: str, **values) -> TwoDGSStage:
    config = configured(density=density, **values).completed(load_plugins(), {})
    return TwoDGSStage(config, config.density.load(load_plugins()))


@pytest.mark.parametrize(("density", "said"), [("mcmc", "density=mcmc"), ("budget", r"settings\.score=gradient")])
def test_what_surfels_do_not_have_is_refused_before_a_step(density, said):
    with pytest.raises(ConfigError, match=said):
        begun(stage_with(density), scene_of())


def test_a_budget_grows_surfels():
    model = surfels_from_points(points(), generator=torch.Generator().manual_seed(0))
    model.grad_accum.fill_(1.0)
    model.denom.fill_(1.0)
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.01) for name, _ in model.named_parameters()])
    n = model.num_rows
    densify_to_budget(model, optimizer, step=1, extent=1e-3, target=n + 7, score="gradient", min_opacity=0.0)
    assert (model.num_rows, model.log_scales.shape[1]) == (n + 7, 2)


def test_the_stage_refuses_other_gaussians():
    with pytest.raises(ConfigError, match="trains surfels"):
        begun(TwoDGSStage(TwoDGSConfig()), scene_of(), gaussians_from_points(points()))


def test_a_start_from_a_file_takes_surfels_only(tmp_path):
    surfels = surfels_from_points(points(), generator=torch.Generator().manual_seed(0))
    export_ply(surfels, tmp_path / "surfels.ply")
    export_ply(gaussians_from_points(points()), tmp_path / "ellipsoids.ply")

    def made(name: str):
        method = TwoDGS(load_plugins(), configured(init=str(tmp_path / name)))
        return method.create_model(scene_of(), torch.Generator())

    assert torch.equal(made("surfels.ply").quats, surfels.quats)
    with pytest.raises(SceneError, match="three scales each"):
        made("ellipsoids.ply")


def test_a_scene_without_points_is_an_error():
    scene = scene_of()
    scene.points = None
    with pytest.raises(SceneError, match="has no start points"):
        TwoDGS(load_plugins(), TwoDGSConfig()).create_model(scene, torch.Generator())


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("ratio", [0.0, 0.5])
def test_a_step_in_one_has_the_gradients_of_its_parts(device, ratio):
    scene = scene_of()
    stage = TwoDGSStage(configured(surface__dist_after=0, surface__normal_after=0, surface__depth_ratio=ratio))
    model = begun(stage, scene, surfels_from_points(points(), generator=torch.Generator().manual_seed(0)).to(device))
    pixels = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(1)).to(device)
    view = SimpleNamespace(camera=scene.train[0].camera.to(device), image=lambda background, device: pixels)
    rasterizer, black = NegotiatedRasterizer(load_plugins(), device=device), BLACK.to(device)
    state = SimpleNamespace(model=model, rasterizer=rasterizer, step=2)
    given = state, view, view.camera, black
    assert stage.whole_step(*given) is None  # `render` finds out first who can draw

    result = rasterizer.render(model.gaussians(view.camera, rasterizer), view.camera, stage.raster_options(2, black))
    pack = stage.loss(model, view, result, black, 2)
    pack.total.backward()
    expected = {name: p.grad for name, p in model.named_parameters()}
    model.zero_grad()
    for _ in range(2):  # the first one is checked, the second is like it
        found, loss = stage.whole_step(*given)
        assert list(loss.parts) == ["l1", "ssim", "distortion", "normals"]
        assert loss.total.item() == pytest.approx(pack.total.item(), rel=1e-6)
        torch.testing.assert_close(found.grad2d.value, result.grad2d.value)
        torch.testing.assert_close({name: p.grad for name, p in model.named_parameters()}, expected)
        model.zero_grad()
