"""Adam against torch.optim.Adam, on the compiled and on the torch path."""

import math
from types import SimpleNamespace

import pytest
import torch

from splatwizard_native.fused import adam
from splatwizard_native.fused.native import TRAINING


def adam_step(*tensors: torch.Tensor, **options) -> None:
    adam.adam_steps([adam.AdamUpdate(*tensors, **options)])


OPTIONS = {"beta1": 0.9, "beta2": 0.999, "eps": 1e-15}


@pytest.fixture(params=["kernels", "torch"])
def path(request, monkeypatch) -> str:
    if request.param == "torch":
        monkeypatch.setattr(adam, "TRAINING", SimpleNamespace(try_load=lambda: False))
    elif not TRAINING.try_load():
        pytest.skip(f"no compiled kernels: {TRAINING.available()}")
    return request.param


def state(*shape: int, dtype=torch.float32, seed: int = 0) -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    param = torch.randn(*shape, generator=generator, dtype=dtype)
    return [param, torch.zeros_like(param), torch.zeros_like(param)]


@pytest.mark.parametrize("shape", [(1,), (1, 1), (17, 33), (511,), (513,), (700, 15, 3)])
def test_fifty_steps_equal_torchs(path, shape):
    generator = torch.Generator().manual_seed(1)
    param, exp_avg, exp_avg_sq = state(*shape)
    theirs = torch.nn.Parameter(param.clone())
    optimizer = torch.optim.Adam([theirs], lr=0.01, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 51):
        lr = 0.01 * 0.97**step
        optimizer.param_groups[0]["lr"] = lr
        # Gradients over six decades, and some exactly zero.
        grad = torch.randn(*shape, generator=generator) * 10 ** (6 * torch.rand(*shape, generator=generator) - 6)
        grad[torch.rand(*shape, generator=generator) < 0.2] = 0
        theirs.grad = grad.clone()
        optimizer.step()
        adam_step(param, grad, exp_avg, exp_avg_sq, lr=lr, step=step, **OPTIONS)
    torch.testing.assert_close(param, theirs.detach(), rtol=1e-6, atol=1e-6)
    theirs_state = optimizer.state[theirs]
    torch.testing.assert_close(exp_avg, theirs_state["exp_avg"], rtol=1e-5, atol=1e-7)
    torch.testing.assert_close(exp_avg_sq, theirs_state["exp_avg_sq"], rtol=1e-5, atol=1e-12)


def test_the_first_step_is_the_learning_rate(path):
    param, exp_avg, exp_avg_sq = state(100)
    before = param.clone()
    grad = torch.linspace(-1, 1, 100)
    adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.5, step=1, **OPTIONS)
    torch.testing.assert_close(param, before - 0.5 * grad.sign(), rtol=0, atol=2e-6)


def test_rows_that_never_had_a_gradient_do_not_move_and_later_do(path):
    # As the spherical-harmonics bands that are switched on after a thousand steps; the block of 512 is skipped.
    param, exp_avg, exp_avg_sq = state(3000)
    theirs = torch.nn.Parameter(param.clone())
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    before = param.clone()
    for step in range(1, 5):
        grad = torch.zeros(3000)
        grad[:100] = 1.0
        if step > 2:
            grad[1500:] = -1.0
        theirs.grad = grad.clone()
        optimizer.step()
        adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.01, step=step, **OPTIONS)
        assert torch.equal(param[600:1400], before[600:1400])
    torch.testing.assert_close(param, theirs.detach(), rtol=1e-6, atol=1e-6)
    assert (param[1500:] > before[1500:]).all()


def test_a_zero_gradient_still_moves_what_has_momentum(path):
    param, exp_avg, exp_avg_sq = state(600)
    adam_step(param, torch.ones(600), exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    before = param.clone()
    adam_step(param, torch.zeros(600), exp_avg, exp_avg_sq, lr=0.01, step=2, **OPTIONS)
    assert (param < before).all()


def test_a_nan_gradient_is_not_hidden(path):
    param, exp_avg, exp_avg_sq = state(600)
    grad = torch.zeros(600)
    grad[7] = math.nan
    adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    assert param[7].isnan()


def test_any_number_of_threads_gives_the_same_bits(path):
    before = torch.get_num_threads()
    results = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            param, exp_avg, exp_avg_sq = state(100_001)
            grad = param.sin()
            for step in (1, 2):
                adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.01, step=step, **OPTIONS)
            results.append(param)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(each, results[0]) for each in results)


