"""The same training steps on a GPU: covariances, rate, and a file that a CPU decodes to what the GPU drew."""

import copy

import pytest
import torch
from sw_kit import short_training
from sw_kit.short_training import file_of

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.tooling import NegotiatedRasterizer
from sw_wisp.config import WispConfig
from sw_wisp.method import Wisp
from sw_wisp.rate_model import Placed, StaticRate
from sw_wisp.shape import covariance, jacobi

pytestmark = pytest.mark.cuda


def test_covariances_and_their_gradients_are_those_of_the_cpu():
    draws = torch.Generator().manual_seed(0)
    numbers, weight = torch.randn(5_000, 6, generator=draws), torch.randn(5_000, 6, generator=draws)
    found = []
    for device in ("cpu", "cuda"):
        leaf = numbers.to(device, copy=True).requires_grad_()
        cov = covariance(leaf[:, :5], leaf[:, 5], -9.0, 3.0)
        (cov * weight.to(device)).sum().backward()
        found.append((cov.detach().cpu(), leaf.grad.cpu()))
    for ours, theirs in zip(*found, strict=True):  # covariances reach e^6, their gradients more
        assert float((ours - theirs).norm(dim=1).max()) <= 1e-4 * float(ours.norm(dim=1).max())
        assert torch.allclose(ours, theirs, rtol=1e-2, atol=1e-3 * float(ours.abs().max()))


def test_jacobi_does_not_wait_for_the_device():
    six = torch.randn(100, 6, device="cuda")
    torch.cuda.set_sync_debug_mode("error")
    try:
        jacobi(six)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_measured_tables_are_those_of_the_cpu():
    draws = torch.Generator().manual_seed(0)
    values = torch.randn(4_000, 22, generator=draws)
    levels = torch.randint(5, 12, (4_000,), generator=draws)
    cells = torch.zeros(4_000, 3, dtype=torch.int64)
    rates = [StaticRate(torch.full((22,), 0.3)).to(device) for device in ("cpu", "cuda")]
    for each, device in zip(rates, ("cpu", "cuda"), strict=True):
        each.measure(Placed(values.to(device), levels.to(device), cells.to(device)), (levels.to(device),))
    assert torch.equal(rates[0].row, rates[1].row.cpu())
    assert (rates[0].means - rates[1].means.cpu()).abs().max() <= 16  # sums in another order
    assert (rates[0].tables != rates[1].tables.cpu()).float().mean() < 0.01


def test_cpu_decodes_what_the_gpu_trained(toy):
    plugins = load_plugins()
    values = {"iterations": 60, "scale_schedule": True, "prune.every": 4_000}
    method = Wisp(plugins, apply_overrides(WispConfig(), values, source="test").completed(plugins, {}))
    rasterizer = NegotiatedRasterizer(plugins, device="cuda")
    start = {"3dgs": copy.deepcopy(toy.truth).cuda()}
    model, _ = short_training.train(
        method, toy.scene, rasterizer, model=lambda: None, trained=start.__getitem__
    )  # fmt: skip
    found = Wisp(plugins, None).decode(ContainerReader(file_of(method, model.eval()), "file.swz"))
    camera = toy.scene.test[0].camera
    with torch.no_grad():
        drawn = rasterizer.render(model.gaussians(camera.to("cuda"), rasterizer), camera.to("cuda"), RasterOptions())
        there = NegotiatedRasterizer(plugins, device="cpu")
        again = there.render(found.gaussians(camera, there), camera, RasterOptions()).image
    error = (drawn.image.cpu() - again).square().mean()
    assert -10 * error.log10() > 60
