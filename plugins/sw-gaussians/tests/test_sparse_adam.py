"""Sparse Adam against a loop over rows in float64, on the compiled and on the torch path."""

import math
from types import SimpleNamespace

import pytest
import torch
from sw_gaussians import face
from sw_gaussians.fast import sparse_adam as module
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

NEEDS_GPU = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]


@pytest.fixture(params=["kernels", "torch", pytest.param("cuda", marks=NEEDS_GPU)])
def device(request, monkeypatch) -> str:
    if request.param == "torch":
        monkeypatch.setattr(module, "GAUSSIANS", SimpleNamespace(try_load=lambda: False, has_cuda=lambda: False))
    elif request.param == "kernels" and not GAUSSIANS.try_load():
        pytest.skip(f"no compiled kernels: {GAUSSIANS.available()}")
    return "cuda" if request.param == "cuda" else "cpu"


class Loop:
    """One row at a time, in double precision."""

    def __init__(self, param: torch.Tensor) -> None:
        self.rows = [row.double() for row in param.detach().cpu().clone()]
        self.m = [torch.zeros_like(row) for row in self.rows]
        self.v = [torch.zeros_like(row) for row in self.rows]

    def step(self, grad: torch.Tensor, seen: torch.Tensor, lr: float) -> None:
        for i in seen.nonzero().flatten().tolist():
            g = grad[i].double()
            self.m[i] = BETA1 * self.m[i] + (1 - BETA1) * g
            self.v[i] = BETA2 * self.v[i] + (1 - BETA2) * g * g
            self.rows[i] = self.rows[i] - lr * self.m[i] / (self.v[i].sqrt() + EPS)


