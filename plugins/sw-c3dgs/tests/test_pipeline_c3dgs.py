"""The method on a scene of a few Gaussians: what is dropped and shared, what is trained, what the file gives back."""

import copy

import pytest
import torch
from sw_kit import short_training
from sw_kit.short_training import file_of as encoded
from sw_reference.projection import covariances

from splatwizard_core.api import ContainerReader, GaussianModel
from splatwizard_core.errors import EmptyModel, SceneError
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.training.pipeline import TrainingStopped
from sw_c3dgs.config import C3DGSConfig
from sw_c3dgs.indexed import IndexedGaussians
from sw_c3dgs.method import C3DGS
from sw_c3dgs.model import SharedGaussians

SHORT = {
    "iterations": 12, "color.size": 16, "shape.size": 16, "color.iterations": 10, "shape.iterations": 10,
    "color.threshold": 2e-3, "shape.threshold": 1e-2, "color.batch": 256, "shape.batch": 256,
}  # fmt: skip


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(start=None, directory=None, stop_after=None, totals=None, **values):
        values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
        method = C3DGS(plugins, apply_overrides(C3DGSConfig(), values, source="test"))
        model, losses = short_training.train(
            method, toy.scene, rasterizer, model=lambda: pytest.fail("it starts from a trained scene"),
            trained={"3dgs": toy.truth if start is None else start}.__getitem__, checkpoint_every=5,
            directory=directory, stop_after=stop_after,
        )  # fmt: skip
        if totals is not None:
            totals += [each["total"] for each in losses]
        return method, model

    return run


@pytest.fixture(scope="module")
def whole(train):
    return train()


def gathered(model):
    return IndexedGaussians(model.coded())


def rows(model):
    """The Gaussians as sorted rows of numbers: files have them in another order."""
    names = ("means", "sh_dc", "sh_rest", "opacities", "log_scales", "quats")
    with torch.no_grad():
        return torch.unique(torch.cat([getattr(model, name).reshape(model.num_rows, -1) for name in names], 1), dim=0)


def test_some_are_shared_and_some_keep_their_own(whole):
    _, model = whole
    assert isinstance(model, SharedGaussians)
    assert model.is_shared
    counts = model.counts()
    assert counts["num_gaussians"] <= 400
    for name, index in (("num_colors", model.color_index), ("num_shapes", model.shape_index)):
        users = torch.bincount(index, minlength=counts[name])
        assert int(users.min()) >= 1
        assert (users > 1).sum() >= 2  # shared
        assert (users == 1).sum() > 16  # more than the shared entries: kept
        assert 16 < counts[name] < 350


def test_thresholds_of_zero_keep_everything_that_is_seen_as_it_is(train, toy):
    _, model = train(iterations=0, factors__thresholds=0.0)
    seen = [int((toy.truth.sh_rest == row).all(-1).all(-1).nonzero()) for row in model.sh_rest[model.color_index]]
    assert len(seen) == model.num_rows > 300
    truth = {
        name: getattr(toy.truth, name)[seen] for name in ("means", "sh_dc", "opacity_logits", "log_scales", "quats")
    }
    assert torch.equal(model.means, truth["means"])
    assert torch.equal(model.sh_dc[model.color_index], truth["sh_dc"])
    assert torch.equal(model.opacity_logits, truth["opacity_logits"])
    scales = model.log_factors.exp()[:, None] * model.shapes[model.shape_index]
    found = covariances(scales, model.quats[model.shape_index])
    assert torch.allclose(found, covariances(truth["log_scales"].exp(), truth["quats"]), rtol=1e-4, atol=1e-7)


def test_without_a_limit_nobody_keeps_an_own_entry(train):
    _, model = train(iterations=0, factors__thresholds=1e9)
    assert model.counts()["num_colors"] <= 16
    assert model.counts()["num_shapes"] <= 16
    norms = model.shapes.norm(dim=1)
    assert torch.allclose(norms, torch.ones_like(norms), atol=1e-5)


def test_factors_move_every_threshold_and_size(train):
    _, model = train(iterations=0, factors__thresholds=1e9, factors__sizes=0.25)
    assert model.counts()["num_colors"] <= 4


