"""The anchor model decodes as written down, and grows and prunes by the published rules."""

import math

import pytest
import torch
from sw_anchors import growth
from sw_anchors.anchors import AnchorAttributes, AnchorModel, AnchorSelection
from sw_anchors.growth import _unique_cells, accumulate_anchor_statistics, adjust_anchors
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

from splatwizard_core.errors import EmptyModel, SceneError, ShapeError
from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.scene.scene import PointCloud
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer

RASTERIZER = ReferenceRasterizer()


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def make(n=6, k=4, feature_dim=5, *, cls=AnchorModel, seed=0):
    """Anchors in front of the test camera, with random attributes."""
    g = generator(seed)
    anchors = torch.rand(n, 3, generator=g) * 2 - torch.tensor([1.0, 1.0, -3.0])
    return cls(
        anchors,
        torch.randn(n, feature_dim, generator=g),
        torch.randn(n, k, 3, generator=g),
        torch.randn(n, 6, generator=g) * 0.3 - 2,
        voxel_size=0.1,
        hidden=8,
        generator=g,
    )


def optimizer_of(model):
    names = ("anchors", "features", "offsets", "log_scales", "mlp_opacity", "mlp_cov", "mlp_color")
    return SplatOptimizer(model, [ParamGroup(name, 0.01) for name in names])


def test_networks_have_the_published_sizes():
    model = AnchorModel.from_points(PointCloud(torch.rand(50, 3, generator=generator())), voxel_size=0.01,
                                    generator=generator())  # fmt: skip
    counts = {name: sum(p.numel() for p in getattr(model, name).parameters())
              for name in ("mlp_opacity", "mlp_cov", "mlp_color")}  # fmt: skip
    assert counts == {"mlp_opacity": 3260, "mlp_cov": 6320, "mlp_color": 4280}
    assert model.offsets.shape[1:] == (10, 3)
    assert model.counts() == {"num_anchors": model.num_rows, "num_gaussians": 10 * model.num_rows}


def test_anchors_are_the_occupied_cells():
    xyz = torch.tensor([[0.04, 0, 0], [-0.04, 0.02, 0], [1.0, 0.31, 0], [1.04, 0.27, 0.01], [float("nan"), 0, 0]])
    model = AnchorModel.from_points(PointCloud(xyz), voxel_size=0.1, generator=generator())
    torch.testing.assert_close(model.anchors.detach(), torch.tensor([[0.0, 0, 0], [1.0, 0.3, 0]]))
    # Two anchors: the only neighbour of each is the other.
    spacing = math.sqrt(1 + 0.09)
    torch.testing.assert_close(model.log_scales.detach(), torch.full((2, 6), math.log(spacing)))
    assert not bool(model.offsets.any())
    assert not bool(model.features.any())


def test_voxel_size_may_come_from_the_points():
    xyz = torch.cartesian_prod(*[torch.arange(4.0)] * 3)
    model = AnchorModel.from_points(PointCloud(xyz), voxel_size=0, generator=generator())
    assert model.voxel_size == 1.0  # three neighbours at distance 1: the mean of the squares
    assert model.num_rows == 64
    with pytest.raises(SceneError, match="coincide"):
        AnchorModel.from_points(PointCloud(torch.zeros(9, 3)), voxel_size=0, generator=generator())
    with pytest.raises(SceneError, match="no finite point"):
        AnchorModel.from_points(PointCloud(torch.full((2, 3), torch.nan)), voxel_size=0.1, generator=generator())


def test_networks_depend_on_the_generator_alone():
    torch.manual_seed(1)
    first = make(seed=3)
    torch.manual_seed(2)
    assert first.digest() == make(seed=3).digest()
    assert first.digest() != make(seed=4).digest()


def test_decoding_equals_the_formulas_one_by_one():
    model, cam = make(), front_camera()
    rows = torch.tensor([4, 0, 2])
    g = model.decode(cam, rows)
    selection = g.extras["anchors"]
    found = 0
    for v, row in enumerate(rows.tolist()):
        x = model.anchors[row]
        toward = x - cam.center
        h = torch.cat([model.features[row], toward / toward.norm(), toward.norm()[None]])
        alpha = torch.tanh(model.mlp_opacity(h))
        torch.testing.assert_close(selection.opacities[v], alpha.detach())
        scales = model.log_scales[row].exp()
        geometry = model.mlp_cov(h).reshape(4, 7)
        colors = torch.sigmoid(model.mlp_color(h)).reshape(4, 3)
        for j in range(4):
            if alpha[j] <= 0:
                continue
            torch.testing.assert_close(g.opacities[found], alpha[j])
            torch.testing.assert_close(g.means[found], x + model.offsets[row, j] * scales[:3])
            torch.testing.assert_close(g.scales[found], scales[3:] * torch.sigmoid(geometry[j, :3]))
            torch.testing.assert_close(g.quats[found], geometry[j, 3:] / geometry[j, 3:].norm())
            torch.testing.assert_close(g.colors[found], colors[j])
            assert int(selection.offset_index()[found]) == row * 4 + j
            found += 1
    assert 0 < found < 12
    assert len(g) == found


