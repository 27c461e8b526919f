"""TrimGS on surfels of a few pixels: plans, masks, the losses, resume, what the file gives back."""

import copy

import numpy as np
import pytest
import torch
from sw_gaussians.surfels import Surface, SurfelModel
from sw_kit.short_training import firings
from sw_kit.short_training import train as train_method

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError, EmptyModel, UserInputError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene, View
from splatwizard_core.training.losses import LossPack
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers
from sw_trimgs.normals import smooth_pixels
from sw_trimgs.surfel_config import SurfaceTuning, Trim2DGSConfig
from sw_trimgs.surfel_method import Trim2DGS, Trim2DGSScratch
from sw_trimgs.surfel_stage import smooth_surface, within_masks

SHORT = {
    "iterations": 10, "densify.interval": 2, "densify.stop": 10, "densify.reset_interval": 0, "trim.interval": 4,
    "trim.after": 2,
}  # fmt: skip
TENSORS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def surfels_of(model, count=None):
    tensors = {name: getattr(model, name).detach()[:count].clone() for name in TENSORS}
    tensors["log_scales"] = tensors["log_scales"][:, :2].contiguous()
    return SurfelModel(*tensors.values())


def configured(plugins, **values):
    values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
    return Trim2DGS(plugins, apply_overrides(Trim2DGSConfig(), values, source="test").completed(plugins, {}))


@pytest.fixture(scope="module")
def start(toy):
    model = surfels_of(toy.truth, 120)
    model.surface = Surface(0.5)
    return model


def run_of(method, scene, rasterizer, trained, **options):
    return train_method(
        method, scene, rasterizer, trained=lambda name: copy.deepcopy(trained), checkpoint_every=5, **options
    ).model


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy, start):
    def run(directory=None, stop_after=None, on_step=None, **values):
        method = configured(plugins, **values)
        return method, run_of(
            method, toy.scene, rasterizer, start, directory=directory, stop_after=stop_after, on_step=on_step
        )

    return run


@pytest.fixture(scope="module")
def whole(train):
    return train()


def fires(method):
    (stage,) = method.stages()
    return firings(stage)


def preset(plugins, cls, name, **sets):
    return cls(plugins, resolve(cls, name, sets=sets, plugins=plugins).config)


def test_the_plans_are_the_published_ones(plugins):
    assert fires(preset(plugins, Trim2DGS, "paper"))["trim"] == list(range(1500, 7000, 500))
    assert len(fires(preset(plugins, Trim2DGS, "dtu"))["trim"]) == 59
    tnt = fires(preset(plugins, Trim2DGS, "tnt"))
    assert tnt["trim"] == list(range(1200, 7000, 300))
    assert "reset opacity" not in tnt
    assert preset(plugins, Trim2DGS, "paper").stages()[0].starts_from == "2dgs"


def test_the_plan_from_scratch_is_the_published_one(plugins):
    calendar = fires(preset(plugins, Trim2DGSScratch, "paper"))
    assert calendar["trim"] == list(range(600, 15_000, 300))
    assert len(fires(preset(plugins, Trim2DGSScratch, "dtu"))["trim"]) == 144
    assert calendar["scale split"] == calendar["prune and densify"] == list(range(600, 15_000, 100))
    (stage,) = preset(plugins, Trim2DGSScratch, "paper").stages()
    _, post = build_schedulers(stage, PipelineParams())
    assert [r.name for r in post.registrations if r.due(3000)] == [
        "collect gradient statistics", "prune and densify", "scale split", "trim", "reset opacity",
    ]  # fmt: skip


def test_what_the_method_sets_itself_is_refused_in_base(plugins):
    with pytest.raises(ConfigError, match=r"base\.surface\.lambda_normal"):
        preset(plugins, Trim2DGSScratch, "paper", **{"base.surface.lambda_normal": 0.1}).stages()


def test_it_starts_from_surfels(plugins, rasterizer, toy):
    with pytest.raises(UserInputError, match="two scales"):
        run_of(configured(plugins), toy.scene, rasterizer, toy.truth)


def test_the_surface_is_that_of_the_scene_before_where_nothing_is_set(whole, train):
    assert whole[1].surface == Surface(0.5, 100.0, 0.05)
    _, model = train(iterations=1, surface__depth_ratio=1.0, surface__lambda_dist=3.0)
    assert model.surface == Surface(1.0, 3.0, 0.05)


def test_both_losses_are_on_from_the_first_step(train):
    parts = []
    train(iterations=1, on_step=lambda _, record: parts.append(record.parts))
    assert {"distortion", "normals"} <= set(parts[0])
    train(
        iterations=1, surface__lambda_dist=0, surface__lambda_normal=0,
        on_step=lambda _, record: parts.append(record.parts),
    )  # fmt: skip
    assert not {"distortion", "normals"} & set(parts[1])


