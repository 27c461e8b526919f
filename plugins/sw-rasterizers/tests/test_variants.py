"""The standard kernels under other names, and with codebooks: c3dgs."""

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
from sw_rasterizers.segments import Tables
from sw_rasterizers.standard import StandardRasterizer
from sw_rasterizers.variants import IndexedRasterizer

needs_kernels = pytest.mark.skipif(MODULE.available() is not None, reason=str(MODULE.available()))
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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("check", checks_for(IndexedRasterizer.info), ids=str)
def test_facts_of_every_rasterizer(check, device):
    if device == "cuda" and check not in checks_for(IndexedRasterizer.info.on("cuda")):
        pytest.skip("not on CUDA")
    check(IndexedRasterizer(), device)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    "case", [k for k in GRADIENT_CASES if applies(k, IndexedRasterizer.info)], ids=lambda k: k.name
)
def test_values_and_gradients_are_those_of_the_reference(case, device):
    check_against(IndexedRasterizer(), ReferenceRasterizer(), case, 1, device)


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


def shared(n=6000, rows=7, **changed):
    """Gaussians whose shapes are rows of a table, with leaves that want gradients."""
    g, cam = draw_scene(RasterCase("shared", n=n, width=40, height=30, geometry="scales"), 3, torch.float32)
    index = torch.randint(rows, (n,), generator=torch.Generator().manual_seed(2))
    index[index == 3] = 4  # a row that nobody asks for
    g.scales, g.quats, g.geom_indices = g.scales[:rows].clone(), g.quats[:rows].clone(), index
    g.scale_factors = torch.linspace(0.5, 2, n)
    g = replace(g, **changed)
    for leaf in (g.scales, g.quats, g.scale_factors):
        if leaf is not None:
            leaf.requires_grad_(True)
    return g, cam


@needs_kernels
@pytest.mark.parametrize("rows", [7, 1500, 6000])
def test_sums_over_shared_shapes_repeat_to_the_bit_with_any_number_of_threads(rows):
    g, cam = shared(rows=rows)
    runs, threads = [], torch.get_num_threads()
    for count in (1, 2, 3, 1):
        torch.set_num_threads(count)
        image = IndexedRasterizer().render(g, cam, RasterOptions()).image
        runs.append(torch.autograd.grad(image.square().sum(), [g.scales, g.quats, g.scale_factors]))
    torch.set_num_threads(threads)
    for other in runs[1:]:
        assert all(torch.equal(a, b) for a, b in zip(runs[0], other, strict=True))
    assert not runs[0][0][3].any()
    assert runs[0][0].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("without", [None, "scale_factors", "geom_indices"])
def test_values_and_gradients_are_those_of_gathered_inputs(device, without):
    g, cam = shared(n=600, rows=600 if without == "geom_indices" else 7, **({without: None} if without else {}))
    g = cast_inputs(g, torch.float32, device)
    leaves = [x.requires_grad_(True) for x in (g.scales, g.quats, g.scale_factors, g.means) if x is not None]
    found, wanted = (
        IndexedRasterizer().render(each, cam.to(device), RasterOptions()).image for each in (g, g.gathered())
    )
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-4)  # the product with a factor may be rounded otherwise
    weights = torch.randn(found.shape, generator=torch.Generator().manual_seed(1)).to(device)
    gradients = [torch.autograd.grad((image * weights).sum(), leaves) for image in (found, wanted)]
    for one, right in zip(*gradients, strict=True):
        assert float((one - right).norm() / right.norm()) <= 1e-3


@needs_kernels
def test_shapes_are_never_gathered(monkeypatch):
    g, cam = shared()
    monkeypatch.setattr(type(g), "gathered", None)
    image = IndexedRasterizer().render(g, cam, RasterOptions()).image
    assert torch.autograd.grad(image.sum(), g.scales)[0].shape == (7, 3)


@needs_kernels
def test_only_the_factors_may_want_a_gradient():
    g, cam = shared()
    image = IndexedRasterizer().render(g, cam, RasterOptions()).image
    (both,) = torch.autograd.grad(image.sum(), g.scale_factors, retain_graph=True)
    g.scales, g.quats = g.scales.detach(), g.quats.detach()
    image = IndexedRasterizer().render(g, cam, RasterOptions()).image
    (alone,) = torch.autograd.grad(image.sum(), g.scale_factors)
    assert torch.equal(alone, both)
    assert alone.any()


