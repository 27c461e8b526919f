"""Adam by name: equal to torch's, and consistent while rows come and go."""

import copy

import pytest
import torch
from sw_gaussians.learning_rate import exponential_lr
from torch import nn

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer


class Rows(SplatModel):
    ROWS = ("a", "b", "seen")

    def __init__(self, n=4):
        super().__init__()
        generator = torch.Generator().manual_seed(0)
        self.a = nn.Parameter(torch.randn(n, 3, generator=generator))
        self.b = nn.Parameter(torch.randn(n, generator=generator))
        self.register_buffer("seen", torch.arange(float(n)))
        self.mlp = nn.Sequential(nn.Linear(2, 2), nn.Linear(2, 1))


class Holder(SplatModel):
    ROWS = ("inner.a", "inner.b", "inner.seen")

    def __init__(self):
        super().__init__()
        self.inner = Rows()


def groups():
    return [ParamGroup("a", 0.1), ParamGroup("b", 0.01), ParamGroup("mlp", 1e-3, eps=1e-8, betas=(0.8, 0.9))]


def train(model, optimizer, steps=3, seed=1):
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        for p in model.parameters():
            p.grad = torch.randn(p.shape, generator=generator)
        optimizer.step()
        optimizer.zero_grad()


def test_steps_equal_torch_adam():
    model = Rows()
    twin = copy.deepcopy(model)
    optimizer = SplatOptimizer(model, groups())
    reference = torch.optim.Adam(
        [
            {"params": [twin.a], "lr": 0.1, "eps": 1e-15},
            {"params": [twin.b], "lr": 0.01, "eps": 1e-15},
            {"params": twin.mlp.parameters(), "lr": 1e-3, "eps": 1e-8, "betas": (0.8, 0.9)},
        ]
    )
    generator = torch.Generator().manual_seed(3)
    for _ in range(20):
        for p, q in zip(model.parameters(), twin.parameters(), strict=True):
            p.grad = torch.randn(p.shape, generator=generator)
            q.grad = p.grad.clone()
        optimizer.step()
        reference.step()
    for p, q in zip(model.parameters(), twin.parameters(), strict=True):
        torch.testing.assert_close(p, q, rtol=0, atol=1e-6)


def test_a_parameter_without_gradient_is_skipped_with_its_counter():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer, steps=2)
    before = model.a.detach().clone()
    model.b.grad = torch.ones_like(model.b)
    optimizer.step()
    assert torch.equal(model.a, before)
    assert optimizer.moments("a")[2] == 2
    assert optimizer.moments("b")[2] == 3


def test_rates_can_be_set():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    optimizer.set_lr("a", 0.0)
    before = model.a.detach().clone()
    train(model, optimizer, steps=1)
    assert optimizer.lr("a") == 0.0
    assert torch.equal(model.a, before)


def test_zero_grad_reaches_parameters_of_no_group():
    model = Rows()
    optimizer = SplatOptimizer(model, [ParamGroup("a", 0.1)])
    model.b.grad = torch.ones_like(model.b)
    optimizer.zero_grad()
    assert model.b.grad is None


@pytest.mark.parametrize(
    ("made", "message"),
    [
        ([ParamGroup("c", 0.1)], "no parameter or submodule with parameters 'c'"),
        ([ParamGroup("ml", 0.1)], "'ml'"),
        ([ParamGroup("mlp", 0.1), ParamGroup("mlp.0.weight", 0.1)], "'mlp.0.weight' is in the groups 'mlp'"),
    ],
)
def test_groups_must_name_something_and_not_twice(made, message):
    with pytest.raises(ValueError, match=message):
        SplatOptimizer(Rows(), made)


def test_appended_rows_have_zero_moments_and_the_counters_stay():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer)
    old = {n: t.detach().clone() for n, t in model.state_dict().items()}
    avg, sq, step = (t.clone() if isinstance(t, torch.Tensor) else t for t in optimizer.moments("a"))
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    optimizer.append_rows(model, {"a": torch.full((2, 3), 7.0), "b": torch.full((2,), 8.0)})
    assert model.num_rows == 6
    assert torch.equal(model.a[:4], old["a"])
    assert torch.equal(model.a[4:], torch.full((2, 3), 7.0))
    assert torch.equal(model.seen, torch.tensor([0.0, 1, 2, 3, 0, 0]))
    assert model.a.grad is None
    assert model.mlp[0].weight.grad is not None
    new_avg, new_sq, new_step = optimizer.moments("a")
    assert torch.equal(new_avg, torch.cat([avg, torch.zeros(2, 3)]))
    assert torch.equal(new_sq, torch.cat([sq, torch.zeros(2, 3)]))
    assert new_step == step == 3


def test_given_buffer_rows_are_used():
    model = Rows()
    SplatOptimizer(model, groups()).append_rows(
        model, {"a": torch.zeros(1, 3), "b": torch.zeros(1), "seen": torch.tensor([9.0])}
    )
    assert model.seen.tolist() == [0, 1, 2, 3, 9]


@pytest.mark.parametrize(
    "rows",
    [
        {"a": torch.zeros(2, 3)},
        {"a": torch.zeros(2, 3), "b": torch.zeros(3)},
        {"a": torch.zeros(2, 4), "b": torch.zeros(2)},
        {"a": torch.zeros(2, 3), "b": torch.zeros(2), "c": torch.zeros(2)},
    ],
)
def test_rows_that_do_not_fit_change_nothing(rows):
    model = Rows()
    before = model.digest()
    with pytest.raises(ShapeError):
        SplatOptimizer(model, groups()).append_rows(model, rows)
    assert model.digest() == before