def test_the_normal_term_is_that_of_2dgs_away_from_edges(start, toy, rasterizer):
    from sw_gaussians.surface_losses import add_surface_losses, maps_for, normal_disagreement

    camera = toy.scene.train[0].camera
    options = RasterOptions(**maps_for(distortion=False, normals=True, depth_ratio=0.0))
    with torch.no_grad():
        drawn = rasterizer.render(start.gaussians(camera, rasterizer), camera, options)
    whole = normal_disagreement(drawn, camera, 0.0)
    assert torch.equal(smooth_surface(drawn, 0.0, SurfaceTuning(edge_threshold=0.0)), torch.ones_like(whole))
    mask = smooth_surface(drawn, 0.0, SurfaceTuning(edge_threshold=0.5, erosion=1))
    assert torch.equal(mask, smooth_pixels(drawn.depth["expected"], 0.5, 1))
    assert 0 < float(mask.mean()) < 1
    pack = add_surface_losses(LossPack(torch.tensor(2.0), {}), drawn, camera, 0.0, normals=0.5, mask=mask)
    assert float(pack.parts["normals"]) == pytest.approx(float((mask * whole).mean()))
    assert float(pack.total) == pytest.approx(2 + 0.5 * float((mask * whole).mean()))


def test_surfels_are_trimmed_and_split(train):
    seen, said = set(), []

    def note(_, record):
        seen.update(name.rpartition(".")[2] for name in record.scalars)
        said.extend(text for _, text in record.said)

    _, model = train(iterations=6, on_step=note)
    assert {"scale_split", "trimmed"} <= seen
    assert any("trimmed" in text for text in said)
    assert model.log_scales.shape[1] == 2


@pytest.mark.parametrize("stop", [1, 7])
def test_stopped_and_resumed_equals_one_go(train, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=stop)
    assert train(directory=tmp_path)[1].digest() == whole[1].digest()


@pytest.mark.parametrize(("rate", "atol"), [("r6", 1e-6), ("r5", 0.003)])
def test_a_fresh_decoder_draws_what_was_trained(plugins, whole, toy, rasterizer, rate, atol):
    model, camera = whole[1], toy.scene.test[0].camera
    method = Trim2DGS(plugins, resolve(Trim2DGS, "paper", rate=rate, plugins=plugins).config)
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    data = writer.to_bytes()
    found = Trim2DGS(plugins, None).decode(ContainerReader(data, "file.swz"))
    assert found.surface == model.surface
    with torch.no_grad():
        ours, theirs = (
            rasterizer.render(m.gaussians(camera, rasterizer), camera, RasterOptions()).image for m in (model, found)
        )
    assert float((ours - theirs).abs().mean()) <= atol  # the mean: at the rim of a surfel a pixel is in or out
    damaged = bytearray(data)
    damaged[-7] ^= 1
    with pytest.raises(BitstreamError):
        Trim2DGS(plugins, None).decode(ContainerReader(bytes(damaged), "file.swz"))


def masked(make, columns):
    """A view straight at the origin whose mask is True in the first `columns` columns."""
    mask = np.zeros((36, 48), dtype=bool)
    mask[:, :columns] = True
    return View(make.camera([0.0, 0.0, -4.0]), "a.png", load_mask=lambda: mask)


def places(*xs):
    n = len(xs)
    means = torch.tensor([[x, 0.0, z] for x, z in xs])
    return SurfelModel(
        means, torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.zeros(n), torch.zeros(n, 2), torch.ones(n, 4)
    )


def test_what_lies_outside_a_mask_goes_and_what_the_image_does_not_show_stays(make):
    camera = make.camera([0.0, 0.0, -4.0])
    right = float(camera.R[0, 0])  # whether x grows to the right or to the left in the picture
    model = places((-0.5 * right, 0.0), (0.5 * right, 0.0), (30.0, 0.0), (0.5 * right, -9.0))
    kept = within_masks(model, [masked(make, 24)])
    assert kept.means.tolist() == model.means[[0, 2, 3]].tolist()
    assert within_masks(model, [View(camera, "b.png")]).num_rows == 4
    with pytest.raises(EmptyModel):
        within_masks(places((0.5 * right, 0.0)), [masked(make, 24)])


def test_the_opaque_part_of_a_picture_is_its_mask(make):
    pixels = np.zeros((36, 48, 4), dtype=np.uint8)
    pixels[:, :24, 3] = 128
    view = View(make.camera([0.0, 0.0, -4.0]), "c.png", lambda: pixels)
    right = float(view.camera.R[0, 0])
    assert within_masks(places((-0.5 * right, 0.0), (0.5 * right, 0.0)), [view]).num_rows == 1


def test_from_scratch_it_trains_and_trims(plugins, toy, rasterizer):
    sets = {
        "iterations": 8, "densify.start": 2, "densify.interval": 2, "trim.after": 0, "trim.interval": 3,
        "surface.normal_after": 4, "base.densify.start": 2, "base.densify.interval": 2,
        "base.densify.min_opacity": 0.0,
    }  # fmt: skip
    method = preset(plugins, Trim2DGSScratch, "paper", **sets)
    points = PointCloud(toy.truth.means[:90], torch.full((90, 3), 0.5))
    scene = Scene("toy", toy.scene.train, toy.scene.test, points, Protocol("toy"))
    parts, seen = [], set()

    def note(_, record):
        parts.append(record.parts)
        seen.update(name.rpartition(".")[2] for name in record.scalars)

    model = run_of(method, scene, rasterizer, None, on_step=note)
    assert ["normals" in each for each in parts] == [False] * 4 + [True] * 4
    assert {"scale_split", "trimmed", "cloned"} <= seen
    assert model.surface == Surface(0.0, 100.0, 0.05)