def test_what_no_view_shows_goes_unless_pruning_is_off(train, toy):
    start = copy.deepcopy(toy.truth)
    start.means[:3] += 900.0
    start.sh_dc[5] = float("nan")
    _, model = train(iterations=0, start=start)
    assert float(model.means.detach().abs().max()) < 100
    _, kept = train(iterations=0, start=start, prune_threshold=-1.0)
    assert kept.num_rows == 399  # but the one that is not a number
    assert model.num_rows <= 396


def test_a_scene_that_no_view_shows_is_told(train, toy):
    start = copy.deepcopy(toy.truth)
    start.means += 900.0
    for iterations in (0, 3):
        with pytest.raises(EmptyModel):
            train(iterations=iterations, start=start)


def test_everything_is_trained_but_the_indices(train, whole):
    """The codebooks are made at the first step, whose update is the first one."""
    _, before = train(iterations=0)
    _, after = whole
    assert torch.equal(before.color_index, after.color_index)
    for name in ("means", "sh_dc", "sh_rest", "opacity_logits", "log_factors", "shapes", "quats"):
        assert not torch.equal(getattr(before, name), getattr(after, name)), name


def test_fine_tuning_comes_nearer_to_the_photographs(train):
    losses = []
    train(iterations=60, totals=losses)
    assert sum(losses[-9:]) < 0.8 * sum(losses[:9])


@pytest.mark.parametrize("stop", [1, 7])
def test_stopped_and_resumed_equals_one_go(train, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=stop)
    assert train(directory=tmp_path)[1].digest() == whole[1].digest()


def test_resuming_does_not_depend_on_the_layout_of_the_scene_that_it_starts_from(train, toy, tmp_path):
    """Of which all Gaussians stay, so that a resumed model keeps the tensors that it began with."""
    _, seen = train(iterations=0, factors__thresholds=0.0)
    start = GaussianModel(
        *(getattr(gathered(seen), name).detach() for name in GaussianModel.ROWS[:6]), active_sh_degree=3
    )
    start.means.data = start.means.data.T.contiguous().T
    with pytest.raises(TrainingStopped):
        train(start=start, directory=tmp_path, stop_after=6)
    resumed = train(start=start, directory=tmp_path)[1]
    assert resumed.num_rows == start.num_rows
    assert all(each.is_contiguous() for each in resumed.parameters())
    assert resumed.digest() == train(start=start)[1].digest()


@pytest.mark.parametrize("iterations", [0, 1, 3])
def test_a_run_of_hardly_any_steps_makes_codebooks_and_a_file(train, plugins, iterations, tmp_path):
    method, model = train(iterations=iterations, directory=tmp_path)
    assert model.is_shared
    again = train(iterations=iterations, directory=tmp_path)[1]  # only loaded
    assert again.digest() == model.digest()
    found = C3DGS(plugins, None).decode(ContainerReader(encoded(method, model), "file.swz"))
    assert found.num_rows == model.num_rows


def test_the_file_holds_what_was_drawn_in_training(whole, plugins):
    method, model = whole
    data = encoded(method, model)
    assert encoded(method, model) == data
    found = C3DGS(plugins, None).decode(ContainerReader(data, "file.swz"))
    expected = gathered(model)
    assert found.counts() == model.counts()
    assert torch.equal(rows(found), rows(expected))
    assert encoded(method, found) == data


@pytest.mark.parametrize("codec", ["gaussians-exact", "gaussians-zstd", "gaussians-ply"])
def test_any_codec_of_gaussians_may_hold_it(whole, plugins, codec):
    _, model = whole
    method = C3DGS(plugins, apply_overrides(C3DGSConfig(), {"codec.name": codec}, source="test"))
    found = C3DGS(plugins, None).decode(ContainerReader(encoded(method, model), "file.swz"))
    assert isinstance(found, GaussianModel)
    assert torch.allclose(rows(found), rows(gathered(model)), atol=1e-6)  # opacities of which the file has logits


def test_scenes_that_are_no_gaussians_are_refused(train, whole):
    with pytest.raises(SceneError, match="explicit Gaussians"):
        train(start=whole[1])
