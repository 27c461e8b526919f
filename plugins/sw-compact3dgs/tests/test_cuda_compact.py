"""Compact3DGS on CUDA: the same colours and shapes, a file that either device writes and the other reads."""

import pytest
import torch
from compact_models import decoded, encoded, generator, make
from sw_compact3dgs.decoded import DecodedGaussians
from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_scenes import front_camera

pytestmark = pytest.mark.cuda

RASTERIZER = ReferenceRasterizer()


def test_a_model_gives_the_same_file_on_either_device():
    on_cpu, on_cuda = encoded(make()), encoded(make().cuda())
    assert on_cpu == on_cuda
    assert decoded(on_cuda).digest() == decoded(on_cpu).digest()


def test_a_decoded_file_has_the_same_values_on_either_device_and_colours_up_to_rounding():
    found, cam = decoded(encoded(make())), front_camera()
    moved = decoded(encoded(make())).cuda()
    assert isinstance(moved, DecodedGaussians)
    assert moved.digest() == found.digest()
    for model in (found, moved):
        model.prepare()
    with torch.no_grad():
        here, there = found.gaussians(cam, RASTERIZER), moved.gaussians(cam.to("cuda"), RASTERIZER)
    torch.testing.assert_close(there.sh.dc.cpu(), here.sh.dc, atol=2e-4, rtol=1e-4)  # half of a TF32 product apart


def test_gradients_agree():
    grads = []
    for device in ("cpu", "cuda"):
        model, cam = make().to(device), front_camera().to(device)
        inputs = model.gaussians(cam, RASTERIZER)
        target = torch.randn(inputs.sh.dc.shape, generator=generator(3)).to(device)
        loss = (inputs.sh.dc * target).sum() + inputs.scales.sum() + inputs.opacities.sum() + inputs.extras["codebooks"]
        loss.backward()
        grads.append({name: p.grad.cpu() for name, p in model.named_parameters() if p.grad is not None})
    assert set(grads[0]) == set(grads[1])
    for name, grad in grads[0].items():
        torch.testing.assert_close(grads[1][name], grad, atol=2e-4, rtol=2e-3, msg=name)
