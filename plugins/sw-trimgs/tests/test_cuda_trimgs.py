"""On a GPU: the same scores as on a CPU, and files that a CPU decodes to what was trained."""

import copy

import pytest
import torch
from sw_gaussians.surfels import SurfelModel

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import apply_overrides
from splatwizard_core.training.params import PipelineParams
from splatwizard_core.training.pipeline import TrainingRun
from sw_trimgs.config import Trim3DGSConfig
from sw_trimgs.contribution import Contribution
from sw_trimgs.flat import FlatGaussians
from sw_trimgs.method import Trim3DGS

pytestmark = pytest.mark.cuda

SHORT = {"iterations": 12, "densify.interval": 2, "trim.interval": 4, "trim.after": 2, "densify.mode": "mix"}


@pytest.fixture(scope="module")
def gpu(plugins):
    return NegotiatedRasterizer(plugins, device="cuda")


@pytest.mark.parametrize("surfels", [False, True])
def test_scores_are_those_of_a_cpu(gpu, rasterizer, toy, surfels):
    model = copy.deepcopy(toy.truth)
    if surfels:
        tensors = {name: each.detach() for name, each in model.named_parameters()}
        tensors["log_scales"] = tensors["log_scales"][:, :2].contiguous()
        model = SurfelModel(**tensors)
    cameras = [view.camera for view in toy.scene.train]
    ours = Contribution().score(copy.deepcopy(model).cuda(), cameras, gpu)
    assert ours.is_cuda
    theirs = Contribution().score(model, cameras, rasterizer)
    # A pixel at the rim of a splat may be in on one device and out on the other.
    assert torch.allclose(ours.cpu().clamp_min(0), theirs.clamp_min(0), atol=0.02)


def test_what_a_gpu_trains_a_cpu_decodes(plugins, gpu, toy):
    method = Trim3DGS(plugins, apply_overrides(Trim3DGSConfig(), SHORT, source="test").completed(plugins, {}))
    model = (
        TrainingRun(
            list(method.stages()), lambda: None, toy.scene, PipelineParams(), gpu, identity={}, directory=None,
            trained=lambda name: copy.deepcopy(toy.truth).cuda(),
        )
        .train()
        .model
    )  # fmt: skip
    assert isinstance(model, FlatGaussians)
    assert model.device.type == "cuda"
    writer = ContainerWriter(method.name, method.version)
    method.encode(model, writer)
    found = Trim3DGS(plugins, None).decode(ContainerReader(writer.to_bytes(), "file.swz"))
    assert torch.equal(found.means, model.means.cpu())