@pytest.mark.parametrize("shape", [(1, 1), (37,), (600, 3), (5000, 1), (130, 15, 3)])
def test_thirty_steps_equal_the_loop(device, shape):
    generator = torch.Generator().manual_seed(3)
    param = torch.randn(*shape, generator=generator)
    loop = Loop(param) if shape[0] < 1000 else Loop(param[:50])
    param = param.to(device)
    exp_avg, exp_avg_sq = torch.zeros_like(param), torch.zeros_like(param)
    for step in range(30):
        grad = torch.randn(*shape, generator=generator) * 10 ** (4 * torch.rand(*shape, generator=generator) - 4)
        seen = torch.rand(shape[0], generator=generator) < 0.4
        lr = 0.01 * 0.97**step
        loop.step(grad, seen[: len(loop.rows)], lr)
        sparse_adam(
            param, grad.to(device), exp_avg, exp_avg_sq, seen.to(device),
            lr=lr, **OPTIONS,
        )  # fmt: skip
    n = len(loop.rows)
    torch.testing.assert_close(param[:n].cpu().double(), torch.stack(loop.rows), rtol=2e-5, atol=2e-6)
    torch.testing.assert_close(exp_avg[:n].cpu().double(), torch.stack(loop.m), rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(exp_avg_sq[:n].cpu().double(), torch.stack(loop.v), rtol=1e-4, atol=1e-12)


def test_the_first_step_is_3_16_times_the_rate(device):
    factor = (1 - BETA1) / math.sqrt(1 - BETA2)
    grad = torch.tensor([[3.0, -0.2], [1e-3, -70.0]], device=device)
    param, exp_avg, exp_avg_sq = (torch.zeros(2, 2, device=device) for _ in range(3))
    seen = torch.ones(2, dtype=torch.bool, device=device)
    sparse_adam(
        param, grad, exp_avg, exp_avg_sq, seen, lr=0.5, **OPTIONS
    )  # fmt: skip
    torch.testing.assert_close(param, -0.5 * factor * grad.sign(), rtol=1e-5, atol=0)
    assert pytest.approx(3.16, abs=0.01) == (1 - BETA1) / math.sqrt(1 - BETA2)


def test_hidden_rows_keep_every_bit_and_their_gradient_is_not_read(device):
    generator = torch.Generator().manual_seed(1)
    tensors = [torch.rand(50, 3, generator=generator).to(device) for _ in range(3)]
    before = [t.clone() for t in tensors]
    seen = torch.zeros(50, dtype=torch.bool, device=device)
    seen[10:20] = True
    grad = torch.full((50, 3), math.nan, device=device)
    grad[10:20] = 1.0
    sparse_adam(tensors[0], grad, *tensors[1:], seen, lr=0.1, **OPTIONS)
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
    x = torch.zeros(4, 3)
    with pytest.raises(ShapeError, match=r"rows is \[5\], the parameter \[4, 3\]: it must be \[4\]"):
        sparse_adam(x, x, x.clone(), x.clone(), torch.ones(5, dtype=torch.bool), lr=1, **OPTIONS)


def test_the_kernel_refuses_what_is_no_mask_or_no_row():
    if not GAUSSIANS.try_load():
        pytest.skip(f"no compiled kernels: {GAUSSIANS.available()}")
    x = torch.zeros(4, 3)
    with pytest.raises(RuntimeError, match="marked must be a contiguous bool tensor"):
        sparse_adam(x, x, x.clone(), x.clone(), torch.ones(4), lr=1, **OPTIONS)
    updates = (face.sparse_update * 1)((*[x.data_ptr()] * 4, -3, 1.0, BETA1, BETA2, EPS))
    with pytest.raises(RuntimeError, match="update 0 has rows of -3 numbers"):
        face.sparse_adam(updates=updates, count=1, marked=torch.ones(4, dtype=torch.bool))
    assert (x == 0).all()


def made(n: int = 12) -> tuple[GaussianModel, SplatOptimizer]:
    generator = torch.Generator().manual_seed(4)
    points = PointCloud(torch.rand(n, 3, generator=generator), torch.rand(n, 3, generator=generator))
    model = gaussians_from_points(points, max_sh_degree=1)
    groups = [ParamGroup(name, lr=0.01) for name, _ in model.named_parameters()]
    return model, SparseSplatOptimizer(model, groups)


def give_gradients(model: GaussianModel, seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        parameter.grad = torch.randn(parameter.shape, generator=generator)


def test_the_optimizer_updates_the_rows_it_is_told_of():
    model, optimizer = made()
    before = {k: v.detach().clone() for k, v in model.named_parameters()}
    seen = torch.arange(12) % 3 == 0
    give_gradients(model, 1)
    optimizer.step_rows(seen)
    for name, parameter in model.named_parameters():
        moved = (parameter.detach() != before[name]).view(12, -1)
        assert moved[seen].all()
        assert not moved[~seen].any()


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=NEEDS_GPU)])
def test_many_parameters_at_once_are_each_alone(device):
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
        pairs.append((tensors, [t.clone() for t in tensors]))
    sparse_adam_steps([AdamUpdate(*mine, 0.01, BETA1, BETA2, EPS, 0) for mine, _ in pairs], rows)
    for mine, alone in pairs:
        sparse_adam(*alone, rows, lr=0.01, **OPTIONS)
        for a, b in zip(mine, alone, strict=True):
            torch.testing.assert_close(a, b, rtol=1e-6, atol=1e-7)
            assert torch.equal(a[~rows], b[~rows])
    assert not torch.equal(pairs[0][0][0][rows], pairs[0][0][3][rows])


def test_a_loaded_state_goes_on_in_the_same_bits():
    model, optimizer = made()
    seen = torch.arange(12) < 5
    give_gradients(model, 1)
    optimizer.step_rows(seen)
    other, resumed = made()
    other.load_state_dict(model.state_dict())
    resumed.load_state_dict(optimizer.state_dict())
    for one, two in ((model, optimizer), (other, resumed)):
        give_gradients(one, 2)
        two.step_rows(torch.arange(12) < 8)
    assert model.digest() == other.digest()


def test_a_step_of_training_updates_what_its_render_shows():
    model, optimizer = made()
    before = model.means.detach().clone()
    give_gradients(model, 1)
    optimizer.step(SimpleNamespace(visible=torch.arange(12) < 4))
    assert (model.means.detach() != before).any(dim=1).tolist() == [True] * 4 + [False] * 8


def test_a_mask_of_another_length_is_refused():
    model, optimizer = made()
    give_gradients(model, 1)
    with pytest.raises(ShapeError, match="rows is"):
        optimizer.step_rows(torch.ones(11, dtype=torch.bool))