def test_only_anchors_that_the_camera_sees_are_decoded():
    model = make(n=8)
    with torch.no_grad():
        model.anchors[3, 2] = -4  # behind
        model.anchors[5, 0] = 50  # far outside
    g = model.gaussians(front_camera(), RASTERIZER)
    assert g.extras["anchors"].rows.tolist() == [0, 1, 2, 4, 6, 7]


def test_gradients_reach_every_parameter():
    model, cam = make(), front_camera()
    RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions()).image.square().sum().backward()
    for name, parameter in model.named_parameters():
        assert float(parameter.grad.abs().max()) > 0, name


def test_no_visible_anchor_renders_the_background():
    model, cam = make(), front_camera()
    with torch.no_grad():
        model.anchors[:, 2] = -4
    g = model.gaussians(cam, RASTERIZER)
    result = RASTERIZER.render(g, cam, RasterOptions(background=torch.tensor([0.2, 0.3, 0.4]), grad2d=True))
    assert len(g) == 0
    torch.testing.assert_close(result.image[:, 5, 5].detach(), torch.tensor([0.2, 0.3, 0.4]))
    result.image.sum().backward()
    accumulate_anchor_statistics(model, result.extras["anchors"], result.grad2d.value, result.radii)
    assert float(model.anchor_denom.sum()) == 0


class Masked(AnchorModel):
    """A model that removes its odd offsets and halves its features, as a quantising method would."""

    def attributes(self, rows):
        raw = super().attributes(rows)
        masks = (torch.arange(self.num_offsets) % 2 == 0).float().expand(len(rows), -1)
        extras = {"rate": raw.features.abs().sum()}
        return AnchorAttributes(raw.positions, raw.features / 2, raw.offsets, raw.scales, masks, extras)


def test_a_subclass_decides_what_the_networks_see():
    model, cam = make(cls=Masked), front_camera()
    g = model.gaussians(cam, RASTERIZER)
    selection = g.extras["anchors"]
    assert len(g) > 0
    assert bool((selection.drawn % 2 == 0).all())
    assert float(selection.opacities[:, 1::2].abs().max()) == 0
    torch.testing.assert_close(g.extras["rate"], model.features[selection.rows].abs().sum())  # with its gradient
    with torch.no_grad():
        model.features /= 2
    plain = make()
    plain.load_state_dict(model.state_dict())
    opacities = plain.gaussians(cam, RASTERIZER).extras["anchors"].opacities
    torch.testing.assert_close(opacities[:, 0::2], selection.opacities[:, 0::2])


def test_statistics_of_one_view_worked_out_by_hand():
    model = make(n=3, k=2)
    selection = AnchorSelection(
        rows=torch.tensor([2, 0]), opacities=torch.tensor([[0.5, -0.25], [0.1, 0.3]]), drawn=torch.tensor([0, 2, 3])
    )
    gradients = torch.tensor([[3.0, 4.0], [1.0, 0.0], [6.0, 8.0]])
    radii = torch.tensor([5, 0, 2], dtype=torch.int32)
    for _ in range(2):
        accumulate_anchor_statistics(model, selection, gradients, radii)
    torch.testing.assert_close(model.opacity_accum, torch.tensor([0.8, 0, 1.0]))
    torch.testing.assert_close(model.anchor_denom, torch.tensor([2.0, 0, 2]))
    torch.testing.assert_close(model.offset_grad_accum, torch.tensor([[0.0, 20], [0, 0], [10, 0]]))
    torch.testing.assert_close(model.offset_denom, torch.tensor([[0.0, 2], [0, 0], [2, 0]]))


def test_statistics_of_a_rendered_view_fit_its_selection():
    model, cam = make(), front_camera()
    result = RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions(grad2d=True))
    result.image.square().mean().backward()
    accumulate_anchor_statistics(model, result.extras["anchors"], result.grad2d.value, result.radii)
    assert float(model.offset_denom.sum()) == int((result.radii > 0).sum())
    norms = result.grad2d.value.norm(dim=1)
    torch.testing.assert_close(model.offset_grad_accum.sum(), norms.sum())
    assert model.anchor_denom.tolist() == [1.0] * 6


