"""Flat Gaussians: the same ellipsoid without its smallest axis, which no step gives back to it."""

import math

import torch
from sw_gaussians.density.adc import densify_and_prune
from sw_gaussians.density.splitting import rotate
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.rendering.rasterizer import RasterOptions
from splatwizard_core.training.optimizer import ParamGroup, SplatOptimizer
from sw_trimgs.flat import FlatGaussians, flattened, times


def covariances(quats, scales):
    axes = torch.stack([rotate(quats, torch.eye(3)[i].expand(len(quats), 3)) for i in range(3)], dim=2)
    return axes @ (scales**2).diag_embed() @ axes.transpose(1, 2)


def axes_of(model):
    return torch.stack([rotate(model.quats, torch.eye(3)[i].expand(model.num_rows, 3)) for i in range(3)], dim=2)


def test_only_the_smallest_axis_is_gone(make):
    model = make.cloud(n=60)
    flat = flattened(model)
    expected = model.scales.detach().clone()
    expected.scatter_(1, expected.argmin(dim=1, keepdim=True), 1e-8)
    assert torch.allclose(
        covariances(flat.quats, flat.scales), covariances(model.quats, expected), atol=1e-6 * float(expected.max() ** 2)
    )
    assert bool((flat.scales[:, 0] == 1e-8).all())
    normal = axes_of(model).gather(2, model.log_scales.argmin(dim=1)[:, None, None].expand(-1, 3, 1))[:, :, 0]
    assert torch.allclose(axes_of(flat)[:, :, 0], normal, atol=1e-6)
    for name in ("means", "sh_dc", "sh_rest", "opacity_logits"):
        assert torch.equal(getattr(flat, name), getattr(model, name))


def test_axes_stay_right_handed(make):
    assert torch.allclose(torch.linalg.det(axes_of(flattened(make.cloud(n=30)))), torch.ones(30), atol=1e-5)


def test_flattening_copies_and_flat_ones_stay_what_they_are(make):
    model = make.cloud(n=5)
    flat = flattened(model)
    flat.means.data += 1
    assert not torch.equal(flat.means, model.means)
    assert flattened(flat) is flat


def test_a_surfel_keeps_its_plane(make):
    cloud = make.cloud(n=8)
    tensors = [cloud.means, cloud.sh_dc, cloud.sh_rest, cloud.opacity_logits, cloud.log_scales[:, :2], cloud.quats]
    surfels = SurfelModel(*(t.detach() for t in tensors))
    flat = flattened(surfels)
    assert torch.allclose(axes_of(flat)[:, :, 0], axes_of(surfels)[:, :, 2], atol=1e-6)
    assert torch.allclose(flat.scales[:, 1:], surfels.scales)


def test_products_of_quaternions_are_products_of_rotations(make):
    a, b = make.cloud(n=9).quats, make.cloud(n=9, seed=1).quats
    v = make.cloud(n=9, seed=2).means
    assert torch.allclose(rotate(times(a, b), v), rotate(a, rotate(b, v)), atol=1e-5)


def test_the_thickness_gets_no_gradient_and_is_drawn_whatever_is_stored(make, rasterizer):
    model, camera = flattened(make.cloud(n=40)), make.camera([0.0, 0.0, -4.0])
    drawn = rasterizer.render(model.gaussians(camera, rasterizer), camera, make.options()).image
    drawn.square().sum().backward()
    assert not model.log_scales.grad[:, 0].any()
    assert model.log_scales.grad[:, 1:].any()
    model.log_scales.data[:, 0] -= 3
    again = rasterizer.render(model.gaussians(camera, rasterizer), camera, make.options()).image
    assert torch.equal(drawn, again)
    model.settle()
    assert bool((model.log_scales[:, 0] == math.log(1e-8)).all())


def test_children_of_the_ordinary_split_stay_in_the_plane(make):
    model = flattened(make.cloud(n=1, seed=3))
    normal, parent = axes_of(model)[0, :, 0].detach(), model.means.detach().clone()
    model.grad_accum += 1
    model.denom += 1
    optimizer = SplatOptimizer(model, [ParamGroup(name, 1e-3) for name, _ in model.named_parameters()])
    report = densify_and_prune(model, optimizer, step=1, extent=1e-3, min_opacity=0.0)
    assert report["split"] == 1
    assert float(((model.means.detach() - parent) @ normal).abs().max()) < 1e-6


def test_normals_look_at_the_camera_and_learn(make):
    model = flattened(make.cloud(n=50))
    center = torch.tensor([0.0, 0.0, -4.0])
    normals = model.normals(center)
    assert torch.allclose(normals.norm(dim=1), torch.ones(50), atol=1e-6)
    assert bool(((center - model.means) * normals).sum(dim=1).ge(0).all())
    normals[:, 0].sum().backward()
    assert model.quats.grad.any()
    assert model.means.grad is None


def test_depth_and_normals_are_drawn_only_where_they_are_asked_for(make, rasterizer):
    model, camera = flattened(make.cloud(n=20)), make.camera([0.0, 0.0, -4.0])
    assert model.gaussians(camera, rasterizer).features is None
    model.draws_surface = True
    drawn = rasterizer.render(
        model.gaussians(camera, rasterizer),
        camera,
        RasterOptions(depth=frozenset({"accumulated"}), features_detach_geometry=True),
    )
    assert drawn.features.shape == (4, camera.height, camera.width)
    assert torch.allclose(drawn.features[:1], drawn.depth["accumulated"], atol=1e-4)


def test_a_checkpoint_holds_the_neighbours(make):
    model, other = flattened(make.cloud(n=6)), flattened(make.cloud(n=9))
    model.neighbors = torch.arange(12, dtype=torch.int32).reshape(6, 2)
    other.load_resized(model.state_dict())
    assert isinstance(other, FlatGaussians)
    assert torch.equal(other.neighbors, model.neighbors)
