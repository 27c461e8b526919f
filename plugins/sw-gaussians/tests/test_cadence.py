"""Updates of some parameters at every k-th step, on the sum of their gradients."""

import pytest
import torch
from sw_gaussians.cadence import CadencedOptimizer, SparseCadencedOptimizer

from splatwizard_core.api import GaussianModel, ParamGroup, ShapeError, SplatOptimizer, stream


def model_of(n: int = 4) -> GaussianModel:
    r = stream(0, "model")
    shapes = ((n, 3), (n, 1, 3), (n, 3, 3), (n,), (n, 3), (n, 4))
    return GaussianModel(*(torch.randn(s, generator=r) for s in shapes))


def groups() -> list[ParamGroup]:
    return [ParamGroup(name, lr=0.01) for name in GaussianModel.RAW]


def gradients(model: GaussianModel, step: int) -> None:
    for name, p in model.named_parameters():
        p.grad = torch.randn(p.shape, generator=stream(step, name))


def values(model: GaussianModel) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in model.named_parameters()}


def test_every_step_is_adam_bit_for_bit():
    slow, plain = model_of(), model_of()
    a, b = CadencedOptimizer(slow, groups(), every=1), SplatOptimizer(plain, groups())
    for step in range(5):
        for model, optimizer in ((slow, a), (plain, b)):
            gradients(model, step)
            optimizer.step()
    assert all(torch.equal(x, y) for x, y in zip(values(slow).values(), values(plain).values(), strict=True))


def test_one_update_of_sixteen_gradients_is_one_of_their_sum():
    slow, plain = model_of(), model_of()
    a, b = CadencedOptimizer(slow, groups(), every=16), SplatOptimizer(plain, groups())
    total = torch.zeros_like(plain.sh_rest)
    first = values(slow)
    for step in range(16):
        gradients(slow, step)
        total += slow.sh_rest.grad
        assert torch.equal(slow.sh_rest, first["sh_rest"])
        a.step()
    plain.sh_rest.grad = total
    b.step()
    assert torch.equal(slow.sh_rest, plain.sh_rest)
    assert not torch.equal(slow.means, first["means"])


def test_sums_follow_the_rows_and_are_saved():
    model = model_of()
    optimizer = CadencedOptimizer(model, groups(), every=3)
    gradients(model, 0)
    expected = model.sh_rest.grad.clone()
    optimizer.step()
    order = torch.tensor([2, 0, 3])
    optimizer.keep_rows(model, order)
    state = optimizer.state_dict()
    assert torch.equal(state["moments"]["sh_rest"]["pending"], expected[order])
    other = CadencedOptimizer(model, groups(), every=3)
    other.load_state_dict(state)
    before = values(model)
    for each in (optimizer, other):
        for name, p in model.named_parameters():
            p.data = before[name].clone()
        for step in (1, 2):
            gradients(model, step)
            each.step()
        if each is optimizer:
            uninterrupted = values(model)
    assert all(torch.equal(uninterrupted[name], p) for name, p in model.named_parameters())


def test_it_goes_with_sparse_adam():
    model = model_of()
    optimizer = SparseCadencedOptimizer(model, groups(), every=2, bias_correction="per_row")
    first = values(model)
    rows = torch.tensor([True, False, True, True])
    for step in range(2):
        gradients(model, step)
        optimizer.step_rows(rows)
    moved = (model.sh_rest != first["sh_rest"]).flatten(1).any(dim=1)
    assert moved.tolist() == rows.tolist()


def test_what_a_hidden_gaussian_has_gathered_waits_until_it_is_shown():
    model = model_of(3)
    optimizer = SparseCadencedOptimizer(model, groups(), every=2, bias_correction="per_row")
    views = [[True, True, False], [True, False, False], [True, False, False], [True, True, False]]
    shown, given = [], torch.zeros_like(model.sh_rest)
    for step, view in enumerate(views):
        rows = torch.tensor(view)
        gradients(model, step)
        for p in model.parameters():
            p.grad[~rows] = 0
        given += model.sh_rest.grad
        before = model.sh_rest.detach().clone()
        optimizer.step_rows(rows)
        shown.append((model.sh_rest != before).flatten(1).any(dim=1).tolist())
    assert shown == [[False] * 3, [True, False, False], [False] * 3, [True, True, False]]
    moments, _, _ = optimizer.moments("sh_rest")
    assert torch.allclose(moments[1], 0.1 * given[1])  # all that it was given, the view of step 1 included
    assert not optimizer.states["sh_rest"].tensors["pending"].any()


@pytest.mark.parametrize("mask", [torch.tensor([True, False]), torch.tensor([0.0] * 4)])
def test_rows_to_keep_are_a_mask_or_an_order(mask):
    model = model_of()
    with pytest.raises(ShapeError, match="keep_rows needs a bool mask"):
        SplatOptimizer(model, groups()).keep_rows(model, mask)
