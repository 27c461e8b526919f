"""Functions of `fast` give the values and gradients of the plain ones; `SW_FAST=0` does without them."""

import pytest
import torch

from sw_cat_3dgs.channel_ar import ChannelAr
from sw_cat_3dgs.fast import plane_bits, plane_sites, slices
from sw_cat_3dgs.principal_frame import UNIT
from sw_cat_3dgs.spatial_ar import SpatialAr
from sw_cat_3dgs.spatial_ar import plane_bits as plain_bits
from sw_cat_3dgs.triplane import Triplane


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def drawn_triplane(resolution, channels, multiples, scale=1.0):
    made = Triplane(resolution, channels, multiples)
    with torch.no_grad():
        for plane in made.planes:
            plane.normal_(0, scale, generator=generator())
    return made


def places(count, seed=1):
    found = torch.randint(0, UNIT + 1, (count, 3), generator=generator(seed))
    return torch.cat([found, torch.tensor([[0, 0, 0], [UNIT] * 3, [UNIT, 0, UNIT - 1]])])


def test_the_environment_can_do_without(monkeypatch):
    made = drawn_triplane(4, 3, (1, 2))
    assert plane_bits.fits(list(made.planes))
    monkeypatch.setenv("SW_FAST", "0")
    assert not plane_bits.fits(list(made.planes))
    assert not plane_sites.fits(made)


@pytest.mark.parametrize("rounded", [True, False])
@pytest.mark.parametrize("multiples", [(1,), (1, 2, 3)])
@pytest.mark.parametrize("resolution", [1, 4])
def test_features_of_a_triplane(resolution, multiples, rounded):
    made = drawn_triplane(resolution, 3, multiples)
    if not plane_sites.fits(made):
        pytest.skip("no compiler")
    weights = torch.randn(33, made.width, generator=generator(2))
    found = [each(made, places(30), rounded=rounded) for each in (plane_sites.look_up, Triplane.forward)]
    torch.testing.assert_close(*found, atol=1e-6, rtol=1e-5)
    gradients = [torch.autograd.grad((each * weights).sum(), list(made.planes)) for each in found]
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("resolution", [1, 2, 5])
def test_sites_of_some_places_are_rows_of_all(resolution):
    made, some = drawn_triplane(resolution, 3, (1, 2)), torch.tensor([22, 3, 20, 21])
    planes = list(made.planes)
    sites = plane_sites.sites_of(planes, places(20))
    of_some = plane_sites.sites_of(planes, places(20)[some])
    assert all(torch.equal(a, b[some]) for a, b in zip(of_some, sites, strict=True))
    # Four places of one plane each, whose weights sum to one: the border needs no others.
    for i, plane in enumerate(planes):
        cells, size = sites.cells[:, i], plane.shape[-1] ** 2
        assert (cells // size == torch.arange(3)[:, None]).all()
    torch.testing.assert_close(sites.weights.sum(dim=3), torch.ones(23, 2, 3))
    assert (sites.weights >= 0).all()


def test_sites_are_kept_until_places_or_resolution_are_others():
    made, given = drawn_triplane(4, 3, (1, 2)), places(5)
    first = plane_sites.kept_sites(made, given)
    assert plane_sites.kept_sites(made, given) is first
    assert plane_sites.kept_sites(made, given.clone()) is not first
    again = plane_sites.kept_sites(made, given)
    made.planes[0] = torch.nn.Parameter(torch.zeros(3, 3, 7, 7))
    assert not torch.equal(plane_sites.kept_sites(made, given).cells, again.cells)


@pytest.mark.parametrize("at_once", [1, 2 * 3 * 72, 1 << 20])
@pytest.mark.parametrize("learn", [True, False])
def test_bits_of_planes(learn, at_once, monkeypatch):
    monkeypatch.setattr(plane_bits, "VALUES_AT_ONCE", at_once)  # one, two and all channels
    g = generator()
    networks = [SpatialAr(g) for _ in range(3)]
    with torch.no_grad():
        for network in networks:
            for parameter in network.parameters():
                parameter.add_(torch.randn(parameter.shape, generator=g) * 0.2)
            network.layers[-1].weight[1] *= 20  # some scales beyond the coder's
    planes = [(torch.randn(3, 3, *size, generator=g) * 4).requires_grad_(learn) for size in ((1, 1), (5, 7), (9, 4))]
    leaves = [*(planes if learn else []), *(p for network in networks for p in network.parameters())]
    found, expected = plane_bits.plane_bits(networks, planes), plain_bits(networks, planes)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)
    for a, b in zip(*(torch.autograd.grad(3 * each, leaves) for each in (found, expected)), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(b.abs().max()))
        assert a.data_ptr() % 16 == 0


def test_a_graph_holds_no_layer_of_the_planes():
    """Only derivatives by planes and parameters: layers of 30 values per anchor were gigabytes."""
    networks, planes = [SpatialAr() for _ in range(3)], [torch.zeros(3, 4, 30, 30, requires_grad=True)]
    kept = []
    with torch.autograd.graph.saved_tensors_hooks(lambda t: kept.append(t.nbytes) or t, lambda t: t):
        plane_bits.plane_bits(networks, planes)
    assert sum(kept) <= planes[0].nbytes + 3 * 4 * 1100


@pytest.mark.parametrize("sizes", [(2, 3, 4), (9,)])
def test_slices(sizes):
    made = ChannelAr(sizes, hidden=6, generator=generator()).double()
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator(1)))
    values, mean, scale = (torch.randn(7, 9, generator=generator(i)).double().requires_grad_() for i in (2, 3, 4))
    leaves, weights = [mean, scale, *made.parameters()], torch.randn(2, 7, 9, generator=generator(5))
    leaves += [values] if len(sizes) > 1 else []
    pairs = []
    for found in (slices.refined(made, values, mean, scale), made(values, mean, scale)):
        pairs.append([*found, *torch.autograd.grad((torch.stack(list(found)) * weights).sum(), leaves)])
    for a, b in zip(*pairs, strict=True):
        torch.testing.assert_close(a, b)


def device_results(device):
    """Values and gradients of fixed inputs there."""
    draw = generator(2)
    made, arms = drawn_triplane(6, 4, (1, 2)), [SpatialAr(draw).to(device) for _ in range(3)]
    model = ChannelAr((2, 3, 4), generator=draw).to(device)
    values = torch.randn(500, 9, generator=draw).to(device)
    noise = [8 * torch.rand(3, 2, n, n, generator=draw).to(device) for n in (5, 9)]
    made = made.to(device)
    outputs = [
        plane_sites.look_up(made, places(500).to(device), rounded=True),
        plane_bits.plane_bits(arms, noise),
        *slices.refined(model, values, values, values),
    ]
    sum((o * o).mean() for o in outputs).backward()
    modules = (made, *arms, model)
    return [t.detach().cpu() for t in (*outputs, *(p.grad for module in modules for p in module.parameters()))]


@pytest.mark.cuda
def test_a_gpu_computes_what_a_cpu_does():
    for a, b in zip(device_results("cpu"), device_results("cuda"), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-4 * float(a.abs().max()))
