"""The pruning rule by hand, and the file round trip."""

import torch
from sw_third_party.method import OpacityPrune, OpacityPruneConfig, most_opaque

from splatwizard_core.api import ContainerReader, ContainerWriter, GaussianModel
from splatwizard_core.tooling import load_plugins


def test_the_most_opaque_half_stays():
    assert most_opaque(torch.tensor([0.1, -2.0, 3.0, 0.5]), 0.5).tolist() == [False, False, True, True]


def test_ties_go_to_the_lower_index_and_one_gaussian_always_stays():
    assert most_opaque(torch.zeros(4), 0.01).tolist() == [True, False, False, False]


def test_decode_needs_only_the_file():
    rows = 5
    generator = torch.Generator().manual_seed(0)
    shapes = {
        "means": (3,),
        "sh_dc": (1, 3),
        "sh_rest": (15, 3),
        "opacity_logits": (),
        "log_scales": (3,),
        "quats": (4,),
    }
    model = GaussianModel.from_tensors(
        **{name: torch.randn(rows, *shape, generator=generator) for name, shape in shapes.items()}
    )
    writer = ContainerWriter(OpacityPrune.name, OpacityPrune.version)
    OpacityPrune(load_plugins(), OpacityPruneConfig()).encode(model, writer)
    decoded = OpacityPrune(load_plugins(), None).decode(ContainerReader(writer.to_bytes(), "memory"))
    for name in shapes:
        assert torch.equal(getattr(decoded, name), getattr(model, name).half().float())
