"""Both stages on a scene of a few Gaussians: what is pruned, what is trained, what the file gives back."""

import copy
from types import SimpleNamespace

import pytest
import torch
from sw_gaussians.finetune.pruning import scores_of
from sw_kit.short_training import train_stages

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingStopped
from splatwizard_core.training.stage import CameraIterator
from sw_lightgaussian.config import LightGaussianConfig
from sw_lightgaussian.method import LightGaussian
from sw_lightgaussian.stages import DistillStage, ScoredGaussians
from sw_lightgaussian.vectree import CodedGaussians

SHORT = {
    "iterations": 12, "prune.iterations": 12, "distill.lr.sh_rest": 1e-2,
    "codec.settings.iterations": 20, "codec.settings.batch": 200,
}  # fmt: skip


@pytest.fixture(scope="module")
def train(plugins, rasterizer, toy):
    def run(only=None, start=None, teacher=None, directory=None, stop_after=None, on_step=None, **values):
        values = {**SHORT, **{key.replace("__", "."): value for key, value in values.items()}}
        method = LightGaussian(plugins, apply_overrides(LightGaussianConfig(), values, source="test"))
        stages = list(method.stages())
        outcome = train_stages(
            stages if only is None else stages[only : only + 1], toy.scene, rasterizer,
            model=lambda: copy.deepcopy(start).requires_grad_(True), trained={"3dgs": teacher or toy.truth}.__getitem__,
            checkpoint_every=5, directory=directory, stop_after=stop_after, on_step=on_step,
        )  # fmt: skip
        return method, outcome.model

    return run


@pytest.fixture(scope="module")
def whole(train):
    return train()


def test_a_third_is_left_and_knows_its_importance(whole, toy, plugins, rasterizer):
    _, model = whole
    assert isinstance(model, ScoredGaussians)
    assert model.num_rows == 400 - 264  # floor(0.66 * 400)
    assert (model.max_sh_degree, model.active_sh_degree, model.sh_rest.shape[1]) == (2, 2, 8)
    # The score is that of the very parameters that are encoded.
    significance = plugins.pruners.load("lightgaussian")()
    again = scores_of(significance, model, CameraIterator(toy.scene.train), rasterizer, toy.scene).clamp_min(0)
    assert model.importance.tolist() == pytest.approx(again.tolist(), rel=1e-6)
    assert float(model.importance.max()) > 0


def test_the_least_significant_go_at_the_first_step_and_nothing_is_updated_in_it(train, toy, plugins, rasterizer):
    significance = plugins.pruners.load("lightgaussian")()
    scores = scores_of(significance, toy.truth, CameraIterator(toy.scene.train), rasterizer, toy.scene)
    best = set(scores.argsort(stable=True)[264:].tolist())
    _, model = train(only=0, prune__iterations=1)
    index = {tuple(row.tolist()): i for i, row in enumerate(toy.truth.means)}
    assert {index[tuple(row.tolist())] for row in model.means} == best
    rows = [index[tuple(row.tolist())] for row in model.means]
    assert torch.equal(model.sh_rest, toy.truth.sh_rest[rows])
    assert toy.truth.num_rows == 400  # the teacher is as it was


def test_the_count_of_the_authors_code_takes_one_more(train):
    _, model = train(only=0, prune__iterations=1, prune__count_rule="official")
    assert model.num_rows == 400 - (int(0.66 * 399) + 1)


def test_another_pruner_decides_if_asked(train, toy):
    _, model = train(only=0, prune__iterations=1, prune__pruner="opacity")
    assert float(model.opacity_logits.detach().min()) >= float(toy.truth.opacity_logits.sort().values[264])


def test_every_pruner_of_ours_may_decide(train, plugins):
    names = [entry.name for entry in plugins.pruners if is_ours(entry.distribution)]
    assert {"lightgaussian", "opacity"} <= set(names)
    for name in names:
        _, model = train(only=0, prune__iterations=4, prune__steps=[3], prune__pruner=name, prune__percent=0.25)
        assert model.num_rows == 300, name


