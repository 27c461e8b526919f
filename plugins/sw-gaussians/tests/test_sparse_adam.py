"""Sparse Adam against a loop over rows in float64, on the compiled and on the torch path."""

import math
from types import SimpleNamespace

import pytest
import torch
from sw_gaussians import sparse_adam as module
from sw_gaussians.native import GAUSSIANS
from sw_gaussians.sparse_adam import SparseSplatOptimizer, sparse_adam, sparse_adam_steps
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from splatwizard_native import AdamUpdate

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15
OPTIONS = {"beta1": BETA1, "beta2": BETA2, "eps": EPS}
MODES = ["none", "per_row"]


NEEDS_GPU = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]


@pytest.fixture(params=["kernels", "torch", pytest.param("cuda", marks=NEEDS_GPU)])
def device(request, monkeypatch) -> str:
    if request.param == "torch":
        monkeypatch.setattr(module, "GAUSSIANS", SimpleNamespace(try_load=lambda: False))
    elif request.param == "kernels" and not GAUSSIANS.try_load():
        pytest.skip(f"no compiled kernels: {GAUSSIANS.available()}")
    return "cuda" if request.param == "cuda" else "cpu"


class Loop:
    """One row at a time, in double precision."""

    def __init__(self, param: torch.Tensor, mode: str) -> None:
        self.rows = [row.double() for row in param.detach().cpu().clone()]
        self.m = [torch.zeros_like(row) for row in self.rows]
        self.v = [torch.zeros_like(row) for row in self.rows]
        self.t = [0] * len(self.rows)
        self.mode = mode

    def step(self, grad: torch.Tensor, seen: torch.Tensor, lr: float) -> None:
        for i in seen.nonzero().flatten().tolist():
            g = grad[i].double()
            self.t[i] += 1
            self.m[i] = BETA1 * self.m[i] + (1 - BETA1) * g
            self.v[i] = BETA2 * self.v[i] + (1 - BETA2) * g * g
            c1, c2 = (1 - BETA1 ** self.t[i], 1 - BETA2 ** self.t[i]) if self.mode == "per_row" else (1.0, 1.0)
            self.rows[i] = self.rows[i] - lr * (self.m[i] / c1) / ((self.v[i] / c2).sqrt() + EPS)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("shape", [(1, 1), (37,), (600, 3), (5000, 1), (130, 15, 3)])
