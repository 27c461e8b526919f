"""What the fields of GaussianInputs must have in common before anything is drawn."""

import pytest
import torch

from splatwizard_core.errors import ShapeError
from splatwizard_core.gaussians.inputs import SH, GaussianInputs
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.rendering.rasterizer import RasterOptions

N = 4
DENSE, DC, REST, INDICES = torch.zeros(N, 4, 3), torch.zeros(N, 1, 3), torch.zeros(N, 3, 3), torch.zeros(N).long()


def inputs(**changes) -> GaussianInputs:
    fields = {"scales": torch.ones(N, 3), "quats": torch.ones(N, 4), "colors": torch.ones(N, 3), **changes}
    return GaussianInputs(torch.zeros(N, 3), torch.ones(N), **fields)


def test_surfels_and_indexed_geometry_are_fine():
    inputs().validate()
    inputs(scales=torch.ones(N, 2)).validate()
    inputs(scales=torch.ones(9, 3), quats=torch.ones(9, 4), geom_indices=INDICES).validate()
    inputs(scales=None, quats=None, cov3d=torch.ones(N, 6)).validate()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"scales": torch.ones(N, 1)}, r"scales must be \[4, 3\]"),
        ({"scales": torch.ones(N, 4)}, r"scales must be \[4, 3\]"),
        ({"scales": torch.ones(9, 3), "quats": torch.ones(8, 4), "geom_indices": INDICES}, "as long as quats"),
        ({"quats": None}, "either scales and quats, or cov3d"),
        ({"cov3d": torch.ones(N, 6)}, "cov3d excludes"),
        ({"cov3d": torch.ones(N, 6), "quats": None}, "cov3d excludes"),
        ({"colors": torch.ones(N + 1, 3)}, r"colors must be \[4, C\], got \[5, 3\]"),
        ({"sh": SH(dense=DENSE)}, "either sh or colors"),
    ],
)
def test_fields_that_do_not_fit_together_are_named(changes, message):
    with pytest.raises(ShapeError, match=message):
        inputs(**changes).validate()


def test_harmonics_have_exactly_one_storage_form():
    codebook = torch.zeros(2, 3, 3)
    forms = (
        {"dense": DENSE}, {"dc": DC}, {"dc": DC, "rest": REST}, {"codebook": codebook, "indices": INDICES},
        {"dc": DC, "codebook": codebook, "indices": INDICES},
    )  # fmt: skip
    for form in forms:
        inputs(colors=None, sh=SH(**form, active_degree=0)).validate()
    for form in (
        {}, {"rest": REST}, {"dense": DENSE, "dc": DC}, {"dc": DC, "codebook": codebook},
        {"dc": DC, "rest": REST, "codebook": codebook, "indices": INDICES},
    ):  # fmt: skip
        with pytest.raises(ShapeError, match="SH holds"):
            inputs(colors=None, sh=SH(**form)).validate()


@pytest.mark.parametrize("form", [{"dc": DC}, {"dense": DENSE}, {"dc": DC, "rest": REST}])
def test_the_active_degree_has_its_coefficients(form):
    with pytest.raises(ShapeError, match="SH degree 3 needs 16 coefficients, here are"):
        inputs(colors=None, sh=SH(**form)).validate()


def test_a_tensor_on_another_device_is_named():
    g = GaussianInputs(
        means=torch.zeros(2, 3), opacities=torch.zeros(2), scales=torch.ones(2, 3),
        quats=torch.ones(2, 4, device="meta"), colors=torch.zeros(2, 3),
    )  # fmt: skip
    with pytest.raises(ShapeError, match="quats is on meta, means on cpu"):
        g.validate()


def test_a_tensor_of_another_dtype_is_named():
    info = RasterizerInfo("some", frozenset({"cpu"}), frozenset({"float32"}), frozenset({"SPLIT_SH"}))
    g = GaussianInputs(
        means=torch.zeros(2, 3), opacities=torch.zeros(2), scales=torch.ones(2, 3),
        quats=torch.ones(2, 4),
        sh=SH(dc=torch.zeros(2, 1, 3, dtype=torch.float64), active_degree=0),
    )  # fmt: skip
    with pytest.raises(ShapeError, match=r"sh\.dc is float64, means float32"):
        info.check_request(g, RasterOptions())
    g = GaussianInputs(
        *(x.half() for x in (torch.zeros(2, 3), torch.zeros(2), torch.ones(2, 3), torch.ones(2, 4))),
        colors=torch.zeros(2, 3).half(),
    )
    with pytest.raises(ShapeError, match="of float32: means is float16"):
        info.check_request(g, RasterOptions())


def test_gathered_inputs_have_rows_of_their_own():
    generator = torch.Generator().manual_seed(0)
    table = {"scales": torch.rand(3, 3, generator=generator), "quats": torch.rand(3, 4, generator=generator)}
    rows = torch.tensor([2, 0, 0, 1])
    sh = SH(dc=DC, codebook=torch.rand(2, 3, 3, generator=generator), indices=torch.tensor([1, 0, 1, 1]))
    g = inputs(**table, geom_indices=rows, scale_factors=torch.arange(1.0, 5), colors=None, sh=sh)
    own = g.gathered()
    assert torch.equal(own.scales, table["scales"][rows] * torch.arange(1.0, 5)[:, None])
    assert torch.equal(own.quats, table["quats"][rows])
    assert own.geom_indices is None and own.scale_factors is None and own.sh.codebook is None  # noqa: PT018
    assert torch.equal(own.sh.to_dense(), sh.to_dense())
    assert g.gathered(geometry=False).scales is table["scales"]
    assert g.gathered(colors=False).sh is sh
    assert g.geom_indices is rows  # the inputs themselves are left alone


def test_gradients_of_shared_shapes_and_colours_have_the_same_bits_with_several_threads():
    indices = torch.randint(8, (20_000,), generator=torch.Generator().manual_seed(0))
    tables = [torch.ones(8, *tail, requires_grad=True) for tail in ((3,), (4,), (1, 3))]
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        found = []
        for _ in range(10):
            sh = SH(codebook=tables[2], indices=indices, active_degree=0)
            g = GaussianInputs(
                torch.zeros(20_000, 3), torch.ones(20_000), tables[0], tables[1], sh=sh, geom_indices=indices
            )
            own, weights = g.gathered(), torch.randn(20_000, 3, generator=torch.Generator().manual_seed(1))
            colors = (own.sh.to_dense()[:, 0] + sh.to_dense()[:, 0]) * weights
            total = (own.scales * weights).sum() + (own.quats[:, :3] * weights).sum() + colors.sum()
            found.append(torch.autograd.grad(total, tables))
    finally:
        torch.set_num_threads(threads)
    assert all(torch.equal(a, b) for each in found for a, b in zip(each, found[0], strict=True))