def test_distilling_trains_all_but_the_opacities(train, toy):
    _, pruned = train(only=0)
    _, student = train(only=1, start=pruned)
    assert torch.equal(student.opacity_logits, pruned.opacity_logits)
    assert not torch.equal(student.sh_rest, pruned.sh_rest[:, :8])
    for name in ("means", "sh_dc", "log_scales", "quats"):
        assert not torch.equal(getattr(student, name), getattr(pruned, name)), name


def test_the_optimizer_holds_every_parameter_and_the_bands_that_are_left(plugins, toy, rasterizer):
    stage = LightGaussian(plugins, LightGaussianConfig()).stages()[1]
    assert isinstance(stage, DistillStage)
    context = SimpleNamespace(
        model=copy.deepcopy(toy.truth), scene=toy.scene, ppl=PipelineParams(), rasterizer=rasterizer,
        trained=lambda name: toy.truth,
    )  # fmt: skip
    model = stage.begin(context)
    optimizer = stage.create_optimizer(model, toy.scene)
    assert set(optimizer.groups) == {name for name, _ in model.named_parameters()}
    assert len(optimizer.groups) == 6
    assert model.sh_rest.shape == (400, 8, 3)
    assert stage.teacher.sh_rest.shape == (400, 15, 3)


def test_without_degree_3_there_is_nothing_to_lose_by_dropping_it(train, toy):
    flat = copy.deepcopy(toy.truth)
    flat.sh_rest[:, 8:] = 0
    losses = {}
    for name, model in (("flat", flat), ("full", toy.truth)):
        train(only=1, start=model, teacher=model, iterations=1,
              on_step=lambda _, record, name=name: losses.setdefault(name, float(record.total)))  # fmt: skip
    assert losses["flat"] == pytest.approx(0, abs=1e-6)
    assert losses["full"] > 1e-3


def test_distilling_comes_nearer_to_the_teacher(train, toy):
    losses = []
    train(only=1, start=toy.truth, iterations=60, distill__lr__sh_rest=0.02, distill__lr__sh_dc=0.01,
          on_step=lambda _, record: losses.append(float(record.total)))  # fmt: skip
    assert sum(losses[-10:]) < 0.8 * sum(losses[:10])


@pytest.mark.parametrize("stop", [7, 12, 18])
def test_stopped_and_resumed_equals_one_go(train, whole, tmp_path, stop):
    with pytest.raises(TrainingStopped):
        train(directory=tmp_path, stop_after=stop)
    assert train(directory=tmp_path)[1].digest() == whole[1].digest()


@pytest.mark.parametrize("iterations", [1, 3])
def test_a_run_of_hardly_any_steps(train, iterations):
    _, model = train(iterations=iterations, scale_schedule=True, prune__iterations=5000)
    assert model.num_rows == 136
    assert float(model.importance.max()) > 0


def encoded(method, model):
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    return writer.to_bytes()


def test_the_file_holds_the_model(whole, plugins):
    method, model = whole
    data = encoded(method, model)
    decoded = LightGaussian(plugins, None).decode(ContainerReader(data, "file.swz"))
    assert isinstance(decoded, CodedGaussians)
    assert (decoded.num_rows, decoded.max_sh_degree) == (136, 2)
    kept = decoded.code < 0
    assert int(kept.sum()) == int(0.4 * 136)
    assert len(data) < 136 * 236 / 2
    assert encoded(method, model) == data


def test_any_codec_of_gaussians_may_hold_it(whole, plugins):
    _, model = whole
    config = apply_overrides(LightGaussianConfig(), {"codec.name": "gaussians-exact"}, source="test")
    data = encoded(LightGaussian(plugins, config), model)
    decoded = LightGaussian(plugins, None).decode(ContainerReader(data, "file.swz"))
    for name in GaussianModel.ROWS[:6]:
        assert torch.equal(getattr(decoded, name), getattr(model, name))


def test_a_newer_layout_is_refused(plugins):
    data = ContainerWriter("lightgaussian", 2).to_bytes()
    with pytest.raises(BitstreamError, match="lightgaussian layout version 2 is unknown, this installation reads"):
        LightGaussian(plugins, None).decode(ContainerReader(data, "file.swz"))
