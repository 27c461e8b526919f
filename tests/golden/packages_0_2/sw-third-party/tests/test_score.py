"""The score by hand, and the file of a pruned model."""

import pytest
import torch
from splatwizard_core.api import BitstreamError, ContainerReader, ContainerWriter, SplatOptimizer

from sw_third_party.config import OpacityPruneConfig
from sw_third_party.method import OpacityPrune
from sw_third_party.score import worth
from sw_third_party.stage import OpacityPruneStage


def test_the_faintest_is_worth_least():
    assert worth(torch.tensor([0.5, 0.25, 1])).tolist() == [0.5, 0.25, 1]


def test_half_of_the_gaussians_stay(sw_plugins, sw_scene, sw_gaussians):
    stage = OpacityPruneStage(OpacityPruneConfig(keep=0.5))
    before = sw_gaussians.num_rows
    optimizer = stage.create_optimizer(sw_gaussians, sw_scene)
    assert isinstance(optimizer, SplatOptimizer)
    stage.prune(sw_gaussians, optimizer)
    assert sw_gaussians.num_rows == before - before // 2


def test_another_version_is_refused(sw_plugins, sw_gaussians):
    writer = ContainerWriter(OpacityPrune.name, OpacityPrune.version + 1)
    OpacityPrune(sw_plugins, OpacityPruneConfig()).encode(sw_gaussians, writer)
    with pytest.raises(BitstreamError, match="version"):
        OpacityPrune(sw_plugins, None).decode(ContainerReader(writer.to_bytes()))
