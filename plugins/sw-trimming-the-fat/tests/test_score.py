"""The rule: what goes is faint and still, both below their quantile."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_gaussians.start import logit

from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from sw_trimming_the_fat.score import OpacityAndGradient, doomed, mean_gradients, ranks, worth


def model_of(opacities, gradients, seen=None):
    """Gaussians with these opacities, and mean gradients over `seen` steps each."""
    n = len(opacities)
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    logits = torch.tensor([logit(float(o)) for o in opacities])
    model = GaussianModel(
        torch.zeros(n, 3), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), logits, torch.zeros(n, 3), quats
    )
    seen = torch.ones(n) if seen is None else torch.as_tensor(seen, dtype=torch.float32)
    model.denom.copy_(seen)
    model.grad_accum.copy_(torch.as_tensor(gradients, dtype=torch.float32) * seen)
    return model


def gone(opacities, gradients, level):
    return doomed(worth(torch.as_tensor(opacities), torch.as_tensor(gradients)), level)


def by_quantiles(opacities, gradients, level):
    """The published rule word by word, with numpy's linear quantiles."""
    masks = [values < np.quantile(values, level) for values in (np.asarray(opacities), np.asarray(gradients))]
    return masks[0] & masks[1]


NUMBERS = st.lists(st.integers(0, 40), min_size=1, max_size=60)
LEVELS = st.one_of(st.floats(0, 1), st.sampled_from([0.0, 0.225, 0.3, 0.425, 0.5, 0.6, 1.0]))


@settings(max_examples=100, deadline=None)
@given(values=NUMBERS, seed=st.integers(0, 2**31), level=LEVELS)
def test_a_level_cuts_what_is_below_both_quantiles(values, seed, level):
    opacities = np.array(values, np.float64)
    gradients = np.random.default_rng(seed).permutation(opacities)
    found = gone(opacities, gradients, level).numpy()
    h = level * (len(values) - 1)
    if h != round(h) and math.isclose(h, round(h), abs_tol=1e-9):
        return  # the quantile itself is a matter of rounding
    assert np.array_equal(found, by_quantiles(opacities, gradients, level))


@settings(max_examples=100, deadline=None)
@given(n=st.integers(1, 80), seed=st.integers(0, 2**31), level=st.floats(0.001, 0.999))
def test_without_ties_the_number_lies_between_the_bounds(n, seed, level):
    generator = np.random.default_rng(seed)
    number = int(gone(generator.permutation(n) / n, generator.permutation(n) / n, level).sum())
    single = math.ceil(round(level * (n - 1), 9))
    assert max(0, 2 * single - n) <= number <= single


def test_four_of_ten_where_both_agree_and_none_where_they_contradict():
    values = torch.arange(10) / 9
    assert gone(values, values, 0.425).tolist() == [True] * 4 + [False] * 6
    assert not gone(values, values.flip(0), 0.425).any()


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**31), low=st.floats(0, 1), high=st.floats(0, 1))
def test_a_higher_level_takes_more_and_what_a_lower_one_took(seed, low, high):
    generator = np.random.default_rng(seed)
    opacities, gradients = generator.random(50), generator.integers(0, 20, 50)
    low, high = sorted((low, high))
    few, many = gone(opacities, gradients, low), gone(opacities, gradients, high)
    assert not (few & ~many).any()


def test_level_0_takes_nothing_and_level_1_leaves_at_least_one():
    values = torch.arange(7.0)
    assert not gone(values, values, 0.0).any()
    assert int(gone(values, values, 1.0).sum()) == 6
    assert not gone(values[:1], values[:1], 1.0).any()


def test_equal_values_share_the_highest_rank_so_that_the_threshold_itself_stays():
    assert ranks(torch.tensor([5.0, 1.0, 5.0, 9.0])).tolist() == [2, 0, 2, 3]
    values = torch.tensor([0.1, 0.2, 0.2, 0.2, 0.9])
    assert gone(values, values, 0.5).tolist() == [True, False, False, False, False]


@pytest.mark.slow
def test_ranks_need_no_quantile_of_so_many_values_as_torch_refuses():
    n = (1 << 24) + 1
    values = torch.arange(n)  # torch.quantile: "input tensor is too large"
    with pytest.raises(RuntimeError):
        torch.quantile(values.float(), 0.5)
    assert torch.equal(ranks(values), values)


def test_a_gaussian_that_no_step_showed_has_gradient_0():
    model = model_of([0.5] * 4, [1.0, 2.0, 3.0, 4.0], seen=[1, 0, 3, 0])
    assert mean_gradients(model).tolist() == [1, 0, 3, 0]
    assert not OpacityAndGradient().score(model, [], None).isnan().any()


def test_the_mean_is_over_the_steps_that_showed_it():
    model = model_of([0.1, 0.2, 0.3], [4.0, 1.0, 2.0], seen=[10, 1, 5])
    assert model.grad_accum.tolist() == [40, 1, 10]
    assert OpacityAndGradient().score(model, [], None).tolist() == [1.0, 0.5, 1.0]


@pytest.mark.parametrize("gradients", [[0.0] * 5, [0.3] * 5])
def test_statistics_that_say_nothing_are_an_error(gradients):
    with pytest.raises(ValueError, match="gradient statistics, which must be collected"):
        OpacityAndGradient().score(model_of([0.1, 0.2, 0.3, 0.4, 0.5], gradients), [], None)


def test_the_score_is_registered_as_a_pruner_that_reads_statistics_and_changes_nothing():
    pruner = load_plugins().pruners.load("trimming-the-fat")()
    assert pruner.uses_statistics
    model = model_of([0.1, 0.9, 0.5], [3.0, 1.0, 2.0])
    before = model.digest()
    assert pruner.score(model, [], None).tolist() == [1.0, 1.0, 0.5]
    assert model.digest() == before


def test_anything_but_explicit_gaussians_is_refused():
    with pytest.raises(TypeError, match="GaussianModel"):
        OpacityAndGradient().score(torch.nn.Linear(1, 1), [], None)
