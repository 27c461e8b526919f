"""How many go and which; that any pruner serves, and what cannot be scores is refused."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from sw_gaussians.finetune.pruning import PruneByScore, PruneToCount, lowest, removal_count, scores_of, up_to

from splatwizard_core.errors import EmptyModel, ShapeError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_core.training.stage import CameraIterator
from splatwizard_core.training.task_log import TaskLog


def model(n=10):
    g = torch.Generator().manual_seed(0)
    return GaussianModel(
        torch.rand(n, 3, generator=g), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.linspace(-3, 3, n),
        torch.full((n, 3), -3.0), torch.rand(n, 4, generator=g),
    )  # fmt: skip


class Fixed:
    uses_statistics = False

    def __init__(self, scores):
        self.scores, self.seen = scores, None

    def score(self, model, cameras, rasterizer, background=None):
        self.seen = (list(cameras), background)
        return self.scores


@pytest.fixture
def scene(toy):
    return toy.scene


@pytest.mark.parametrize(
    ("n", "fraction", "count"),
    [(1000, 0.66, 660), (10, 0.3, 3), (1000, 0.8, 800), (7, 0.0, 0), (7, 1.0, 7), (0, 0.5, 0)],
)
def test_the_count_is_the_floor_of_what_was_meant(n, fraction, count):
    assert removal_count(n, fraction) == count


@given(st.integers(0, 10_000), st.integers(0, 100))
def test_percentages_remove_their_whole_part(n, percent):
    assert removal_count(n, percent / 100) == n * percent // 100


@given(st.lists(st.sampled_from([0.0, 1.0, 2.0, float("-inf"), float("inf")]), max_size=30), st.integers(0, 30))
def test_the_lowest_go_and_of_equals_the_first(values, count):
    count = min(count, len(values))
    doomed = lowest(torch.tensor(values), count)
    expected = sorted(range(len(values)), key=lambda i: (values[i], i))[:count]
    assert sorted(doomed.nonzero().flatten().tolist()) == sorted(expected)


def test_a_nan_is_no_score():
    with pytest.raises(ValueError, match="not a number"):
        lowest(torch.tensor([1.0, float("nan")]), 1)


def test_a_pruner_that_compares_with_photographs_gets_the_views(scene):
    class Comparing(Fixed):
        score_views = Fixed.score

        def score(self, *args):
            raise AssertionError("there are photographs")

    pruner = Comparing(torch.arange(10.0))
    scores_of(pruner, model(), CameraIterator(scene.train), None, scene)
    assert pruner.seen[0] == scene.train


def test_rounds_remove_equal_shares_until_the_count_is_left(scene):
    n, counts = 10_000, []
    task = PruneToCount(Fixed(None), [5, 9, 20], 1_250)
    for step in (5, 9, 20):
        n -= int(task.doomed(torch.arange(float(n)), step).sum())
        counts.append(n)
    assert counts == [5_000, 2_500, 1_250]
    assert not task.doomed(torch.arange(1_250.0), 20).any()
    assert not task.doomed(torch.arange(7.0), 9).any()  # fewer than are asked for
    only = PruneToCount(Fixed(torch.arange(10.0)), [3], 4)
    gaussians = model()
    optimizer = SplatOptimizer(gaussians, [ParamGroup("means", 1e-3)])
    only(gaussians, optimizer, CameraIterator(scene.train), None, scene, 3, TaskLog())
    assert gaussians.num_rows == 4


def test_the_task_removes_rows_and_moments_and_sees_every_camera_once(scene):
    gaussians = model()
    optimizer = SplatOptimizer(gaussians, [ParamGroup("means", 1e-3)])
    gaussians.means.sum().backward()
    optimizer.step()
    pruner = Fixed(torch.arange(10.0))
    before = gaussians.means.detach().clone()
    log = TaskLog()
    PruneByScore(pruner, {1: 0.8, 5: 0.5})(gaussians, optimizer, CameraIterator(scene.train), None, scene, 5, log)
    assert torch.equal(gaussians.means, before[5:])
    assert [line for _, line in log.said] == ["removed 5 of 10 primitives, 5 left"]
    assert log.scalars["pruned"].item() == 5
    assert optimizer.moments("means")[0].shape == (5, 3)
    assert gaussians.means.grad is None
    cameras, background = pruner.seen
    assert cameras == [view.camera for view in scene.train]
    assert torch.equal(background, scene.background)


def test_survivors_may_keep_their_gradient(scene):
    gaussians = model()
    optimizer = SplatOptimizer(gaussians, [ParamGroup("means", 1e-3)])
    (gaussians.means * torch.arange(10.0)[:, None]).sum().backward()
    task = PruneByScore(Fixed(torch.arange(10.0)), 0.3, carry_grad=True)
    task(gaussians, optimizer, CameraIterator(scene.train), None, scene, 1, TaskLog())
    assert gaussians.means.grad[:, 0].tolist() == [3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]


def test_the_count_of_the_authors_codes_takes_one_more_or_all_equal_ones(scene):
    scores = torch.tensor([5.0, 1.0, 3.0, 2.0, 4.0, 0.0])
    assert up_to(scores, 0.5).tolist() == [False, True, False, True, False, True]  # index int(0.5 * 5) = 2
    unseen = torch.tensor([-torch.inf, 7.0, -torch.inf, -torch.inf, 8.0])
    assert up_to(unseen, 0.1).tolist() == [True, False, True, True, False]
    assert up_to(scores[:0], 0.5).shape == (0,)
    gaussians = model()
    optimizer = SplatOptimizer(gaussians, [ParamGroup("means", 1e-3)])
    task = PruneByScore(Fixed(torch.arange(10.0)), {3: 0.3}, count_rule="official")
    task(gaussians, optimizer, CameraIterator(scene.train), None, scene, 3, TaskLog())
    assert gaussians.num_rows == 10 - (int(0.3 * 9) + 1)
    with pytest.raises(EmptyModel, match="step 3"):
        PruneByScore(Fixed(torch.zeros(7)), 0.1, count_rule="official")(
            gaussians, optimizer, CameraIterator(scene.train), None, scene, 3, TaskLog()
        )


def test_an_empty_model_is_an_error_and_nothing_is_removed(scene):
    gaussians = model()
    optimizer = SplatOptimizer(gaussians, [ParamGroup("means", 1e-3)])
    with pytest.raises(EmptyModel, match="step 7"):
        PruneByScore(Fixed(torch.zeros(10)), 1.0)(
            gaussians, optimizer, CameraIterator(scene.train), None, scene, 7, TaskLog()
        )
    assert gaussians.num_rows == 10


@pytest.mark.parametrize(
    ("scores", "error"), [(torch.zeros(9), ShapeError), (torch.full((10,), float("nan")), ValueError)]
)
def test_what_cannot_be_scores_names_the_pruner(scene, scores, error):
    with pytest.raises(error, match="Fixed"):
        scores_of(Fixed(scores), model(), CameraIterator(scene.train), None, scene)
