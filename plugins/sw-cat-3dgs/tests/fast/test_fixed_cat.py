"""A training step of CAT-3DGS in tensors of fixed sizes, as a GPU replays it, equals that on any number of anchors."""

import copy
from contextlib import nullcontext

import pytest
import torch
from sw_anchors.testing import check_plain, check_replayed

from sw_cat_3dgs.fast.plane_graphs import FixedPlaneBits


@pytest.fixture
def model(begun, little_scene, rasterizer):
    stage, model, optimizer = begun(context__anchors_per_cell=4.0)
    with torch.no_grad():
        for parameter in model.mlp_opacity.parameters():
            parameter.mul_(3)
    stage.setup_triplane(model, optimizer)
    with torch.no_grad():
        for plane in model.context.triplane.planes:
            plane.normal_(0, 0.3, generator=torch.Generator().manual_seed(0))
        for network in [*model.context.slices.networks.values()]:
            network[-1].weight.fill_(0.01)
    model.count_views([view.camera for view in little_scene.train[:2]], rasterizer)
    return model


@pytest.mark.parametrize("rounded", [False, True])
def test_fixed_sizes_change_neither_values_nor_gradients(model, little_scene, rounded):
    model.context.rounded = rounded
    model.scale_floor = 0.05 if rounded else 0.0
    model.train_only("all but planes" if rounded else "everything")
    camera = little_scene.train[0].camera
    check_replayed(lambda: copy.deepcopy(model), camera, counts=(0, 40))
    check_plain(lambda: copy.deepcopy(model), camera, counts=(0, 40))


def plane_bits(model, fixed, share, seed=0):
    model.fixed_planes = fixed
    model.noise = torch.Generator(model.device).manual_seed(seed)
    model.zero_grad()
    bits = model.plane_bits(share)
    (3 * bits).backward()
    named = model.context.named_parameters()
    return bits.detach(), {name: p.grad.clone() for name, p in named if p.grad is not None}


@pytest.mark.parametrize("trained", ["everything", "spatial models"])
@pytest.mark.parametrize("share", [1.0, 0.5])
def test_bits_of_the_planes_are_the_same(model, monkeypatch, trained, share):
    model.train_only(trained)
    drawn = []
    uniform = model.uniform
    monkeypatch.setattr(model, "uniform", lambda *shape: drawn.append(uniform(*shape)) or drawn[-1].clone())
    expected, slopes = plane_bits(model, None, share)
    noise = torch.cat([each.flatten() for each in drawn])
    fixed = FixedPlaneBits(graphs=False)

    def fill(self, generator=None):
        self[: len(noise)].copy_(noise)

    monkeypatch.setattr(torch.Tensor, "uniform_", fill)
    found, again = plane_bits(model, fixed, share)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=0)
    assert again.keys() == slopes.keys()
    for name, slope in slopes.items():
        torch.testing.assert_close(again[name], slope, rtol=1e-4, atol=1e-4 * float(slope.abs().max()), msg=name)


def test_bits_are_captured_anew_when_planes_are_others_or_others_learn(model):
    fixed = FixedPlaneBits(graphs=False)
    first = plane_bits(model, fixed, 1.0)[0]
    assert float(plane_bits(model, fixed, 1.0, seed=1)[0]) != float(first)  # new noise
    assert fixed.captures == 1
    model.context.triplane.planes[0] = torch.nn.Parameter(2 * model.context.triplane.planes[0].detach())
    assert float(plane_bits(model, fixed, 1.0)[0]) > float(first)
    assert fixed.captures == 2
    model.train_only("spatial models")
    assert all(name.startswith("arms") for name in plane_bits(model, fixed, 1.0)[1])
    assert fixed.captures == 3
    model.train_only("nothing")
    assert not model.plane_bits(1.0).requires_grad


@pytest.mark.parametrize("kind", [RuntimeError, torch.cuda.OutOfMemoryError])
def test_a_gpu_that_refuses_graphs_of_the_planes_is_named_once(kind, model, monkeypatch, caplog):
    def refuse(*_):
        raise kind("operation not permitted\nand more")

    monkeypatch.setattr("sw_cat_3dgs.fast.plane_graphs.CapturedStep", refuse)
    monkeypatch.setattr(torch.cuda, "device", lambda _: nullcontext())
    fixed = FixedPlaneBits()
    assert all(plane_bits(model, fixed, 1.0)[0] > 0 for _ in range(2))
    assert caplog.messages == ["the planes' bits go on without CUDA graphs: operation not permitted"]


@pytest.mark.cuda
def test_graphs_change_neither_values_nor_gradients(model, little_scene):
    camera, model = little_scene.train[0].camera.to("cuda"), model.to("cuda")
    for rounded in (False, True):
        model.context.rounded = rounded
        model.train_only("all but planes" if rounded else "everything")
        check_replayed(lambda: copy.deepcopy(model), camera, counts=(0, 40, 20), graphs=True)


@pytest.mark.cuda
def test_graphs_of_the_planes_bits_change_nothing(model):
    model = model.to("cuda")
    plain, fixed = FixedPlaneBits(graphs=False), FixedPlaneBits()
    for trained in ("everything", "spatial models"):
        model.train_only(trained)
        for share in (1.0, 0.5):
            for seed in (0, 1):
                bits, slopes = plane_bits(model, plain, share, seed)
                found, again = plane_bits(model, fixed, share, seed)
                torch.testing.assert_close(found, bits, rtol=1e-5, atol=0)
                assert again.keys() == slopes.keys()
                for name, slope in slopes.items():
                    torch.testing.assert_close(again[name], slope, rtol=1e-4, atol=1e-4 * float(slope.abs().max()))
    assert (fixed.captures, fixed._failed) == (4, False)