def test_thirty_steps_equal_the_loop(device, mode, shape):
    generator = torch.Generator().manual_seed(3)
    param = torch.randn(*shape, generator=generator)
    loop = Loop(param, mode) if shape[0] < 1000 else Loop(param[:50], mode)
    param = param.to(device)
    exp_avg, exp_avg_sq = torch.zeros_like(param), torch.zeros_like(param)
    counts = torch.zeros(shape[0], dtype=torch.int32, device=device) if mode == "per_row" else None
    for step in range(30):
        grad = torch.randn(*shape, generator=generator) * 10 ** (4 * torch.rand(*shape, generator=generator) - 4)
        seen = torch.rand(shape[0], generator=generator) < 0.4
        lr = 0.01 * 0.97**step
        loop.step(grad, seen[: len(loop.rows)], lr)
        sparse_adam(
            param, grad.to(device), exp_avg, exp_avg_sq, seen.to(device),
            lr=lr, bias_correction=mode, row_steps=counts, **OPTIONS,
        )  # fmt: skip
    n = len(loop.rows)
    torch.testing.assert_close(param[:n].cpu().double(), torch.stack(loop.rows), rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(exp_avg[:n].cpu().double(), torch.stack(loop.m), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(exp_avg_sq[:n].cpu().double(), torch.stack(loop.v), rtol=1e-4, atol=1e-12)
    if counts is not None:
        assert counts[:n].tolist() == loop.t


@pytest.mark.parametrize(("mode", "factor"), [("none", (1 - BETA1) / math.sqrt(1 - BETA2)), ("per_row", 1.0)])
def test_the_first_step_is_3_16_times_the_rate_without_bias_correction(device, mode, factor):
    grad = torch.tensor([[3.0, -0.2], [1e-3, -70.0]], device=device)
    param, exp_avg, exp_avg_sq = (torch.zeros(2, 2, device=device) for _ in range(3))
    counts = torch.zeros(2, dtype=torch.int32, device=device) if mode == "per_row" else None
    seen = torch.ones(2, dtype=torch.bool, device=device)
    sparse_adam(
        param, grad, exp_avg, exp_avg_sq, seen, lr=0.5, bias_correction=mode, row_steps=counts, **OPTIONS
    )  # fmt: skip
    torch.testing.assert_close(param, -0.5 * factor * grad.sign(), rtol=1e-5, atol=0)
    assert pytest.approx(3.16, abs=0.01) == (1 - BETA1) / math.sqrt(1 - BETA2)


@pytest.mark.parametrize("mode", MODES)
def test_hidden_rows_keep_every_bit_and_their_gradient_is_not_read(device, mode):
    generator = torch.Generator().manual_seed(1)
    tensors = [torch.rand(50, 3, generator=generator).to(device) for _ in range(3)]
    before = [t.clone() for t in tensors]
    seen = torch.zeros(50, dtype=torch.bool, device=device)
    seen[10:20] = True
    grad = torch.full((50, 3), math.nan, device=device)
    grad[10:20] = 1.0
    counts = torch.zeros(50, dtype=torch.int32, device=device) if mode == "per_row" else None
    sparse_adam(tensors[0], grad, *tensors[1:], seen, lr=0.1, bias_correction=mode, row_steps=counts, **OPTIONS)
    for now, then in zip(tensors, before, strict=True):
        assert torch.equal(now[~seen], then[~seen])
        assert (now[seen] != then[seen]).all()
        assert torch.isfinite(now).all()


def test_any_number_of_threads_gives_the_same_bits():
    if not GAUSSIANS.try_load():
        pytest.skip(f"no compiled kernels: {GAUSSIANS.available()}")
    threads, results = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            param = torch.linspace(-1, 1, 30_000).view(-1, 3)
            moments = torch.zeros_like(param), torch.zeros_like(param)
            for step in range(3):
                seen = torch.arange(10_000) % (step + 2) == 0
                sparse_adam(param, param.sin(), *moments, seen, lr=0.01, **OPTIONS)
            results.append(param)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*results)


def test_wrong_arguments_are_refused():
    x, rows = torch.zeros(4, 3), torch.ones(4, dtype=torch.bool)
    with pytest.raises(ShapeError, match=r"rows is \[5\], the parameter \[4, 3\]: it must be \[4\]"):
        sparse_adam(x, x, x.clone(), x.clone(), torch.ones(5, dtype=torch.bool), lr=1, **OPTIONS)
    with pytest.raises(ValueError, match="row_steps goes with"):
        sparse_adam(x, x, x.clone(), x.clone(), rows, lr=1, bias_correction="per_row", **OPTIONS)


def made(mode, n: int = 12) -> tuple[GaussianModel, SplatOptimizer]:
    generator = torch.Generator().manual_seed(4)
    points = PointCloud(torch.rand(n, 3, generator=generator), torch.rand(n, 3, generator=generator))
    model = gaussians_from_points(points, max_sh_degree=1)
    groups = [ParamGroup(name, lr=0.01) for name, _ in model.named_parameters()]
    if mode is None:
        return model, SplatOptimizer(model, groups)
    return model, SparseSplatOptimizer(model, groups, bias_correction=mode)


def give_gradients(model: GaussianModel, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


@pytest.mark.parametrize("mode", MODES)
def test_the_optimizer_updates_the_rows_it_is_told_of(mode):
    model, optimizer = made(mode)
    before = {k: v.detach().clone() for k, v in model.named_parameters()}
    seen = torch.arange(12) % 3 == 0
    give_gradients(model, 1)
    optimizer.step_rows(seen)
    for name, parameter in model.named_parameters():
        moved = (parameter.detach() != before[name]).view(12, -1)
        assert moved[seen].all()
        assert not moved[~seen].any()


def test_all_rows_with_bias_correction_per_row_is_adam():
    model, optimizer = made("per_row")
    dense_model, dense = made(None)
    for seed in range(5):
        give_gradients(model, seed)
        give_gradients(dense_model, seed)
        optimizer.step()
        dense.step()
    for mine, theirs in zip(model.parameters(), dense_model.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NEEDS_GPU)])
