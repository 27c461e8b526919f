"""Colours from a codebook are those of gathered coefficients, with their gradients, and nobody gets coefficients."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.spherical_harmonics import sh_colors
from sw_reference.testing.raster_scenes import RasterCase, draw_scene
from torch.utils._python_dispatch import TorchDispatchMode

from splatwizard_core.api import SH, RasterOptions
from sw_rasterizers.native import MODULE, unavailable_on_cuda
from sw_rasterizers.segments import Segments
from sw_rasterizers.shared_colors import shared_colors
from sw_rasterizers.variants import IndexedRasterizer

needs_kernels = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
ON_CPU = pytest.param("cpu", marks=needs_kernels)
DEVICES = [
    ON_CPU,
    pytest.param("cuda", marks=[
        pytest.mark.cuda, pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda()))
    ]),
]  # fmt: skip
N, M = 500, 9


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


def on(device, leaves, sh, means, center):
    """The same on another device, in float32 where that is a GPU."""
    if device == "cpu":
        return leaves, sh, means, center
    book, means, *dc = [x.detach().to(device, torch.float32).requires_grad_(True) for x in leaves]
    moved = SH(codebook=book, dc=dc[0] if dc else None, indices=sh.indices.to(device), active_degree=sh.active_degree)
    return [book, means, *dc], moved, means, center.to(device, torch.float32)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("degree", "stored", "with_dc"),
    [
        (0, 0, False),
        (1, 1, False),
        (2, 2, False),
        (3, 3, False),
        (1, 3, False),
        (0, 1, True),
        (1, 1, True),
        (2, 3, True),
        (3, 3, True),
    ],
)
@pytest.mark.parametrize("clamp", [True, False])
def test_values_and_gradients_are_those_of_gathered_coefficients(device, degree, stored, with_dc, clamp):
    leaves, sh, means, center = inputs(degree, stored=stored, with_dc=with_dc)
    weights = torch.randn(N, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)
    expected = sh_colors(sh, center, means, clamp=clamp)
    wanted = torch.autograd.grad((expected * weights).sum(), leaves, allow_unused=True)
    own_leaves, own_sh, own_means, own_center = on(device, leaves, sh, means, center)
    found = shared_colors(own_sh, Segments(own_sh.indices, M), own_means, own_center, clamp=clamp)
    atol = 1e-12 if device == "cpu" else 1e-4
    torch.testing.assert_close(found.double().cpu(), expected, rtol=atol, atol=atol)
    assert bool((expected == 0).any()) == clamp  # the clamp acts
    gradients = torch.autograd.grad((found * weights.to(found)).sum(), own_leaves)
    for gradient, right in zip(gradients, wanted, strict=True):
        own = gradient.double().cpu()
        aim = torch.zeros_like(own) if right is None else right
        if device == "cpu":
            torch.testing.assert_close(own, aim, rtol=1e-10, atol=1e-12)
        else:  # relative: a colour that is nearly 0 may be clamped on one device alone
            assert float((own - aim).norm()) <= 1e-3 * float(aim.norm())
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


@pytest.mark.parametrize("device", DEVICES)
def test_a_mean_in_the_camera_that_nobody_sees_spoils_no_gradient(device):
    leaves, sh, means, center = on(device, *inputs(2))
    with torch.no_grad():
        means[7] = center
    colors = shared_colors(sh, Segments(sh.indices, M), means, center, clamp=True)
    seen = torch.ones(N, 1).to(colors)
    seen[7] = 0
    gradients = torch.autograd.grad(colors, leaves, seen.expand(N, 3).contiguous())
    assert all(bool(torch.isfinite(each).all()) for each in gradients)
    assert not gradients[1][7].any()


@pytest.mark.parametrize("device", DEVICES)
def test_no_gaussians_and_no_gradient(device):
    leaves, sh, means, center = on(device, *inputs(3, n=0))
    found = shared_colors(sh, Segments(sh.indices, M), means, center, clamp=True)
    assert found.shape == (0, 3)
    assert not torch.autograd.grad(found.sum(), leaves)[0].any()


class Largest(TorchDispatchMode):
    """Watches the largest tensor that an operation makes."""

    bytes = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        for each in made if isinstance(made, (tuple, list)) else [made]:
            if isinstance(each, torch.Tensor):
                self.bytes = max(self.bytes, each.nbytes)
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
        sizes.append(watched.bytes)
    assert sizes[0] < 3000 * 48 * 4 <= sizes[1]


@pytest.mark.cuda
@pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda()))
@pytest.mark.parametrize("rows", [1, M, 5000])
def test_the_kernels_on_cuda_repeat_to_the_bit_and_agree_with_the_cpu(rows):
    """Entries with all users, with many runs of users, with a few of one run."""
    leaves, sh, means, center = inputs(3, dtype=torch.float32, n=20_011)
    g = torch.Generator().manual_seed(rows)
    book = torch.randn(rows, 16, 3, generator=g).requires_grad_(True)
    sh = SH(codebook=book, indices=torch.randint(rows, (len(means),), generator=g), active_degree=3)
    leaves[0] = book
    here = shared_colors(sh, Segments(sh.indices, rows), means, center, clamp=True)
    wanted = [here, *torch.autograd.grad(here.square().sum(), leaves)]
    there, on_gpu, its_means, its_center = on("cuda", leaves, sh, means, center)
    runs = []
    for _ in range(2):
        colors = shared_colors(on_gpu, Segments(on_gpu.indices, rows), its_means, its_center, clamp=True)
        runs.append([colors, *torch.autograd.grad(colors.square().sum(), there)])
    for a, b, right in zip(*runs, wanted, strict=True):
        assert torch.equal(a, b)
        assert float((a.cpu() - right).norm()) <= 1e-3 * float(right.norm())
