"""Trim3DGS on a scene of a few Gaussians: plan, what each mode does, resume, what the file gives back."""

import copy

import pytest
import torch
from sw_kit.short_training import firings, train_stages
from sw_kit.short_training import train as train_method

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SceneError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.scene.scene import PointCloud, Protocol, Scene
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_trimgs.config import Trim3DGSConfig
from sw_trimgs.flat import FlatGaussians, flattened
from sw_trimgs.method import Flat3DGS, Trim3DGS

PLAN = """\
Stage | Task                        | Plan
------+-----------------------------+------------------------------------------
Pre   | update lr                   | range(7000)
Pre   | draw normals                | range(1, 7001)
Post  | collect gradient statistics | range(7000)
Post  | scale split                 | range(0, 7000, 100)
Post  | trim                        | [1500, 2000, 2500, 3000, 3500, 4000, ...]
Post  | reset opacity               | range(0, 7000, 3000)
Post  | forget neighbours           | range(0, 7000, 100)"""

SHORT = {
    "iterations": 12, "densify.interval": 2, "densify.stop": 12, "densify.reset_interval": 0, "trim.interval": 4,
    "trim.after": 2, "normals.refresh": 5,
}  # fmt: skip


def configured(plugins, **values):
    values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
    return Trim3DGS(plugins, apply_overrides(Trim3DGSConfig(), values, source="test").completed(plugins, {}))


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(directory=None, stop_after=None, on_step=None, start=None, **values):
        method = configured(plugins, **values)
        outcome = train_stages(
            method.stages(), toy.scene, rasterizer, checkpoint_every=5,
            trained=lambda name: copy.deepcopy(start or toy.truth), directory=directory, stop_after=stop_after,
            on_step=on_step,
        )  # fmt: skip
        return method, outcome.model

    return run


@pytest.fixture(scope="module")
def whole(train):
    return train()


def encoded(method, model):
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    return writer.to_bytes()


def decoded(plugins, data):
    return Trim3DGS(plugins, None).decode(ContainerReader(data, "file.swz"))


def stage_of(plugins, preset="paper", **values):
    values = {key.replace("__", "."): value for key, value in values.items()}
    (stage,) = Trim3DGS(plugins, resolve(Trim3DGS, preset, sets=values, plugins=plugins).config).stages()
    return stage


def test_the_plan_is_the_published_one(plugins):
    stage = stage_of(plugins)
    pre, post = build_schedulers(stage, PipelineParams())
    assert format_plan(pre, post, total=stage.iterations) == PLAN
    assert (stage.iterations, stage.starts_from) == (7000, "flat-3dgs")
    calendar = firings(stage)
    assert calendar["trim"] == list(range(1500, 7000, 500))
    assert calendar["reset opacity"] == [3000, 6000]
    assert calendar["scale split"] == list(range(100, 7000, 100))


def test_the_presets_are_the_authors_scripts(plugins):
    dtu = firings(stage_of(plugins, "dtu"))
    assert dtu["draw normals"] == list(range(5001, 7001))
    assert dtu["prune and densify"] == dtu["scale split"] == list(range(100, 7000, 100))
    assert len(dtu["trim"]) == 11
    outdoor = firings(stage_of(plugins, "mipnerf360-outdoor"))
    assert outdoor["trim"] == outdoor["scale split"] == list(range(1000, 7000, 1000))
    assert "reset opacity" not in outdoor


def test_a_trim_comes_after_a_densification_and_before_a_reset(plugins):
    _, post = build_schedulers(stage_of(plugins, "dtu"), PipelineParams())
    assert [r.name for r in post.registrations if r.due(3000)] == [
        "collect gradient statistics", "prune and densify", "scale split", "trim", "reset opacity", "forget neighbours",
    ]  # fmt: skip


def test_a_trim_needs_a_densification_at_its_step(plugins):
    assert firings(stage_of(plugins, densify__interval=1000))["trim"] == list(range(2000, 7000, 1000))


def test_a_scaled_plan(plugins):
    calendar = firings(stage_of(plugins, "quick"))
    assert calendar["trim"] == list(range(150, 500, 50))
    assert calendar["draw normals"] == list(range(1, 701))


def test_it_ends_with_flat_gaussians_and_without_traces_of_training(whole):
    _, model = whole
    assert isinstance(model, FlatGaussians)
    assert bool((model.scales[:, 0] == 1e-8).all())
    assert model.neighbors.numel() == 0
    assert not model.draws_surface


def test_a_trim_removes_a_tenth(train):
    said = []
    train(
        densify__stop=6,
        trim__unseen=False,
        densify__factor=1e6,
        densify__size_px=1e6,
        densify__min_opacity=0.0,
        on_step=lambda _, record: said.extend(record.scalars.items()),
    )
    assert [float(value) for name, value in said if name.endswith("trimmed")] == [40]


