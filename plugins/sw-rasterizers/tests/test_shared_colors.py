"""Colours from a codebook are those of gathered coefficients, with their gradients, and nobody gets coefficients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.spherical_harmonics import sh_colors
from sw_reference.testing.raster_scenes import RasterCase, draw_scene
from torch.utils._python_dispatch import TorchDispatchMode

from splatwizard_core.api import SH, RasterOptions
from sw_rasterizers import shared_colors as module
from sw_rasterizers.native import MODULE, unavailable_on_cuda
from sw_rasterizers.segments import Segments
from sw_rasterizers.shared_colors import shared_colors
from sw_rasterizers.variants import IndexedRasterizer

needs_kernels = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
WAYS = [pytest.param("kernel", marks=needs_kernels), "blocks"]
N, M = 500, 9


@pytest.fixture
def shade(request, monkeypatch):
    """The kernel of the CPU, or on the CPU too what other devices do, in blocks of 64."""
    if request.param == "blocks":
        monkeypatch.setattr(module, "BLOCK", 64)
        monkeypatch.setattr(module, "_OnCpu", module._InBlocks)
    return shared_colors


def inputs(degree, *, stored=None, with_dc=False, dtype=torch.float64, n=N):
    g = torch.Generator().manual_seed(degree)
    k = ((degree if stored is None else stored) + 1) ** 2
    means = torch.randn(n, 3, generator=g, dtype=dtype)
    book = 2 * torch.randn(M, k - with_dc, 3, generator=g, dtype=dtype)
    dc = 2 * torch.randn(n, 1, 3, generator=g, dtype=dtype) if with_dc else None
    indices = torch.randint(M, (n,), generator=g)
    indices[indices == 4] = 5  # an entry that nobody uses
    leaves = [book.requires_grad_(True), means.requires_grad_(True), *([dc.requires_grad_(True)] if with_dc else [])]
    center = torch.tensor([0.3, -4.0, 0.2], dtype=dtype)
    return leaves, SH(codebook=book, dc=dc, indices=indices, active_degree=degree), means, center


@pytest.mark.parametrize("shade", WAYS, indirect=True)
@pytest.mark.parametrize(
    ("degree", "stored", "with_dc"),
    [
        (0, 0, False),
        (1, 1, False),
        (2, 2, False),
        (3, 3, False),
        (1, 3, False),
        (1, 1, True),
        (2, 3, True),
        (3, 3, True),
    ],
)
@pytest.mark.parametrize("clamp", [True, False])
def test_values_and_gradients_are_those_of_gathered_coefficients(shade, degree, stored, with_dc, clamp):
    leaves, sh, means, center = inputs(degree, stored=stored, with_dc=with_dc)
    weights = torch.randn(N, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    expected = sh_colors(sh, center, means, clamp=clamp)
    found = shade(sh, Segments(sh.indices, M), means, center, clamp=clamp)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)
    assert bool((expected == 0).any()) == clamp  # the clamp acts
    wanted = torch.autograd.grad((expected * weights).sum(), leaves, allow_unused=True)
    gradients = torch.autograd.grad((found * weights).sum(), leaves)
    for gradient, right in zip(gradients, wanted, strict=True):
        torch.testing.assert_close(
            gradient, torch.zeros_like(gradient) if right is None else right, rtol=1e-10, atol=1e-12
        )
    assert not gradients[0][4].any()


@needs_kernels
def test_the_kernel_in_float32_agrees_and_repeats_to_the_bit_with_any_number_of_threads():
    leaves, sh, means, center = inputs(3, dtype=torch.float32, n=20_000)
    exact = sh_colors(
        SH(codebook=sh.codebook.double(), indices=sh.indices, active_degree=3), center.double(), means.double()
    )
    results, threads = [], torch.get_num_threads()
    for count in (1, 2, 1):
        torch.set_num_threads(count)
        colors = shared_colors(sh, Segments(sh.indices, M), means, center, clamp=True)
        results.append([colors.detach(), *torch.autograd.grad(colors.square().sum(), leaves)])
    torch.set_num_threads(threads)
    torch.testing.assert_close(results[0][0].double(), exact.detach(), rtol=1e-5, atol=1e-5)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("shade", WAYS, indirect=True)
def test_a_mean_in_the_camera_that_nobody_sees_spoils_no_gradient(shade):
    leaves, sh, means, center = inputs(2)
    with torch.no_grad():
        means[7] = center
    colors = shade(sh, Segments(sh.indices, M), means, center, clamp=True)
    seen = torch.ones(N, 1, dtype=torch.float64)
    seen[7] = 0
    gradients = torch.autograd.grad(colors, leaves, seen.expand(N, 3).contiguous())
    assert all(bool(torch.isfinite(each).all()) for each in gradients)
    assert not gradients[1][7].any()


@pytest.mark.parametrize("shade", WAYS, indirect=True)
def test_no_gaussians_and_no_gradient(shade):
    leaves, sh, means, center = inputs(3, n=0)
    found = shade(sh, Segments(sh.indices, M), means, center, clamp=True)
    assert found.shape == (0, 3)
    assert not torch.autograd.grad(found.sum(), leaves)[0].any()


class Largest(TorchDispatchMode):
    """Watches the largest tensor that an operation makes."""

    numel = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for each in made if isinstance(made, (tuple, list)) else [made]:
            if isinstance(each, torch.Tensor):
                self.numel = max(self.numel, each.numel())
        return made


@needs_kernels
def test_a_render_and_its_gradient_make_no_coefficients_of_each_gaussian():
    case = RasterCase("many", n=3000, width=32, height=24, color="indexed", geometry="indexed", degree=3,
                      active_degree=3)  # fmt: skip
    g, cam = draw_scene(case, 1, torch.float32)
    g = replace(g, sh=replace(g.sh, codebook=g.sh.codebook.detach().requires_grad_(True)))
    sizes = []
    for drawn in (g, g.gathered()):
        with Largest() as watched:
            image = IndexedRasterizer().render(drawn, cam, RasterOptions()).image
            torch.autograd.grad(image.sum(), g.sh.codebook)
        sizes.append(watched.numel)
    assert sizes[0] < 3000 * 48 <= sizes[1]


@pytest.mark.cuda
@pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda()))
def test_blocks_on_cuda_repeat_to_the_bit_and_agree_with_the_cpu(monkeypatch):
    monkeypatch.setattr(module, "BLOCK", 4096)
    leaves, sh, means, center = inputs(3, dtype=torch.float32, n=20_000)
    here = shared_colors(sh, Segments(sh.indices, M), means, center, clamp=True)
    wanted = [here, *torch.autograd.grad(here.square().sum(), leaves)]
    there = [each.detach().cuda().requires_grad_(True) for each in leaves]
    on_gpu = SH(codebook=there[0], indices=sh.indices.cuda(), active_degree=3)
    runs = []
    for _ in range(2):
        colors = shared_colors(on_gpu, Segments(on_gpu.indices, M), there[1], center.cuda(), clamp=True)
        runs.append([colors, *torch.autograd.grad(colors.square().sum(), there)])
    for a, b, right in zip(*runs, wanted, strict=True):
        assert torch.equal(a, b)
        torch.testing.assert_close(a.cpu(), right, rtol=1e-3, atol=1e-2)
