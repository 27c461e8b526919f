"""Surfels: two scales, their start, their children, their .ply and what a file's header says of them."""

import math

import pytest
import torch
from sw_gaussians.density.adc import densify_and_prune
from sw_gaussians.ply import export_ply, export_ply_as_3dgs, load_ply, to_ply
from sw_gaussians.start import gaussians_from_points, logit, surfels_from_points
from sw_gaussians.surfels import (
    Surface,
    SurfelModel,
    as_ellipsoids,
    gaussians_of,
    state_surface,
    state_surfels,
    stated_scales,
    stated_surface,
)

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError, SceneError, ShapeError, UserInputError
from splatwizard_core.gaussians.model import GaussianModel
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import export_model
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

EXTENT = 10.0
PARAMETERS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


def tensors(n: int, degree: int = 1, scales: int = 2, seed: int = 0) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    shapes = [(n, 3), (n, 1, 3), (n, (degree + 1) ** 2 - 1, 3), (n,), (n, scales), (n, 4)]
    return [torch.randn(shape, generator=g) for shape in shapes]


def test_scales_have_two_columns_and_everything_else_is_as_in_gaussians():
    model = SurfelModel(*tensors(5))
    inputs = model.gaussians(None, None)  # type: ignore[arg-type]
    inputs.validate()
    assert inputs.scales.shape == (5, 2)
    assert isinstance(model, GaussianModel)
    with pytest.raises(ShapeError, match=r"log_scales must be \[5, 2\]"):
        SurfelModel(*tensors(5, scales=3))
    with pytest.raises(ShapeError, match=r"log_scales must be \[5, 3\]"):
        GaussianModel(*tensors(5))
    assert type(gaussians_of(*tensors(5))) is SurfelModel
    assert type(gaussians_of(*tensors(5, scales=3), active_sh_degree=0)) is GaussianModel


def test_the_surface_is_part_of_the_state():
    model, other = SurfelModel(*tensors(2)), SurfelModel(*tensors(2))
    model.surface = Surface(0.25, 100.0, 0.05)
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.surface == model.surface
    other.load_state_dict_extra(SurfelModel(*tensors(2)).state_dict_extra())
    assert other.surface is None


def points(n: int = 400) -> PointCloud:
    g = torch.Generator().manual_seed(4)
    return PointCloud(torch.randn(n, 3, generator=g), torch.rand(n, 3, generator=g))


def test_the_first_surfels_are_the_first_gaussians_but_for_scales_and_rotations():
    surfels = surfels_from_points(points(), generator=torch.Generator().manual_seed(1))
    gaussians = gaussians_from_points(points())
    assert torch.equal(surfels.log_scales, gaussians.log_scales[:, :2])
    assert surfels.active_sh_degree == 0
    assert surfels.max_sh_degree == 3
    for name in ("means", "sh_dc", "sh_rest", "opacity_logits"):
        assert torch.equal(getattr(surfels, name), getattr(gaussians, name)), name


def test_first_rotations():
    def quats(rotation: str, seed: int = 1) -> torch.Tensor:
        generator = torch.Generator().manual_seed(seed)
        return surfels_from_points(points(), generator=generator, rotation=rotation).quats.detach()

    published = quats("uniform4")
    assert 0 <= float(published.min()) <= float(published.max()) < 1  # all positive: no uniform rotation
    assert torch.equal(published, quats("uniform4"))
    assert not torch.equal(published, quats("uniform4", seed=2))
    uniform = quats("haar")
    torch.testing.assert_close(uniform.norm(dim=1), torch.ones(400))
    assert uniform.mean(dim=0).abs().max() < 0.1  # 0.5 / sqrt(400) = 0.025
    assert torch.equal(quats("identity"), torch.eye(4)[:1].expand(400, 4))


def test_no_usable_point_is_an_error():
    with pytest.raises(SceneError, match="no usable start point"):
        surfels_from_points(PointCloud(torch.full((2, 3), math.nan), None), generator=torch.Generator())


def densified(min_opacity: float = 0.05) -> tuple[SurfelModel, SurfelModel]:
    """(before, after) a step that splits surfel 0, clones surfel 1 and prunes by opacity."""
    rows = tensors(4, seed=3)
    rows[3] = torch.tensor([logit(o) for o in (0.5, 0.5, 0.04, 0.06)])
    rows[4] = torch.tensor([0.5, 0.05, 0.05, 0.05]).log()[:, None] + torch.tensor([0.0, -1.0])
    model, before = SurfelModel(*rows), SurfelModel(*(row.clone() for row in rows))
    model.grad_accum[:2], model.denom[:2] = 1e-3, 1
    optimizer = SplatOptimizer(model, [ParamGroup(name, lr=0.0) for name in PARAMETERS])
    report = densify_and_prune(model, optimizer, step=600, extent=EXTENT, min_opacity=min_opacity)
    assert (report["cloned"], report["split"]) == (1, 1)
    return before, model


