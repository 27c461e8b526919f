"""The mean of a model over the last steps: which samples, with rows that go, and across a checkpoint."""

import pytest
import torch
from sw_gaussians.averaging import AverageParameters

from splatwizard_core.api import GaussianModel, ParamGroup, SplatOptimizer


def made(n: int = 3) -> tuple[GaussianModel, SplatOptimizer]:
    model = GaussianModel(
        torch.zeros(n, 3),
        torch.zeros(n, 1, 3),
        torch.zeros(n, 3, 3),
        torch.zeros(n),
        torch.zeros(n, 3),
        torch.ones(n, 4),
    )
    return model, SplatOptimizer(model, [ParamGroup("means", lr=1.0), ParamGroup("quats", lr=1.0)])


def go(model: GaussianModel, optimizer: SplatOptimizer, task: AverageParameters, steps: range) -> None:
    """Row i of the means is at step * (i + 1) when a step begins."""
    for step in steps:
        if "means" in optimizer.states:
            model.means.data = step * model.sh_dc.detach()[:, 0] + step
        if step in task.steps:
            task(model, optimizer, step)
        model.means.grad = torch.ones_like(model.means)
        optimizer.step()


def numbered(n: int = 3) -> tuple[GaussianModel, SplatOptimizer]:
    model, optimizer = made(n)
    model.sh_dc.data = torch.arange(float(n))[:, None, None].repeat(1, 1, 3)
    return model, optimizer


def test_the_model_becomes_the_mean_of_the_samples_at_the_last_step_alone():
    model, optimizer = numbered()
    task = AverageParameters(first=4, last=10, every=3)
    go(model, optimizer, task, range(1, 10))
    assert model.means.detach()[1].tolist() == pytest.approx([17.0] * 3)  # 9 * 2, and one step of Adam
    model.means.data = 10 * model.sh_dc.detach()[:, 0] + 10
    task(model, optimizer, 10)
    assert model.means.detach()[:, 0].tolist() == pytest.approx([7.0, 14.0, 21.0])  # of steps 4, 7 and 10
    assert set(optimizer.states["means"].tensors) == {"exp_avg", "exp_avg_sq"}
    assert torch.equal(model.quats, torch.ones(3, 4))  # never updated


def test_means_follow_the_rows_and_are_saved():
    ends = []
    for resumes in (False, True):
        model, optimizer = numbered()
        task = AverageParameters(first=4, last=10, every=3)
        go(model, optimizer, task, range(1, 8))
        optimizer.keep_rows(model, torch.tensor([2, 0]))
        if resumes:
            saved, optimizer = optimizer.state_dict(), SplatOptimizer(model, list(optimizer.groups.values()))
            optimizer.load_state_dict(saved)
        go(model, optimizer, task, range(8, 10))
        model.means.data = 10 * model.sh_dc.detach()[:, 0] + 10
        task(model, optimizer, 10)
        ends.append(model.means.detach()[:, 0].tolist())
    assert ends == [pytest.approx([21.0, 7.0])] * 2


@pytest.mark.parametrize(("first", "last", "every"), [(5, 4, 1), (1, 10, 2), (1, 10, 0)])
def test_steps_that_are_no_samples_are_refused(first, last, every):
    with pytest.raises(ValueError, match=f"steps {first} to {last}"):
        AverageParameters(first=first, last=last, every=every)
