"""The stage on a scene of a few Gaussians: plan, what is pruned, what is trained, what the file gives back."""

import copy

import pytest
import torch
from sw_kit import short_training
from sw_kit.short_training import file_of as encoded

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, ConfigError, SceneError, TaskError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.runs.config import apply_overrides, resolve
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.scheduler import build_schedulers, format_plan
from sw_codecs.models.raht_gaussians import RahtGaussians
from sw_mesongs.config import MesonGSConfig
from sw_mesongs.importance import Importance
from sw_mesongs.method import MesonGS

PLAN = """\
Stage | Task                                 | Plan
------+--------------------------------------+------------
Pre   | calculate importance score and prune | 1
Pre   | create octree                        | 1
Pre   | update lr                            | range(3000)"""

SHORT = {
    "iterations": 12, "codec.settings.blocks": 3, "codec.settings.codebook_size": 24, "codec.settings.vq_steps": 20,
    "codec.settings.depth": 8, "lr.factor": 1.0,
}  # fmt: skip


def configured(plugins, **values):
    values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
    return MesonGS(plugins, apply_overrides(MesonGSConfig(), values, source="test").completed(plugins, {}))


def tuned(method, start, scene, rasterizer, **options):
    """The method's model after its steps on a trained scene, and the losses."""
    return short_training.train(
        method, scene, rasterizer, model=lambda: None, trained={"3dgs": start}.__getitem__, **options
    )


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(directory=None, stop_after=None, totals=None, **values):
        method = configured(plugins, **values)
        model, losses = tuned(
            method, toy.truth, toy.scene, rasterizer, checkpoint_every=5, directory=directory, stop_after=stop_after
        )
        if totals is not None:
            totals += [each["total"] for each in losses]
        return method, model

    return run


@pytest.fixture(scope="module")
def whole(train):
    return train()


def decoded(plugins, data):
    return MesonGS(plugins, None).decode(ContainerReader(data, "file.swz"))


def drawn(model, scene, rasterizer):
    from splatwizard_core.rendering.rasterizer import RasterOptions

    camera = scene.test[0].camera
    with torch.no_grad():
        return rasterizer.render(model.gaussians(camera, rasterizer), camera, RasterOptions()).image


def test_the_plan_is_the_published_one(plugins):
    (stage,) = MesonGS(plugins, MesonGSConfig()).stages()
    pre, post = build_schedulers(stage, PipelineParams())
    assert format_plan(pre, post, total=stage.iterations) == PLAN
    assert (stage.iterations, stage.starts_from, stage.taught_by) == (3000, "3dgs", ())


def test_step_sizes(plugins, toy):
    (stage,) = MesonGS(plugins, MesonGSConfig()).stages()
    assert stage.rates(1, toy.scene) == stage.rates(3000, toy.scene)
    expected = {"sh_dc": 2.5e-3, "codebook": 1.25e-4, "opacity_logits": 0.05, "quats": 1e-3}
    expected["log_scales"] = 1e-3 * toy.scene.extent
    assert stage.rates(7, toy.scene) == pytest.approx({name: 0.16 * rate for name, rate in expected.items()})
    config = resolve(MesonGS, "quick").config
    (stage,) = MesonGS(plugins, config).stages()
    assert stage.rates(600, toy.scene)["quats"] == pytest.approx(1e-4)
    assert stage.rates(300, toy.scene)["quats"] == pytest.approx(1e-3 * 0.1**0.5)


def test_what_contributes_least_goes_at_the_first_step(train, toy, rasterizer):
    _, model = train(iterations=1, prune__tau=0.5, codec__settings__depth=21)
    scores = Importance().score(toy.truth, [view.camera for view in toy.scene.train], rasterizer)
    left = scores > scores.sort().values[int(0.5 * 399)]
    assert model.num_rows == int(left.sum()) == 200
    ours, theirs = model.means[:, 0].sort().values, toy.truth.means[left, 0].sort().values
    assert torch.allclose(ours, theirs, atol=1e-5)  # cells of 2^-21 of the box
    assert float(model.importance.sum()) == pytest.approx(float(scores[left].sum()), rel=1e-5)
    assert toy.truth.num_rows == 400


def test_each_voxel_holds_one_and_positions_stay_there(whole):
    _, model = whole
    assert isinstance(model, RahtGaussians)
    assert len(torch.unique(model.cells, dim=0)) == model.num_rows
    assert torch.equal(torch.from_numpy(model.grid.points(model.cells.numpy())), model.means.detach())
    assert model.codebook.shape == (24, 15, 3)


def test_training_comes_nearer_to_the_photographs(train):
    losses = []
    train(iterations=60, prune__tau=0.0, totals=losses)
    assert sum(losses[-9:]) < 0.8 * sum(losses[:9])


def test_all_but_the_positions_are_trained(train):
    _, before = train(iterations=1)
    _, after = train(iterations=9)
    for name in ("sh_dc", "codebook", "opacity_logits", "log_scales", "quats"):
        assert not torch.equal(getattr(after, name), getattr(before, name)), name
    for name in ("means", "cells", "code", "importance"):
        assert torch.equal(getattr(after, name), getattr(before, name)), name


@pytest.mark.parametrize("values", [{}, {"codec__settings__recalibrate": True}, {"iterations": 0}])
def test_a_fresh_decoder_draws_what_training_drew(train, plugins, toy, rasterizer, values):
    method, model = train(**values)
    model = copy.deepcopy(model).eval()
    found = decoded(plugins, encoded(method, model))
    assert found.num_rows == model.num_rows
    assert torch.allclose(drawn(found, toy.scene, rasterizer), drawn(model, toy.scene, rasterizer), atol=1e-5)


