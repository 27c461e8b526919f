"""The activations of Gaussians: those of torch, on every path."""

import pytest
import torch

from splatwizard_native import activated

CUDA = pytest.param(
    "cuda", marks=[pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")]
)


def leaves(device: str, *, count: int = 1000, dtype=torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(count)
    log_scales = 3 * torch.randn(count, 3, generator=generator, dtype=dtype) - 4
    logits = 6 * torch.randn(count, generator=generator, dtype=dtype)
    return log_scales.to(device).requires_grad_(), logits.to(device).requires_grad_()


@pytest.mark.parametrize("device", ["cpu", CUDA])
@pytest.mark.parametrize("count", [0, 1, 85, 100_003])
def test_values_and_gradients_are_torchs(device, count):
    ours, theirs = leaves(device, count=count), leaves(device, count=count)
    found, expected = activated(*ours), (theirs[0].exp(), theirs[1].sigmoid())
    for outputs in (found, expected):
        sum((x * x).sum() for x in outputs).backward()
    if device == "cuda":
        assert found[0].grad_fn is found[1].grad_fn  # one node made both
    for ours_x, theirs_x in (
        *zip(found, expected, strict=True),
        *((a.grad, b.grad) for a, b in zip(ours, theirs, strict=True)),
    ):
        torch.testing.assert_close(ours_x, theirs_x, rtol=3e-7, atol=0)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_each_gradient_can_be_asked_for_alone(device):
    log_scales, logits = leaves(device)
    scales, opacities = activated(log_scales, logits)
    assert torch.equal(torch.autograd.grad(scales.sum(), log_scales)[0], scales.detach())
    scales, opacities = activated(log_scales, logits.detach())
    (scales.sum() + opacities.sum()).backward()
    assert torch.equal(log_scales.grad, scales.detach())
    log_scales, logits = leaves(device)
    (opacities,) = activated(log_scales.detach(), logits)[1:]
    opacities.sum().backward()
    torch.testing.assert_close(logits.grad, (opacities * (1 - opacities)).detach(), rtol=3e-7, atol=0)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_other_types_and_places_are_torchs(device):
    log_scales, logits = leaves(device, dtype=torch.float64)
    assert activated(log_scales, logits)[0].dtype == torch.float64
    flat, whole = leaves(device)[0].detach().T, leaves(device)[1].detach()[::2]
    scales, opacities = activated(flat, whole)
    torch.testing.assert_close(scales, flat.exp(), rtol=3e-7, atol=0)
    torch.testing.assert_close(opacities, whole.sigmoid(), rtol=3e-7, atol=0)


@pytest.mark.parametrize("device", ["cpu", CUDA])
def test_second_derivatives_are_torchs(device):
    ours, theirs = leaves(device), leaves(device)
    for given, (scales, opacities) in ((ours, activated(*ours)), (theirs, (theirs[0].exp(), theirs[1].sigmoid()))):
        slopes = torch.autograd.grad(scales.sum() + opacities.square().sum(), given, create_graph=True)
        sum(slope.square().sum() for slope in slopes).backward()
    for a, b in zip(ours, theirs, strict=True):
        torch.testing.assert_close(a.grad, b.grad, rtol=1e-5, atol=1e-9)


@pytest.mark.cuda
@pytest.mark.skipif(torch.cuda.device_count() < 2, reason="no two GPUs")
@pytest.mark.parametrize("current", [0, 1])
def test_the_work_is_done_where_the_tensors_are_and_the_current_gpu_stays(current):
    with torch.cuda.device(current):
        for own in (0, 1, 0):
            log_scales, logits = leaves(f"cuda:{own}")
            scales, opacities = activated(log_scales, logits)
            (scales.sum() + opacities.sum()).backward()
            torch.testing.assert_close(log_scales.grad, log_scales.detach().exp(), rtol=3e-7, atol=0)
            assert torch.cuda.current_device() == current
            assert torch.zeros(1, device="cuda").get_device() == current
        with pytest.raises(RuntimeError, match=r"on the GPU, got .* on cuda:1"):
            activated(leaves("cuda:0")[0], leaves("cuda:1")[1])
