"""Models about a local origin and in the world of a georeferenced scene."""

from __future__ import annotations

import pytest
import torch

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.gaussians.model import GaussianModel, as_origin
from splatwizard_core.gaussians.placement import placed_in, with_origin
from splatwizard_core.scene.scene import Protocol, Scene

FAR = (448262.0, 5411933.0, 35.0)


def model_at(offset=(0.0, 0.0, 0.0)):
    means = torch.rand(30, 3, generator=torch.Generator().manual_seed(0)).double() + torch.tensor(offset).double()
    return GaussianModel(
        means.float(),
        torch.zeros(30, 1, 3),
        torch.zeros(30, 0, 3),
        torch.zeros(30),
        torch.zeros(30, 3),
        torch.ones(30, 4),
    )


def scene_at(origin):
    return Scene("s", [], [], None, Protocol("colmap"), origin=origin)


def test_a_model_of_the_world_is_moved_and_a_local_one_is_not():
    local = model_at()
    for model, steps in ((model_at(FAR), 0.5), (model_at(), 1e-6)):  # float32 has steps of 0.5 at 5e6
        placed_in(model, scene_at(FAR))
        torch.testing.assert_close(model.means, local.means, atol=steps, rtol=0)


def test_a_model_that_says_where_it_stands_is_moved_to_the_scenes_origin():
    model = model_at()
    with_origin(model, FAR)
    placed_in(model, scene_at((448260.0, 5411933.0, 30.0)))
    torch.testing.assert_close(model.means, model_at((2.0, 0.0, 5.0)).means)
    assert model.world_origin == (448260.0, 5411933.0, 30.0)


def test_scenes_about_0_leave_models_alone():
    model = model_at()
    before = model.digest()
    assert placed_in(model, scene_at((0.0, 0.0, 0.0))).digest() == before


@pytest.mark.parametrize("value", [None, 3, "abc", [1, 2], [1, 2, "3"], [1.0, 2.0, float("nan")], [True, 1, 2], {}])
def test_what_is_no_origin_is_none(value):
    assert as_origin(value) is None


def test_the_header_keeps_it_apart_from_the_methods_values():
    writer = ContainerWriter("toy", 1)
    writer.static["a"] = 1
    writer.world_origin = FAR
    reader = ContainerReader(writer.to_bytes())
    assert reader.static == {"a": 1}
    assert as_origin(reader.world_origin) == FAR
    assert reader.summary()["static"]["world_origin"] == list(FAR)