def test_no_steps_prune_and_settle_all_the_same(train, toy):
    _, without = train(iterations=0)
    _, one = train(iterations=1)
    assert without.digest() == one.digest()  # the last step makes no update
    assert without.num_rows < toy.truth.num_rows


@pytest.mark.parametrize("stop", [1, 7])
def test_stopped_and_resumed_equals_one_go(train, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=stop)
    assert train(directory=tmp_path)[1].digest() == whole[1].digest()


def test_equal_models_make_equal_files_and_stay_as_they_are(whole):
    method, model = whole
    before = model.digest()
    assert encoded(method, model) == encoded(method, model)
    assert model.digest() == before


def test_the_file_shrinks_with_tau(train):
    sizes = [len(encoded(*train(iterations=0, prune__tau=tau))) for tau in (0.0, 0.2, 0.4, 0.6)]
    assert sizes == sorted(sizes, reverse=True)
    assert len(set(sizes)) == 4


def test_another_pruner_decides_and_the_own_score_weighs_the_colours(train, toy, rasterizer):
    _, model = train(iterations=0, prune__pruner="opacity", prune__tau=0.5, codec__settings__depth=21)
    threshold = toy.truth.opacity_logits.sort().values[int(0.5 * 399)]
    assert float(model.opacity_logits.detach().min()) > float(threshold)
    scores = Importance().score(toy.truth, [view.camera for view in toy.scene.train], rasterizer)
    left = toy.truth.opacity_logits > threshold
    assert float(model.importance.sum()) == pytest.approx(float(scores[left].sum()), rel=1e-5)


def test_beta_is_the_scenes_unless_it_is_given(train, plugins, toy, rasterizer):
    cameras = [view.camera for view in toy.scene.train]
    for sets, beta in (({}, 0.1), ({"prune__settings__beta": 0.7}, 0.7)):
        _, model = train(iterations=0, prune__tau=0.0, codec__settings__depth=21, **sets)
        scores = Importance(beta=beta).score(toy.truth, cameras, rasterizer)
        assert float(model.importance.sum()) == pytest.approx(float(scores.sum()), rel=1e-5)


def test_a_pruner_that_reads_statistics_is_refused(plugins):
    with pytest.raises(ConfigError, match="before its first step"):
        configured(plugins, prune__pruner="trimming-the-fat").stages()


def test_gaussians_that_are_not_finite_are_left_out(plugins, toy, rasterizer):
    broken = copy.deepcopy(toy.truth)
    broken.means[3], broken.log_scales[5, 1], broken.opacity_logits[7] = torch.nan, torch.inf, torch.inf
    method = configured(plugins, iterations=0, prune__tau=0.0, codec__settings__depth=21)
    model, _ = tuned(method, broken, toy.scene, rasterizer)
    assert 390 < model.num_rows <= 397  # the lowest goes too
    assert float(model.opacity_logits.detach().max()) == 20
    assert decoded(plugins, encoded(method, model)).num_rows == model.num_rows


def test_of_one_gaussian_the_file_holds_it(plugins, toy, rasterizer):
    """The published rule takes the lowest at any share: of one there would be nothing left."""
    opaque = int(toy.truth.opacity_logits.argmax())
    alone = GaussianModel(*[getattr(toy.truth, name).detach()[[opaque]] for name in GaussianModel.RAW])
    alone = alone.requires_grad_(False)
    method = configured(plugins, iterations=2, prune__tau=0.5)
    model, _ = tuned(method, alone, toy.scene, rasterizer)
    assert model.num_rows == decoded(plugins, encoded(method, model)).num_rows == 1


def test_of_equal_scores_all_stay(train, toy, monkeypatch):
    monkeypatch.setattr(Importance, "score", lambda self, model, *_: torch.ones(model.num_rows))
    assert train(iterations=1, codec__settings__depth=21)[1].num_rows == toy.truth.num_rows


def test_a_scene_that_no_view_shows_is_an_error(train, monkeypatch):
    monkeypatch.setattr(Importance, "score", lambda self, model, *_: torch.zeros(model.num_rows))
    with pytest.raises(TaskError, match="no training view of 'toy' shows a Gaussian"):
        train(iterations=1)


def test_it_starts_from_a_trained_scene(plugins, toy):
    with pytest.raises(SceneError, match="trained 3dgs scene"):
        configured(plugins).create_model(toy.scene, torch.Generator())


def test_what_is_not_settled_is_not_encoded(plugins, toy):
    with pytest.raises(TypeError, match="settled"):
        encoded(configured(plugins), toy.truth)


def test_a_newer_layout_and_another_codec_are_refused(plugins, whole):
    with pytest.raises(BitstreamError, match="mesongs layout version 2"):
        decoded(plugins, ContainerWriter("mesongs", 2).to_bytes())
    method, model = whole
    writer = ContainerWriter("mesongs", 1)
    method.encode(model, writer)
    writer.static["codec"] = "gaussians-exact"
    with pytest.raises(BitstreamError, match="codec"):
        decoded(plugins, writer.to_bytes())


@pytest.mark.cuda
def test_what_a_gpu_trains_decodes_on_the_cpu_to_what_was_drawn(plugins, toy):
    from splatwizard_core.rendering.negotiation import NegotiatedRasterizer

    gpu, cpu = (NegotiatedRasterizer(plugins, device=device) for device in ("cuda", "cpu"))
    method = configured(plugins)
    trained = copy.deepcopy(toy.truth).cuda()
    model, _ = tuned(method, trained, toy.scene, gpu)
    assert model.device.type == "cuda"
    found = decoded(plugins, encoded(method, model))
    ours = drawn(copy.deepcopy(model).cpu().eval(), toy.scene, cpu)
    assert torch.allclose(drawn(found, toy.scene, cpu), ours, atol=1e-4)