def growing_model():
    """Three anchors on the lattice of 1.6, two offsets; offset (0,1) points into the free cell (2,0,0) * 1.6."""
    anchors = torch.tensor([[0.0, 0, 0], [1.6, 0, 0], [0, 4.8, 0]])
    features = torch.tensor([[1.0, -5.0], [2.0, -9.0], [0.0, 0.0]])
    offsets = torch.zeros(3, 2, 3)
    offsets[0, 1, 0] = 3.3
    offsets[1, 0, 0] = 1.5
    offsets[1, 1, 0] = 0.1  # stays in the cell of its own anchor at every level... of the coarse lattice
    model = AnchorModel(anchors, features, offsets, torch.zeros(3, 6), voxel_size=0.1, hidden=4, generator=generator())
    model.offset_denom.fill_(41)
    model.anchor_denom.fill_(10)
    model.opacity_accum.fill_(5)
    return model


def always():
    """A generator whose first draws are all above one half for the six offsets used here."""
    for seed in range(10_000):
        if float(torch.rand(3, 2, generator=generator(seed)).min()) > 0.5:
            return generator(seed)
    raise AssertionError


def test_anchors_grow_at_free_cell_centres_only():
    model = growing_model()
    model.offset_grad_accum[0, 1] = 41 * 2.5e-4
    model.offset_grad_accum[1, 0] = 41 * 2.1e-4
    model.offset_grad_accum[1, 1] = 41 * 3.9e-4  # its coarse cell is taken
    model.offset_grad_accum[2, 0] = 41 * 1.9e-4  # below the threshold
    report = adjust_anchors(model, optimizer_of(model), step=100, generator=always())
    # Level 0, cells of 1.6: x = 3.3 and 3.1 both round to 2 * 1.6. Levels 1 and 2 need 4e-4 and 8e-4.
    assert (report.grown, report.pruned, report.total) == (1, 0, 4)
    torch.testing.assert_close(model.anchors[3].detach(), torch.tensor([3.2, 0, 0]))
    torch.testing.assert_close(model.features[3].detach(), torch.tensor([2.0, -5.0]))  # element-wise maximum
    torch.testing.assert_close(model.log_scales[3, :3].detach(), torch.full((3,), math.log(1.6)))
    torch.testing.assert_close(model.log_scales[3, 3:].detach(), torch.full((3,), 0.05))  # log 1.6 = 0.47 is clamped
    assert not bool(model.offsets[3].any())


def test_finer_levels_need_higher_gradients_and_a_coarse_success():
    model = growing_model()
    model.offset_grad_accum[1, 1] = 41 * 9e-3  # 0.1 away from its anchor: free only in the finest cells
    report = adjust_anchors(model, optimizer_of(model), step=100, generator=always())
    assert report.grown == 0  # level 0 added nothing, so the finer levels are skipped
    found = 0
    for seed in range(20):
        model = growing_model()
        model.offset_grad_accum[0, 1] = 41 * 2.5e-4
        model.offset_grad_accum[1, 1] = 41 * 9e-3
        adjust_anchors(model, optimizer_of(model), step=100, generator=generator(seed))
        fine = (model.anchors.detach() - torch.tensor([1.7, 0, 0])).abs().amax(dim=1) < 1e-5
        if bool(fine.any()):
            found += 1
            torch.testing.assert_close(model.log_scales[fine][0, :3].detach(), torch.full((3,), math.log(0.1)))
    # Level 0 lets the coarse one pass in half of the cases, level 2 the fine one in seven of eight.
    assert 3 <= found <= 16


@pytest.mark.parametrize(("subvoxel", "expected"), [(False, [0.4, 0.1]), (True, [0.4, 0.1, 0.025])])
def test_levels_of_no_whole_voxels_grow_nothing(subvoxel, expected, monkeypatch):
    """NeRF Synthetic has a factor of 4: 4 // 16 = 0 at level 2, as in the authors' code."""
    free_cells, sizes = growth._free_cells, []

    def noted(points, features, anchors, size):
        sizes.append(size)
        return free_cells(points, features, anchors, size)

    monkeypatch.setattr(growth, "_free_cells", noted)
    model = growing_model()
    model.offset_grad_accum.fill_(41 * 9e-3)
    adjust_anchors(model, optimizer_of(model), step=100, generator=always(), init_factor=4, subvoxel=subvoxel)
    assert sizes == pytest.approx(expected)


