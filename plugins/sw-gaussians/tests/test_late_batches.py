"""Updates on the summed gradients of several views: when, with what sum, and that the sums are saved."""

import pytest
import torch
from sw_gaussians.late_batches import SumViews

from splatwizard_core.api import GaussianModel, ParamGroup, SplatOptimizer, stream


def model_of(n: int = 4) -> GaussianModel:
    random = stream(0, "model")
    shapes = ((n, 3), (n, 1, 3), (n, 3, 3), (n,), (n, 3), (n, 4))
    return GaussianModel(*(torch.randn(shape, generator=random) for shape in shapes))


def groups() -> list[ParamGroup]:
    return [ParamGroup(name, lr=0.01) for name in GaussianModel.RAW]


def run(optimizer: SplatOptimizer, task: SumViews, steps: range) -> None:
    for step in steps:
        for name, p in optimizer.model.named_parameters():
            p.grad = torch.randn(p.shape, generator=stream(step, name))
        task(optimizer.model, optimizer, step)
        optimizer.step()
        optimizer.zero_grad()


def plain(sums: list[range]) -> dict[str, torch.Tensor]:
    """Parameters after one update of Adam for each sum of the gradients of some steps."""
    model = model_of()
    optimizer = SplatOptimizer(model, groups())
    for steps in sums:
        for name, p in model.named_parameters():
            p.grad = sum(torch.randn(p.shape, generator=stream(step, name)) for step in steps)
        optimizer.step()
    return {name: p.detach() for name, p in model.named_parameters()}


def test_it_updates_at_each_step_until_the_first_and_then_with_sums():
    model = model_of()
    optimizer = SplatOptimizer(model, groups())
    run(optimizer, SumViews(views=3, first=4), range(1, 11))
    expected = plain([range(1, 2), range(2, 3), range(3, 4), range(4, 7), range(7, 10)])  # the gradient of 10 waits
    for name, p in model.named_parameters():
        assert torch.allclose(p, expected[name], rtol=1e-6, atol=1e-7), name
    assert optimizer.states["means"].step == 5


def test_the_last_step_updates_with_what_there_is():
    model = model_of()
    run(SplatOptimizer(model, groups()), SumViews(views=8, first=2, last=4), range(1, 5))
    expected = plain([range(1, 2), range(2, 5)])
    for name, p in model.named_parameters():
        assert torch.allclose(p, expected[name], rtol=1e-6, atol=1e-7), name


def test_sums_follow_the_rows_and_are_saved():
    task, order = SumViews(views=2, first=1), torch.tensor([2, 0, 3])
    ends = []
    for resumes in (False, True):
        model = model_of()
        optimizer = SplatOptimizer(model, groups())
        run(optimizer, task, range(1, 4))
        optimizer.keep_rows(model, order)
        if resumes:
            saved, optimizer = optimizer.state_dict(), SplatOptimizer(model, groups())
            optimizer.load_state_dict(saved)
        run(optimizer, task, range(4, 5))
        ends.append(model.means.detach())
    assert torch.equal(*ends)
    kept = plain([range(1, 3)])["means"][order]
    assert float((ends[0] - kept).abs().max()) > 1e-3  # the gradient of step 3 was not lost with the rows


def test_less_than_one_view_is_refused():
    with pytest.raises(ValueError, match="views is 0"):
        SumViews(views=0)
