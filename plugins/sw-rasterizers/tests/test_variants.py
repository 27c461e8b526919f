"""The named variants of the standard kernels: accel, depth, c3dgs."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, applies, check_against, check_gradients, run
from sw_reference.testing.raster_scenes import RasterCase, cast_inputs, draw_scene
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_core.api import SH, CapabilityError, Feature, RasterOptions, ShapeError
from splatwizard_core.tooling import NegotiatedRasterizer, load_plugins
from sw_rasterizers.native import MODULE, unavailable_on_cuda
from sw_rasterizers.segments import Segments, Tables
from sw_rasterizers.variants import AccelRasterizer, DepthRasterizer, IndexedRasterizer

needs_kernels = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
VARIANTS = [AccelRasterizer, DepthRasterizer, IndexedRasterizer]
DEVICES = [
    pytest.param("cpu", marks=needs_kernels),
    pytest.param(
        "cuda",
        marks=[
            pytest.mark.cuda,
            pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"),
            pytest.mark.skipif(unavailable_on_cuda() is not None, reason=str(unavailable_on_cuda())),
        ],
    ),
]
BOOKS = RasterCase("books", n=300, width=40, height=30, color="indexed", geometry="indexed", degree=2, active_degree=2)


def pairs(of):
    return [
        pytest.param(c, x, id=f"{c.info.name}-{x.name if hasattr(x, 'name') else x}") for c in VARIANTS for x in of(c)
    ]


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("variant", "check"), pairs(lambda c: checks_for(c.info)))
def test_facts_of_every_rasterizer(variant, check, device):
    if device == "cuda" and check not in checks_for(variant.info.on("cuda")):
        pytest.skip("not on CUDA")
    check(variant(), device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("variant", "case"), pairs(lambda c: [k for k in GRADIENT_CASES if applies(k, c.info)]))
def test_values_and_gradients_are_those_of_the_reference(variant, case, device):
    check_against(variant(), ReferenceRasterizer(), case, 1, device)


@needs_kernels
def test_codebook_gradients_are_the_derivatives():
    """Rows, scale factors and quaternions, by finite differences in float64."""
    case = next(c for c in GRADIENT_CASES if c.name == "indexed")
    check_gradients(IndexedRasterizer(), case)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dc", [False, True], ids=["codebook", "dc-and-codebook"])
def test_many_users_of_few_rows_get_the_gradients_of_the_reference(dc, device):
    g, cam = draw_scene(BOOKS, 5, torch.float64)
    if dc:
        book = g.sh.codebook
        g.sh = SH(
            dc=book[g.sh.indices][:, :1].clone(), codebook=book[:, 1:].clone(), indices=g.sh.indices, active_degree=2
        )
    _, wanted = run(ReferenceRasterizer(), g, cam, RasterOptions())
    _, found = run(IndexedRasterizer(), cast_inputs(g, torch.float32, device), cam, RasterOptions())
    assert {"scales", "quats", "scale_factors", "sh.codebook"} <= set(found)
    for name, gradient in found.items():
        error = float((gradient.cpu().double() - wanted[name]).norm() / wanted[name].norm().clamp(min=1e-30))
        assert error <= 1e-3, f"gradient of {name}: relative error {error:.3g}"


@pytest.mark.parametrize("device", DEVICES)
def test_the_sensitivity_pass_adds_up_magnitudes_per_view(device):
    """|d sum(image)| of colours and covariances, per view, without the colour clamp (C3DGS, section 4.1)."""
    case = replace(BOOKS, color="split", geometry="cov3d", options={"clamp_color": False}, sh_scale=1.0)
    sums = []
    for rasterizer, dtype, where in (
        (IndexedRasterizer(), torch.float32, device), (ReferenceRasterizer(), torch.float64, "cpu")
    ):  # fmt: skip
        total = None
        for seed in (1, 2):  # two cameras, one set of Gaussians
            g, _ = draw_scene(case, 1, torch.float64)
            _, cam = draw_scene(case, seed, torch.float64)
            g = cast_inputs(g, dtype, where)
            leaves = [g.sh.dc.requires_grad_(), g.sh.rest.requires_grad_(), g.cov3d.requires_grad_()]
            image = rasterizer.render(g, cam.to(where, dtype), RasterOptions(clamp_color=False)).image
            grads = torch.autograd.grad(image.sum(), leaves)
            found = [x.abs().double().cpu() for x in grads]
            total = found if total is None else [a + b for a, b in zip(total, found, strict=True)]
        sums.append(total)
    for actual, expected in zip(*sums, strict=True):
        assert float((actual - expected).norm() / expected.norm()) <= 1e-3
        assert float(expected.norm()) > 0


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=[pytest.mark.cuda, DEVICES[1].marks[1]])]
)  # fmt: skip
def test_sums_over_equal_indices_are_those_of_a_loop_and_repeat_to_the_bit(device):
    generator = torch.Generator().manual_seed(2)
    indices = torch.randint(0, 7, (5000,), generator=generator)
    indices[indices == 3] = 4  # one row that nobody asks for
    values = torch.randn(5000, 4, 3, generator=generator)
    expected = torch.zeros(7, 4, 3, dtype=torch.float64)
    for i, row in enumerate(indices.tolist()):
        expected[row] += values[i].double()
    segments = Segments(indices.to(device), 7)
    sums = [segments.sum(values.to(device)).cpu() for _ in range(3)]
    torch.testing.assert_close(sums[0].double(), expected, rtol=1e-5, atol=1e-3)  # float32 sums of 800 values
    assert torch.equal(sums[0], sums[1])
    assert torch.equal(sums[0], sums[2])
    assert not sums[0][3].any()


def test_changed_indices_are_sorted_again():
    table = torch.arange(3.0)[:, None].requires_grad_()
    indices, lookup = torch.tensor([0, 0, 1]), Tables().lookup
    lookup(table, indices).sum().backward()
    assert table.grad.flatten().tolist() == [2, 1, 0]
    table.grad = None
    indices[0] = 2
    lookup(table, indices).sum().backward()
    assert table.grad.flatten().tolist() == [1, 1, 1]


def test_no_user_leaves_a_gradient_of_zeros():
    table = torch.ones(3, 2, requires_grad=True)
    Tables().lookup(table, torch.zeros(0, dtype=torch.int64)).sum().backward()
    assert torch.equal(table.grad, torch.zeros(3, 2))


def test_an_index_outside_the_codebook_is_refused_by_number():
    with pytest.raises(ShapeError, match="from -1 to 4, the codebook has 4 rows"):
        Tables().lookup(torch.zeros(4, 2), torch.tensor([0, 4, -1]))


@needs_kernels
def test_the_inputs_come_back_as_they_were():
    g, cam = draw_scene(BOOKS, 5, torch.float32)
    result = IndexedRasterizer().render(g, cam, RasterOptions())
    assert result.inputs is g
    assert torch.equal(IndexedRasterizer().visible_filter(g, cam) > 0, result.radii > 0)


@needs_kernels
def test_what_a_variant_does_not_declare_is_refused():
    g, cam = draw_scene(RasterCase(), 1, torch.float32)
    with pytest.raises(CapabilityError, match=r"'accel' does not offer DEPTH_MEDIAN"):
        AccelRasterizer().render(g, cam, RasterOptions(depth=frozenset({"median"})))


@needs_kernels
@pytest.mark.parametrize(
    ("prefer", "case", "options", "served"),
    [
        (["accel"], {"color": "split"}, RasterOptions(), "accel"),
        (["depth"], {}, RasterOptions(depth=frozenset({"inverse", "median"}), antialias=True), "depth"),
        ([], {"color": "indexed", "geometry": "indexed"}, RasterOptions(), "c3dgs"),
        ([], {"color": "indexed", "geometry": "indexed"}, RasterOptions(clamp_color=False), "c3dgs"),
        (["c3dgs"], {"geometry": "cov3d", "color": "colors"}, RasterOptions(), "c3dgs"),
        ([], {}, RasterOptions(), "standard"),
    ],
)
def test_they_are_found_by_name_and_codebooks_by_what_is_asked(prefer, case, options, served):
    g, _ = draw_scene(replace(RasterCase(), **case), 1, torch.float32)
    chosen = NegotiatedRasterizer(load_plugins(), device="cpu", prefer=prefer)
    asked = Feature.asked_by(options, g).names
    assert chosen.select(asked).info.name == served
    assert asked <= chosen.select(asked).info.features
