"""The training kernels on a GPU: loss and gradient against the CPU's in float64, Adam against torch.optim.Adam."""

from __future__ import annotations

import pytest
import torch

from splatwizard_core.training.losses import photometric_loss
from splatwizard_native import AdamUpdate, adam_steps, ssim_map
from splatwizard_native.fused.native import TRAINING

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
    pytest.mark.skipif(TRAINING.available(cuda=True) is not None, reason=str(TRAINING.available(cuda=True))),
]


def pictures(*shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    x = torch.rand(*shape, generator=generator)
    return x, (x + 0.1 * torch.randn(*shape, generator=generator)).clamp(0, 1)


@pytest.mark.parametrize("padding", ["same", "valid"])
@pytest.mark.parametrize("shape", [(3, 97, 130), (1, 11, 11), (3, 32, 64), (2, 33, 31), (3, 300, 5)])
def test_loss_and_gradient_are_those_of_torch_in_float64(shape, padding):
    if padding == "valid" and min(shape[1:]) < 11:
        pytest.skip("the window does not fit")
    x, y = pictures(*shape)
    double = x.double().requires_grad_()
    l1 = (double - y.double()).abs().mean()
    similarity = ssim_map(double, y.double(), padding).mean()
    expected = 0.8 * l1 + 0.2 * (1 - similarity)
    (3.0 * expected).backward()
    assert TRAINING.has_cuda()
    image = x.cuda().requires_grad_()
    loss = photometric_loss(image, y.cuda(), padding=padding)
    (3.0 * loss.total).backward()
    torch.testing.assert_close(loss.total.item(), expected.item(), rtol=2e-6, atol=1e-7)
    torch.testing.assert_close(loss.parts["l1"].item(), l1.item(), rtol=2e-6, atol=1e-7)
    torch.testing.assert_close(loss.parts["ssim"].item(), similarity.item(), rtol=2e-6, atol=2e-6)
    assert image.grad is not None
    assert double.grad is not None
    error = (image.grad.cpu().double() - double.grad).norm() / double.grad.norm()
    assert float(error) < 1e-5


def test_similarity_alone_and_without_gradient():
    x, y = pictures(3, 70, 50)
    similarity = float(photometric_loss(x.cuda(), y.cuda()).parts["ssim"])
    assert abs(similarity - float(ssim_map(x.double(), y.double()).mean())) < 2e-6
    assert float(photometric_loss(x.cuda(), x.cuda()).parts["ssim"]) == pytest.approx(1.0, abs=1e-5)


def test_a_nan_reaches_the_loss():
    x, y = pictures(3, 40, 40)
    x[1, 20, 20] = float("nan")
    assert photometric_loss(x.cuda(), y.cuda()).total.isnan()


def test_fifty_steps_of_many_tensors_equal_torchs():
    generator = torch.Generator().manual_seed(1)
    shapes = [(1,), (17, 33), (2048,), (2049,), (700, 15, 3), (0, 3), *[(5, 3)] * 30]
    params = [torch.randn(*s, generator=generator).cuda() for s in shapes]
    moments = [(torch.zeros_like(p), torch.zeros_like(p)) for p in params]
    theirs = [torch.nn.Parameter(p.clone()) for p in params]
    optimizer = torch.optim.Adam(theirs, lr=0.01, betas=(0.9, 0.999), eps=1e-15)
    for step in range(1, 51):
        grads = [torch.randn(*s, generator=generator).cuda() * (torch.rand(*s, generator=generator) > 0.2).cuda()
                 for s in shapes]  # fmt: skip
        for p, g in zip(theirs, grads, strict=True):
            p.grad = g.clone()
        optimizer.step()
        adam_steps([AdamUpdate(p, g, m, v, 0.01, 0.9, 0.999, 1e-15, step)
                    for p, g, (m, v) in zip(params, grads, moments, strict=True)])  # fmt: skip
    for p, t in zip(params, theirs, strict=True):
        torch.testing.assert_close(p, t.detach(), rtol=1e-6, atol=1e-6)


def test_rows_that_never_had_a_gradient_stay():
    param = torch.randn(5000, device="cuda")
    before, zeros = param.clone(), torch.zeros(5000, device="cuda")
    adam_steps([AdamUpdate(param, zeros.clone(), zeros.clone(), zeros.clone(), 0.1, 0.9, 0.999, 1e-15, 1)])
    assert torch.equal(param, before)