@pytest.mark.parametrize("mode", MODES)
def test_many_parameters_at_once_are_each_alone(device, mode):
    """Widths that are no multiple of four, more rows than a block owns, and one that no kernel takes."""
    generator = torch.Generator().manual_seed(8)
    shapes = [(700, 3), (700,), (700, 15, 3), (700, 0, 3), (700, 5)]

    def tensor(shape):
        return torch.rand(shape, generator=generator).to(device)

    rows = (torch.rand(700, generator=generator) < 0.3).to(device)
    rows[256:512] = False  # all that a block owns
    pairs = []
    for shape in shapes:
        tensors = [tensor(shape) for _ in range(4)]
        if shape == (700, 5):
            tensors[0] = tensors[0].t().contiguous().t()  # strided
        steps = torch.arange(700, dtype=torch.int32, device=device) if mode == "per_row" else None
        pairs.append((tensors, steps, [t.clone() for t in tensors], None if steps is None else steps.clone()))
    sparse_adam_steps(
        [AdamUpdate(*mine, 0.01, BETA1, BETA2, EPS, 0) for mine, *_ in pairs], rows, [p[1] for p in pairs]
    )
    for mine, steps, alone, alone_steps in pairs:
        p, g, m, v = alone
        sparse_adam(p, g, m, v, rows, lr=0.01, bias_correction=mode, row_steps=alone_steps, **OPTIONS)
        for a, b in zip(mine, alone, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)
            assert torch.equal(a[~rows], b[~rows])
        assert steps is None or torch.equal(steps, alone_steps)
    assert not torch.equal(pairs[0][0][0][rows], pairs[0][0][3][rows])


@pytest.mark.parametrize("mode", MODES)
def test_counts_follow_the_rows_that_come_go_and_are_rewritten(mode):
    model, optimizer = made(mode)
    seen = torch.zeros(12, dtype=torch.bool)
    seen[:6] = True
    for seed in (1, 2):
        give_gradients(model, seed)
        optimizer.step_rows(seen)
    optimizer.append_rows(model, {k: v.detach()[:2] for k, v in model.named_parameters()})
    optimizer.set_rows(model, torch.tensor([1]), {})
    optimizer.keep_rows(model, torch.arange(14) != 0)
    give_gradients(model, 3)
    optimizer.step_rows(torch.ones(13, dtype=torch.bool))
    counts = optimizer.state_dict()["moments"]["means"].get("row_steps")
    if mode == "none":
        assert counts is None
    else:  # old row 0 is gone, row 1 was rewritten, 2..5 were seen twice, 6..11 and the two new ones never
        assert counts.tolist() == [1] + [3] * 4 + [1] * 6 + [1] * 2


@pytest.mark.parametrize("mode", MODES)
def test_a_loaded_state_goes_on_in_the_same_bits(mode):
    model, optimizer = made(mode)
    seen = torch.arange(12) < 5
    give_gradients(model, 1)
    optimizer.step_rows(seen)
    other, resumed = made(mode)
    other.load_state_dict(model.state_dict())
    resumed.load_state_dict(optimizer.state_dict())
    for one, two in ((model, optimizer), (other, resumed)):
        give_gradients(one, 2)
        two.step_rows(torch.arange(12) < 8)
    assert model.digest() == other.digest()


def test_a_step_of_training_updates_what_its_render_shows():
    model, optimizer = made("none")
    before = model.means.detach().clone()
    give_gradients(model, 1)
    optimizer.step(SimpleNamespace(visible=torch.arange(12) < 4))
    assert (model.means.detach() != before).any(dim=1).tolist() == [True] * 4 + [False] * 8


def test_a_mask_of_another_length_is_refused():
    model, optimizer = made("none")
    give_gradients(model, 1)
    with pytest.raises(ShapeError, match="rows is"):
        optimizer.step_rows(torch.ones(11, dtype=torch.bool))