def test_children_stay_in_the_plane():
    before, after = densified()
    children = slice(-2, None)
    quat = torch.nn.functional.normalize(before.quats[0].detach(), dim=0)
    w, x, y, z = quat.tolist()
    normal = torch.tensor([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    offsets = (after.means[children] - before.means[0]).detach()
    assert (offsets.norm(dim=1) > 1e-2).all()
    assert ((offsets @ normal).abs() < 1e-6).all()
    assert torch.equal(after.quats[children], before.quats[:1].expand(2, 4))
    torch.testing.assert_close(after.scales[children], before.scales[:1].expand(2, 2) / 1.6)


def test_surfels_below_the_least_opacity_are_pruned():
    _, after = densified()
    assert after.num_rows == 5  # 1, 3, the clone, two children
    assert (after.opacities < 0.05).sum() == 0
    assert densified(min_opacity=0.005)[1].num_rows == 6


def test_ply_of_surfels_has_two_scales_and_comes_back_bit_for_bit(tmp_path):
    model = SurfelModel(*tensors(7, degree=2))
    export_ply(model, tmp_path / "surfels.ply")
    data = (tmp_path / "surfels.ply").read_bytes()
    assert b"scale_1" in data
    assert b"scale_2" not in data
    assert len(data) - data.index(b"end_header\n") - 11 == 7 * 4 * (16 + 3 * 8)
    loaded = load_ply(tmp_path / "surfels.ply")
    assert type(loaded) is SurfelModel
    assert loaded.surface is None
    for name in PARAMETERS:
        assert torch.equal(getattr(loaded, name), getattr(model, name)), name
    (tmp_path / "one.ply").write_bytes(to_ply(model).replace(b"scale_1", b"other_1"))
    with pytest.raises(SceneError, match="'scale_1' is missing"):
        load_ply(tmp_path / "one.ply")


def test_surfels_can_be_written_as_flat_ellipsoids(tmp_path):
    model = SurfelModel(*tensors(3))
    flat = as_ellipsoids(model)
    assert type(flat) is GaussianModel
    assert torch.equal(flat.log_scales[:, :2], model.log_scales)
    assert torch.allclose(flat.scales[:, 2], torch.tensor(1e-8))
    assert as_ellipsoids(flat) is flat
    export_ply_as_3dgs(model, tmp_path / "flat.ply")
    assert (tmp_path / "flat.ply").read_bytes() == to_ply(flat)


def test_export_takes_the_flat_form_only_by_name(tmp_path):
    model, plugins = SurfelModel(*tensors(3)), load_plugins()
    assert export_model(model, tmp_path / "native.ply", plugins) == "ply"
    assert type(load_ply(tmp_path / "native.ply")) is SurfelModel
    assert export_model(model, tmp_path / "flat.ply", plugins, "ply-as-3dgs") == "ply-as-3dgs"
    assert type(load_ply(tmp_path / "flat.ply")) is GaussianModel
    with pytest.raises(UserInputError, match="no installed exporter writes ''"):
        export_model(model, tmp_path / "nothing", plugins)


def header_of(**values: object) -> ContainerReader:
    writer = ContainerWriter("2dgs", 1)
    writer.static.update(values)
    return ContainerReader(writer.to_bytes(), "file.swz")


def test_the_header_states_primitive_and_surface():
    model = SurfelModel(*tensors(2))
    model.surface = Surface(1.0, 1000.0, 0.05)
    writer = ContainerWriter("2dgs", 1)
    state_surfels(model, writer)
    state_surface(model, writer)
    assert writer.static == {"primitive": "surfel", "depth_ratio": 1.0, "lambda_dist": 1000.0, "lambda_normal": 0.05}
    reader = ContainerReader(writer.to_bytes(), "file.swz")
    assert stated_scales(reader) == 2
    assert stated_surface(reader) == model.surface


def test_the_header_of_other_gaussians_says_nothing():
    writer = ContainerWriter("3dgs", 1)
    model = GaussianModel(*tensors(2, scales=3))
    state_surfels(model, writer)
    state_surface(model, writer)
    state_surface(SurfelModel(*tensors(2)), writer)
    assert writer.static == {}
    assert stated_scales(header_of()) == 3
    assert stated_surface(header_of()) is None


@pytest.mark.parametrize(
    "values",
    [
        {"primitive": "voxel"},
        {"primitive": 2},
        {"primitive": "surfel", "depth_ratio": 2},
        {"primitive": "surfel", "depth_ratio": "1"},
        {"primitive": "surfel", "depth_ratio": 1},
        {"primitive": "surfel", "depth_ratio": 1, "lambda_dist": -1, "lambda_normal": 0},
    ],
)
def test_a_hostile_header_is_refused(values):
    reader = header_of(**values)
    with pytest.raises(BitstreamError):
        [read(reader) for read in (stated_scales, stated_surface)]
