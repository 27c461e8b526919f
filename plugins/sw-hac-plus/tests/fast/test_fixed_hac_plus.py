"""A training step of HAC++ in tensors of fixed sizes, as a GPU replays it, equals that on any number of anchors."""

import copy

import pytest
import torch
from hac_plus_models import make
from sw_anchors.testing import check_plain, check_replayed
from sw_reference.testing.raster_scenes import front_camera

N = 150


def trained(device="cpu", **values):
    model = make(N, **values).to(device)
    with torch.no_grad():
        for parameter in model.mlp_opacity.parameters():
            parameter.mul_(3)  # opacities of both signs
    return model.requires_grad_(True)


@pytest.mark.parametrize(("channel", "counts"), [("full", (0, 90)), ("none", (60,))])
def test_fixed_sizes_change_neither_values_nor_gradients(channel, counts):
    check_replayed(lambda: trained(channel__kind=channel), front_camera(), counts=counts)
    check_plain(lambda: trained(channel__kind=channel), front_camera(), counts=counts)


@pytest.mark.cuda
def test_graphs_change_neither_values_nor_gradients():
    model = trained("cuda")
    check_replayed(lambda: copy.deepcopy(model), front_camera().to("cuda"), counts=(0, 90, 60), graphs=True)