@needs_kernels
def test_no_user_leaves_a_gradient_of_zeros():
    g, cam = shared(n=0, geom_indices=torch.zeros(0, dtype=torch.int64), scales=torch.ones(3, 3),
                    quats=torch.ones(3, 4))  # fmt: skip
    image = IndexedRasterizer().render(g, cam, RasterOptions()).image
    gradients = torch.autograd.grad(image.sum(), [g.scales, g.quats])
    assert [list(x.shape) for x in gradients] == [[3, 3], [3, 4]]
    assert not any(bool(x.any()) for x in gradients)


@needs_kernels
def test_an_index_outside_the_table_is_refused_by_number_also_when_it_is_changed_later():
    g, cam = shared(n=20)
    rasterizer = IndexedRasterizer()
    rasterizer.render(g, cam, RasterOptions())
    g.geom_indices[5] = 7
    for act in (
        lambda: rasterizer.render(g, cam, RasterOptions()),
        lambda: rasterizer.visible_filter(g, cam),
    ):
        with pytest.raises(ShapeError, match="to 7, the codebook has 7 rows"):
            act()
    g.geom_indices[5] = -1
    with pytest.raises(ShapeError, match="from -1 to"):
        rasterizer.render(g, cam, RasterOptions())


def test_changed_indices_are_sorted_again():
    tables, indices = Tables(), torch.tensor([0, 0, 1])
    assert tables.segments(indices, 3).offsets.tolist() == [0, 2, 3, 3]
    assert tables.segments(indices, 3) is tables.segments(indices, 3)
    indices[0] = 2
    assert tables.segments(indices, 3).order.tolist() == [1, 2, 0]
    assert tables.segments(indices, 3).offsets.tolist() == [0, 1, 2, 3]


def test_indices_of_another_type_are_refused():
    with pytest.raises(ShapeError, match=r"must be int64, got torch\.int32"):
        Tables().segments(torch.zeros(2, dtype=torch.int32), 1)


@needs_kernels
def test_the_inputs_come_back_as_they_were():
    g, cam = draw_scene(BOOKS, 5, torch.float32)
    result = IndexedRasterizer().render(g, cam, RasterOptions())
    assert result.inputs is g
    assert torch.equal(IndexedRasterizer().visible_filter(g, cam) > 0, result.radii > 0)


@needs_kernels
def test_what_a_variant_does_not_declare_is_refused():
    g, cam = draw_scene(RasterCase(), 1, torch.float32)
    with pytest.raises(CapabilityError, match=r"'c3dgs' does not offer FISHER"):
        IndexedRasterizer().render(g, cam, RasterOptions(fisher=True))


@needs_kernels
@pytest.mark.parametrize(
    ("prefer", "case", "options", "served"),
    [
        (["accel"], {"color": "split"}, RasterOptions(), "standard"),
        (["depth", "c3dgs"], {}, RasterOptions(depth=frozenset({"inverse", "median"}), antialias=True), "standard"),
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


def test_the_twelve_names_of_papers_are_listed_and_accepted(monkeypatch):
    aliases = {"accel", "depth", "count", "speedy", "pup", "mesongs", "trimgs"}
    names = {"standard", "c3dgs", "2dgs", "flash", "tcgs", *aliases}
    rasterizers = load_plugins().rasterizers
    assert names <= set(rasterizers.names)
    assert not aliases & {entry.name for entry in rasterizers}
    for name in aliases:
        assert rasterizers.entry(name).name == "standard"
        assert rasterizers.load(name) is StandardRasterizer
        monkeypatch.setenv("SW_RASTERIZER", name)
        assert NegotiatedRasterizer(load_plugins(), device="cpu").select(["BACKWARD"]).info.name == "standard"
    monkeypatch.delenv("SW_RASTERIZER")
    left = NegotiatedRasterizer(load_plugins(), device="cpu", forbid=["accel", "c3dgs"])
    assert left.select(["BACKWARD"]).info.name == "reference"