@pytest.mark.parametrize(
    ("mode", "curves"),
    [
        ("ordinary", {"cloned", "split", "pruned", "trimmed"}),
        ("scale", {"scale_split", "pruned", "trimmed"}),
        ("mix", {"cloned", "split", "scale_split", "pruned", "trimmed"}),
    ],
)
def test_each_mode_densifies_in_its_way(train, mode, curves):
    seen = set()
    _, model = train(
        iterations=5,
        densify__mode=mode,
        on_step=lambda _, record: seen.update(n.rpartition(".")[2] for n in record.scalars),
    )
    assert seen == curves
    assert isinstance(model, FlatGaussians)


def test_both_terms_are_in_the_loss_from_their_step_on_and_fall(train):
    parts = []
    train(
        iterations=40, normals__after=3, normals__edge_threshold=0, normals__weight=5, densify__stop=0,
        on_step=lambda _, record: parts.append(record.parts),
    )  # fmt: skip
    assert [("normal" in each, "rough" in each) for each in parts[:5]] == [(False, False)] * 3 + [(True, True)] * 2
    for name in ("normal", "rough"):
        values = [float(each[name]) for each in parts[3:]]
        assert 0 < sum(values[-6:]) < sum(values[:6])


def test_without_weight_nothing_is_drawn_for_it(train, plugins):
    seen = []
    train(iterations=2, normals__weight=0, on_step=lambda _, record: seen.append(set(record.parts)))
    assert all("normal" not in each for each in seen)
    assert "draw normals" not in firings(stage_of(plugins, normals__weight=0))


def test_training_comes_nearer_to_the_photographs(train, toy):
    start = flattened(copy.deepcopy(toy.truth))
    start.sh_dc.data += 0.3
    losses = []
    train(
        iterations=60,
        densify__stop=0,
        start=start,
        normals__weight=0,
        on_step=lambda _, r: losses.append(float(r.total)),
    )
    assert sum(losses[-9:]) < 0.9 * sum(losses[:9])


@pytest.mark.parametrize("stop", [1, 7])
def test_stopped_and_resumed_equals_one_go(train, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=stop)
    assert train(directory=tmp_path)[1].digest() == whole[1].digest()


@pytest.mark.parametrize(("rate", "atol"), [("r6", 0), ("r5", 0.05)])
def test_a_fresh_decoder_draws_what_was_trained(plugins, whole, toy, rasterizer, rate, atol):
    _, model = whole
    camera = toy.scene.test[0].camera
    method = Trim3DGS(plugins, resolve(Trim3DGS, "paper", rate=rate, plugins=plugins).config)
    found = decoded(plugins, encoded(method, model))
    with torch.no_grad():
        ours, theirs = (
            rasterizer.render(m.gaussians(camera, rasterizer), camera, RasterOptions()).image for m in (model, found)
        )
    assert found.num_rows == model.num_rows
    # A lossy file orders the axes by their scales, so the thin one need not be the first.
    assert torch.allclose(ours, theirs, atol=max(atol, 1e-6))
    assert float(found.scales.detach().amin(dim=1).max()) < 2e-8


def test_a_file_says_that_its_surface_is_the_median_depth(plugins, whole):
    assert ContainerReader(encoded(*whole), "file.swz").static["depth_ratio"] == 1


def test_files_shrink_with_the_rate_point(plugins, whole):
    sizes = []
    for rate in ("r1", "r3", "r6"):
        method = Trim3DGS(plugins, resolve(Trim3DGS, "paper", rate=rate, plugins=plugins).config)
        sizes.append(len(encoded(method, whole[1])))
    assert sizes == sorted(set(sizes))


def test_a_damaged_file_and_a_newer_layout_are_refused(plugins, whole):
    data = bytearray(encoded(*whole))
    data[len(data) // 2] ^= 0x10
    with pytest.raises(BitstreamError):
        decoded(plugins, bytes(data))
    with pytest.raises(BitstreamError, match="trim-3dgs layout version 2"):
        decoded(plugins, ContainerWriter("trim-3dgs", 2).to_bytes())


def test_it_starts_from_flat_gaussians_or_makes_them_flat(plugins, toy):
    with pytest.raises(SceneError, match="trained flat-3dgs scene"):
        configured(plugins).create_model(toy.scene, torch.Generator())
    assert configured(plugins, start="3dgs").stages()[0].starts_from == "3dgs"


def test_flat_3dgs_is_the_3dgs_plan_from_flat_points(plugins, toy, rasterizer):
    sets = {"iterations": 6, "densify.start": 2, "densify.interval": 2, "densify.grad_threshold": 1e-9}
    method = Flat3DGS(plugins, resolve(Flat3DGS, "paper", sets=sets, plugins=plugins).config)
    points = PointCloud(toy.truth.means, torch.rand(400, 3, generator=torch.Generator().manual_seed(0)))
    scene = Scene("toy", toy.scene.train, toy.scene.test, points, Protocol("toy"))
    model = train_method(method, scene, rasterizer).model
    assert isinstance(model, FlatGaussians)
    assert model.num_rows > 400
    stored = model.log_scales[:, 0].detach()
    assert torch.equal(stored.exp(), torch.full_like(stored, 1e-8)) or torch.allclose(stored, torch.tensor(1e-8).log())
    with pytest.raises(SceneError, match="no start points"):
        method.create_model(toy.scene, torch.Generator())
