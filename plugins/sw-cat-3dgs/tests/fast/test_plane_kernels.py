"""The CUDA kernels of learned planes against torch operations."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from splatwizard_core.base.random_states import seeded
from sw_cat_3dgs.fast import plane_bits, plane_kernels, plane_sites
from sw_cat_3dgs.fast.plane_kernels import fit_kernels
from sw_cat_3dgs.spatial_ar import SpatialAr
from sw_cat_3dgs.triplane import Triplane
from sw_codecs.native import CODECS

ON_CUDA = CODECS.available(cuda=True)
needs_gpu = pytest.mark.skipif(ON_CUDA is not None, reason=str(ON_CUDA))


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def close(found, expected, tolerance=1e-4):
    """Within a share of the largest number: sums of thousands of products."""
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, rtol=tolerance, atol=tolerance * float(other.abs().max()) + 1e-7)


def test_there_are_no_kernels_on_a_cpu():
    assert not fit_kernels([torch.zeros(3, 2, 4, 4)])
    assert not fit_kernels([])


def test_there_are_none_for_planes_of_more_cells_than_a_grid_has_rows_for(monkeypatch):
    monkeypatch.setattr(plane_kernels, "CODECS", SimpleNamespace(has_cuda=lambda: True))

    def on_cuda(height, width):
        shape = (3, 1, height, width)
        return SimpleNamespace(is_cuda=True, dtype=torch.float32, shape=shape, numel=lambda: 3 * height * width)

    assert fit_kernels([on_cuda(65_535, 32)])
    assert not fit_kernels([on_cuda(1, 1), on_cuda(65_535, 33)])


@pytest.mark.parametrize(("capability", "taken"), [((7, 5), False), ((8, 0), True), ((12, 0), True)])
def test_bits_of_planes_are_taken_by_the_kernel_where_there_are_tensor_cores_for_it(capability, taken, monkeypatch):
    networks, plane = [SpatialAr(generator())], torch.ones(1, 2, 3, 4)
    expected = plane_bits.plane_bits(networks, [plane])
    monkeypatch.setattr(plane_kernels, "fit_kernels", lambda _: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda _: capability)
    monkeypatch.setattr(plane_kernels, "plane_bits", lambda *_, planes_learn: (torch.full((1, 1060), -1.0), []))
    torch.testing.assert_close(plane_bits.plane_bits(networks, [plane]), torch.tensor(-1.0) if taken else expected)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize(
    ("orientations", "channels", "sizes", "spread"),
    [
        (3, 72, ((9, 9), (18, 18)), 1.0),
        (3, 5, ((61, 61), (122, 122)), 4.0),
        (2, 3, ((7, 13),), 40.0),  # far from every mean: probabilities at their floor
        (1, 1, ((1, 1),), 1.0),
        (3, 1, ((1, 3), (2, 1), (128, 1), (1, 129)), 2.0),
        (2, 2, ((5, 7), (33, 31), (2, 2)), 3.0),  # no multiples of a warp
    ],
)
@pytest.mark.parametrize("planes_learn", [True, False])
def test_bits_of_planes_are_those_of_torch(orientations, channels, sizes, spread, planes_learn, monkeypatch):
    draw = generator()
    networks = torch.nn.ModuleList(SpatialAr(draw) for _ in range(orientations))
    with torch.no_grad():
        for parameter in networks.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=draw))
    networks = networks.to("cuda")
    planes = [spread * torch.randn(orientations, channels, *size, generator=draw).to("cuda") for size in sizes]
    planes = [plane.requires_grad_(planes_learn) for plane in planes]
    leaves = [*networks.parameters(), *(planes if planes_learn else [])]
    found = []
    for kernel in (True, False):
        if not kernel:
            monkeypatch.setattr(plane_kernels, "fit_kernels", lambda _: False)
        bits = plane_bits.plane_bits(list(networks), planes)
        found.append((bits.detach(), *torch.autograd.grad(2 * bits, leaves)))
    close(*found)
    assert all(each.data_ptr() % 16 == 0 for each in found[0][1:] if each.numel())  # as the optimizer's kernel asks


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize(
    ("count", "resolution", "channels", "multiples", "repeats"),
    [
        (5000, 20, 72, (1, 2), 1),
        (3001, 9, 8, (1, 2, 4), 5),
        (77, 7, 5, (1,), 3),
        (1, 1, 4, (1, 2), 1),
        (0, 3, 8, (1, 2), 1),
    ],
)
@pytest.mark.parametrize("rounded", [True, False])
def test_a_triplane_and_its_gradients_are_those_of_torch(count, resolution, channels, multiples, repeats, rounded):
    draw = generator(1)
    planes = Triplane(resolution, channels, multiples, generator=draw)
    with torch.no_grad():
        for plane in planes.planes:
            plane.normal_(generator=draw)
    places = torch.randint(0, (1 << 20) + 1, (count, 3), generator=draw).repeat_interleave(repeats, dim=0)
    slopes = torch.randn(len(places), planes.width, generator=draw)
    slopes[count // 3 : count // 3 + 2] = 0  # rows beyond the count of a step have none
    planes, slopes, places = planes.to("cuda"), slopes.to("cuda"), places.to("cuda")
    assert plane_sites.fits(planes)
    found = []
    for look_up in (plane_sites.look_up, Triplane.forward):
        features = look_up(planes, places, rounded=rounded)
        found.append((features.detach(), *torch.autograd.grad((features * slopes).sum(), list(planes.planes))))
    close(*found) if count else None
    assert found[0][0].shape == found[1][0].shape


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("sizes", [(16, 32), (7, 13), (1, 2), (130,)])
def test_where_it_is_asked_for_sums_are_the_same_each_time_and_those_of_the_fast_kernels(sizes):
    draw = torch.Generator().manual_seed(3)
    networks = [SpatialAr(draw).to("cuda") for _ in range(3)]
    planes = [(torch.randn(3, 5, n, n + 1, generator=draw) * 3).to("cuda").requires_grad_() for n in sizes]
    made = Triplane(32, 12, (1, 2), generator=draw)
    places = torch.randint(0, 1 << 16, (20_000, 3), generator=draw)
    slopes = torch.randn(len(places), made.width, generator=draw).to("cuda")
    made = made.to("cuda")
    sites = plane_sites.sites_of(list(made.planes), places.to("cuda"))

    def slopes_of():
        bits = plane_bits.plane_bits(networks, planes)
        learning = [*planes, *(p for network in networks for p in network.parameters())]
        features = (plane_sites.sample(list(made.planes), sites, rounded=True) * slopes).sum()
        by_planes = torch.autograd.grad(features, list(made.planes))
        return [bits.detach(), *torch.autograd.grad(bits, learning), *by_planes]

    assert fit_kernels(planes)
    fast = slopes_of()
    with seeded(0, deterministic=True):
        first, *others = (slopes_of() for _ in range(4))
    for i, (own, atomic) in enumerate(zip(first, fast, strict=True)):
        assert all(torch.equal(own, other[i]) for other in others), i
        torch.testing.assert_close(own, atomic, rtol=1e-4, atol=1e-5 * float(atomic.abs().max()))


@pytest.mark.cuda
@needs_gpu
def test_planes_without_values_have_no_bits():
    networks, plane = [SpatialAr().to("cuda") for _ in range(3)], torch.zeros(3, 4, 0, 0, device="cuda")
    bits = plane_bits.plane_bits(networks, [plane])
    (slope,) = torch.autograd.grad(bits, networks[0].layers[0].weight)
    assert float(bits) == 0
    assert not bool(slope.any())


@pytest.mark.cuda
@needs_gpu
def test_lists_that_lack_a_scale_are_refused():
    cells, weights = torch.zeros(5, 2, 3, 4, dtype=torch.int32, device="cuda"), torch.zeros(5, 2, 3, 4, device="cuda")
    planes = [torch.zeros(3, 4, n, n, device="cuda") for n in (2, 3)]
    with pytest.raises(RuntimeError, match="planes of 2 sizes and 4 channels do not fit"):
        plane_kernels.sampled(cells, weights, planes[:1], 0.0)
    with pytest.raises(RuntimeError, match="a tensor of scale 1 is missing"):
        plane_kernels.sampled_backward(cells, weights, torch.zeros(5, 24, device="cuda"), planes[:1])