def test_kept_rows_keep_their_moments():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer)
    avg = optimizer.moments("b")[0].clone()
    old = model.b.detach().clone()
    mask = torch.tensor([True, False, True, True])
    for p in model.parameters():
        p.grad = torch.ones_like(p)
    optimizer.keep_rows(model, mask)
    assert torch.equal(model.b, old[mask])
    assert model.seen.tolist() == [0, 2, 3]
    assert torch.equal(optimizer.moments("b")[0], avg[mask])
    assert optimizer.moments("b")[2] == 3
    assert model.a.grad is None


def test_keeping_everything_still_skips_this_steps_update():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer)
    before = model.a.detach().clone()
    model.a.grad = torch.ones_like(model.a)
    optimizer.keep_rows(model, torch.ones(4, dtype=torch.bool))
    optimizer.step()
    assert torch.equal(model.a, before)


def test_survivors_can_carry_their_gradients():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    model.a.grad = torch.arange(12.0).view(4, 3)
    optimizer.keep_rows(model, torch.tensor([False, True, False, True]), carry_grad=True)
    assert torch.equal(model.a.grad, torch.tensor([[3.0, 4, 5], [9, 10, 11]]))
    assert model.b.grad is None
    before = model.a.detach().clone()
    optimizer.step()
    assert not torch.equal(model.a, before)


@pytest.mark.parametrize("mask", [torch.ones(3, dtype=torch.bool), torch.ones(4), torch.ones(4, 1, dtype=torch.bool)])
def test_a_mask_must_be_bool_over_the_rows(mask):
    model = Rows()
    with pytest.raises(ShapeError, match="bool mask"):
        SplatOptimizer(model, groups()).keep_rows(model, mask)


def test_a_replaced_parameter_starts_with_zero_moments_at_the_same_count():
    # The opacity reset: values capped, both moments zero, the step counter kept.
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer, steps=5)
    model.b.grad = torch.ones_like(model.b)
    capped = model.b.detach().clamp_max(0.0)
    optimizer.replace(model, "b", capped)
    assert isinstance(model.b, nn.Parameter)
    assert model.b.grad is None
    assert torch.equal(model.b, capped)
    avg, sq, step = optimizer.moments("b")
    assert step == 5
    assert not avg.any()
    assert not sq.any()


def test_rows_of_a_submodule_are_found_under_its_name():
    holder = Holder()
    optimizer = SplatOptimizer(holder, [ParamGroup("inner.a", 0.1), ParamGroup("inner.b", 0.1)])
    train(holder, optimizer, steps=2)
    optimizer.keep_rows(holder.inner, torch.tensor([True, True, False, False]))
    assert optimizer.moments("inner.a")[0].shape == (2, 3)
    optimizer.append_rows(holder, {"inner.a": torch.zeros(1, 3), "inner.b": torch.zeros(1)})
    assert holder.inner.a.shape == (3, 3)
    assert optimizer.moments("inner.a")[0].shape == (3, 3)
    with pytest.raises(ValueError, match="not part of the model"):
        optimizer.keep_rows(Rows(), torch.ones(4, dtype=torch.bool))


def test_frozen_parameters_stay_frozen_and_follow():
    model = Rows()
    model.b.requires_grad_(False)
    optimizer = SplatOptimizer(model, [ParamGroup("a", 0.1)])
    optimizer.keep_rows(model, torch.tensor([True, False, False, True]))
    assert model.b.shape == (2,)
    assert not model.b.requires_grad


def test_state_goes_on_where_it_was():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer)
    optimizer.set_lr("a", 0.05)
    twin = copy.deepcopy(model)
    other = SplatOptimizer(twin, groups())
    other.load_state_dict(optimizer.state_dict())
    train(model, optimizer, seed=9)
    train(twin, other, seed=9)
    assert twin.digest() == model.digest()
    assert other.lr("a") == 0.05


def test_state_that_does_not_fit_is_refused():
    model = Rows()
    optimizer = SplatOptimizer(model, groups())
    train(model, optimizer)
    state = optimizer.state_dict()
    with pytest.raises(ValueError, match="groups differ"):
        SplatOptimizer(Rows(), groups()[:2]).load_state_dict(state)
    with pytest.raises(ValueError, match="optimizer state of 'a'"):
        SplatOptimizer(Rows(5), groups()).load_state_dict(state)
    with pytest.raises(ValueError, match="in no group"):
        SplatOptimizer(Rows(), groups()).load_state_dict({**state, "moments": {"x": state["moments"]["a"]}})


E = 3.7  # a scene extent


@pytest.mark.parametrize(("step", "rate"), [(0, 1.6e-4), (15_000, 1.6e-5), (30_000, 1.6e-6), (50_000, 1.6e-6)])
def test_the_position_rate_is_log_linear(step, rate):
    assert E * exponential_lr(step, init=1.6e-4, final=1.6e-6, max_steps=30_000) == pytest.approx(E * rate, rel=1e-6)


def test_the_delay_multiplier_acts_only_with_delay_steps():
    plain = exponential_lr(10, init=1.0, final=0.1, max_steps=100)
    assert exponential_lr(10, init=1.0, final=0.1, max_steps=100, delay_mult=0.01) == plain
    assert exponential_lr(0, init=1.0, final=0.1, max_steps=100, delay_steps=20, delay_mult=0.01) == 0.01
    damping = 0.01 + 0.99 * 0.5**0.5  # sin(pi/4) half way
    assert exponential_lr(10, init=1.0, final=0.1, max_steps=100, delay_steps=20, delay_mult=0.01) == pytest.approx(
        plain * damping
    )
    assert exponential_lr(-1, init=1.0, final=0.1, max_steps=100) == 0.0