@pytest.mark.parametrize("what", ["float64", "strided"])
def test_tensors_that_the_kernel_does_not_take_go_through_torch(path, what):
    dtype = torch.float64 if what == "float64" else torch.float32
    param, exp_avg, exp_avg_sq = state(20, 30, dtype=dtype)
    if what == "strided":
        param, exp_avg, exp_avg_sq = param.t(), exp_avg.t(), exp_avg_sq.t()
    theirs = torch.nn.Parameter(param.clone())
    optimizer = torch.optim.Adam([theirs], lr=0.01, eps=1e-15)
    grad = param.cos()
    theirs.grad = grad.clone()
    optimizer.step()
    adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    torch.testing.assert_close(param, theirs.detach(), rtol=1e-6, atol=1e-6)


def test_a_strided_gradient_is_read_right(path):
    param, exp_avg, exp_avg_sq = state(30, 20)
    grad = torch.arange(600.0).reshape(20, 30).t() - 300
    before = param.clone()
    adam_step(param, grad, exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    torch.testing.assert_close(param, before - 0.01 * grad.sign(), rtol=0, atol=1e-6)


def test_updates_together_are_those_of_each_alone(path):
    """One of them the kernel does not take."""
    kinds = [((30, 3), torch.float32), ((7,), torch.float64), ((600,), torch.float32), ((0, 4), torch.float32)]
    alone, together = ([state(*shape, dtype=dtype, seed=1) for shape, dtype in kinds] for _ in range(2))
    rates = [0.01, 0.02, 0.03, 0.04]
    for step in (1, 2):
        grads = [param.sin() for param, *_ in alone]
        for (param, *moments), grad, lr in zip(alone, grads, rates, strict=True):
            adam_step(param, grad, *moments, lr=lr, step=step, **OPTIONS)
        adam.adam_steps(
            [
                adam.AdamUpdate(param, grad, *moments, lr=lr, step=step, **OPTIONS)
                for (param, *moments), grad, lr in zip(together, grads, rates, strict=True)
            ]
        )
    assert all(
        torch.equal(a, b) for one, other in zip(alone, together, strict=True) for a, b in zip(one, other, strict=True)
    )


def test_autograd_notices_the_change(path):
    param, exp_avg, exp_avg_sq = state(10)
    param = torch.nn.Parameter(param)
    squares = (param * param).sum()
    adam_step(param, torch.ones(10), exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        squares.backward()


def test_an_empty_parameter_is_fine(path):
    param, exp_avg, exp_avg_sq = state(0, 3)
    adam_step(param, torch.zeros(0, 3), exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)


@pytest.mark.parametrize(("length", "step"), [(9, 1), (10, 0)])
def test_a_wrong_update_is_refused_before_any_other_is_done(path, length, step):
    good, bad = state(10), state(10)
    before = good[0].clone()
    right = adam.AdamUpdate(good[0], torch.ones(10), *good[1:], lr=0.1, step=1, **OPTIONS)
    wrong = adam.AdamUpdate(bad[0], torch.ones(length), *bad[1:], lr=0.1, step=step, **OPTIONS)
    for updates in ([wrong, right], [right, wrong]):
        with pytest.raises(ValueError, match=r"the parameter|counts from 1"):
            adam.adam_steps(updates)
        assert torch.equal(good[0], before)


def test_wrong_arguments_are_refused():
    param, exp_avg, exp_avg_sq = state(10)
    with pytest.raises(ValueError, match=r"grad is \[9\], the parameter \[10\]"):
        adam_step(param, torch.ones(9), exp_avg, exp_avg_sq, lr=0.01, step=1, **OPTIONS)
    with pytest.raises(ValueError, match="counts from 1, got 0"):
        adam_step(param, torch.ones(10), exp_avg, exp_avg_sq, lr=0.01, step=0, **OPTIONS)