def test_offsets_that_were_hardly_drawn_do_not_grow():
    model = growing_model()
    model.offset_grad_accum[0, 1] = 40 * 1.0
    model.offset_denom[0, 1] = 40
    report = adjust_anchors(model, optimizer_of(model), step=100, generator=always())
    assert report.grown == 0
    assert float(model.offset_denom[0, 1]) == 40  # not eligible: keeps counting
    assert float(model.offset_denom[1].max()) == 0  # eligible: starts again


def test_transparent_anchors_go_after_enough_views():
    model = growing_model()
    model.anchor_denom[:] = torch.tensor([81.0, 80.0, 200.0])
    model.opacity_accum[:] = torch.tensor([0.4, 0.0, 1.1])  # 81 * 0.005 = 0.405; 200 * 0.005 = 1
    report = adjust_anchors(model, optimizer_of(model), step=100, generator=generator())
    assert (report.grown, report.pruned, report.total) == (0, 1, 2)
    torch.testing.assert_close(model.anchors.detach(), torch.tensor([[1.6, 0, 0], [0, 4.8, 0]]))
    assert model.anchor_denom.tolist() == [80.0, 0.0]  # judged ones start again
    assert model.opacity_accum.tolist() == [0.0, 0.0]


def test_pruning_everything_is_an_error():
    model = growing_model()
    model.anchor_denom.fill_(100)
    model.opacity_accum.zero_()
    with pytest.raises(EmptyModel):
        adjust_anchors(model, optimizer_of(model), step=700, generator=generator())


def test_optimizer_state_follows_the_rows():
    model, cam = make(), front_camera()
    optimizer = optimizer_of(model)
    RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions()).image.square().sum().backward()
    optimizer.step()
    before = optimizer.moments("features")[0].clone()
    model.offset_denom.fill_(50)
    model.offset_grad_accum.fill_(50.0)
    model.anchor_denom[1] = 100  # transparent: goes
    report = adjust_anchors(model, optimizer, step=100, generator=generator())
    assert report.grown > 0
    assert report.pruned == 1
    assert model.num_rows == 6 + report.grown - 1 == report.total
    for name in model.ROWS:
        assert len(getattr(model, name)) == model.num_rows, name
    after = optimizer.moments("features")[0]
    torch.testing.assert_close(after[:5], before[[0, 2, 3, 4, 5]])
    assert float(after[5:].abs().max()) == 0
    assert model.features.grad is None
    assert model.mlp_opacity[0].weight.grad is not None  # networks keep their gradient in this step


def test_a_resized_state_loads():
    model = make(n=9)
    other = make(n=4, seed=5)
    model.voxel_size = 0.37
    other.load_resized(model.state_dict())
    other.load_state_dict_extra(model.state_dict_extra())
    assert other.digest() == model.digest()


def test_wrong_shapes_are_named():
    with pytest.raises(ShapeError, match=r"log_scales must be \[2, 6\]"):
        AnchorModel(torch.zeros(2, 3), torch.zeros(2, 5), torch.zeros(2, 4, 3), torch.zeros(2, 3), voxel_size=1,
                    generator=generator())  # fmt: skip


@pytest.mark.pipeline
def test_anchors_learn_a_picture():
    cam = front_camera(32, 32)
    ys, xs = torch.meshgrid(torch.linspace(0, 3, 32), torch.linspace(0, 3, 32), indexing="ij")
    target = 0.5 + 0.5 * torch.stack([torch.sin(2 * xs), torch.cos(2 * ys), torch.sin(xs * ys)])
    xyz = torch.rand(300, 3, generator=generator()) * torch.tensor([3.0, 3, 0.5]) + torch.tensor([-1.5, -1.5, 4])
    model = AnchorModel.from_points(PointCloud(xyz), voxel_size=0.25, feature_dim=8, num_offsets=4, hidden=32,
                                    generator=generator())  # fmt: skip
    optimizer, losses = optimizer_of(model), []
    for _ in range(80):
        result = RASTERIZER.render(model.gaussians(cam, RASTERIZER), cam, RasterOptions())
        loss = (result.image - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < losses[0] / 4


@pytest.mark.parametrize("scale", [1.0, 1e5, 1e12], ids=["near", "far", "too far for one number"])
def test_unique_cells_are_those_of_torch_in_its_order(scale):
    cells = torch.randint(-3, 4, (400, 3), generator=torch.Generator().manual_seed(0)) * scale
    found, expected = _unique_cells(cells), torch.unique(cells, dim=0, return_inverse=True)
    assert torch.equal(found[0], expected[0])
    assert torch.equal(found[1], expected[1])
    assert [len(each) for each in _unique_cells(cells[:0])] == [0, 0]
