"""Speedy-Splat on the small procedural scene: fewer Gaussians, resumed bit for bit, and a file that holds them."""

import pytest
import torch
from sw_kit import short_training

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.errors import BitstreamError
from splatwizard_core.method import create_method
from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.training.pipeline import TrainingStopped
from sw_speedy_splat.method import SpeedySplat

pytestmark = pytest.mark.pipeline

SHORT = {
    "iterations": 120, "prune.start": 30, "prune.interval": 30, "prune.stop": 110, "prune.soft": 0.3,
    "base.densify.start": 10, "base.densify.interval": 10, "base.densify.stop": 70, "base.densify.reset_interval": 1000,
    "base.densify.grad_threshold": 4e-4, "base.lr.max_steps": 2000,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return short_training.demo()


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(load_plugins(), device="cpu")


def train(scene, rasterizer, directory=None, stop_after=None, **sets):
    method = SpeedySplat(load_plugins(), resolve(SpeedySplat, "quick", sets={**SHORT, **sets}).config)
    return short_training.train(method, scene, rasterizer, directory=directory, stop_after=stop_after)


@pytest.fixture(scope="module")
def trained(scene, rasterizer):
    return train(scene, rasterizer)


def test_it_ends_with_fewer_gaussians_than_3dgs_alone(scene, rasterizer, trained):
    values = {key.removeprefix("base."): value for key, value in SHORT.items() if not key.startswith("prune")}
    plain = create_method(load_plugins(), "3dgs", values, preset="quick")
    alone = short_training.train(plain, scene, rasterizer)
    assert trained.model.num_rows < alone.model.num_rows / 2
    assert all(bool(torch.isfinite(parameter).all()) for parameter in trained.model.parameters())


def test_without_removals_it_is_3dgs_bit_for_bit(scene, rasterizer):
    short = {"iterations": 40}
    ours = train(scene, rasterizer, **short, **{"prune.soft": 0.0, "prune.hard": 0.0})
    values = {key.removeprefix("base."): value for key, value in SHORT.items() if not key.startswith("prune")}
    plain = create_method(load_plugins(), "3dgs", {**values, **short}, preset="quick")
    alone = short_training.train(plain, scene, rasterizer)
    assert ours.model.digest() == alone.model.digest()


def test_a_run_that_is_stopped_between_removals_ends_in_the_same_bits(scene, rasterizer, trained, tmp_path):
    with pytest.raises(TrainingStopped):
        train(scene, rasterizer, directory=tmp_path, stop_after=50)
    resumed = train(scene, rasterizer, directory=tmp_path)
    assert resumed.model.digest() == trained.model.digest()


def written(model, **sets) -> bytes:
    writer = ContainerWriter("speedy-splat", SpeedySplat.version)
    SpeedySplat(load_plugins(), resolve(SpeedySplat, "quick", sets=sets).config).encode(model, writer)
    return writer.to_bytes()


def test_the_file_holds_the_model_bit_for_bit_and_any_codec_of_gaussians_may_write_it(trained):
    decoded = SpeedySplat(load_plugins(), None).decode(ContainerReader(written(trained.model)))
    for (name, ours), (_, theirs) in zip(trained.model.named_parameters(), decoded.named_parameters(), strict=True):
        assert torch.equal(ours, theirs), name
    small = written(trained.model, codec="gaussians-quantized")
    assert len(small) < len(written(trained.model)) / 3
    assert SpeedySplat(load_plugins(), None).decode(ContainerReader(small)).num_rows > 0


def test_files_of_other_layouts_are_refused(trained):
    writer = ContainerWriter("speedy-splat", SpeedySplat.version)
    SpeedySplat(load_plugins(), resolve(SpeedySplat, "quick").config).encode(trained.model, writer)
    writer.version = 0
    with pytest.raises(BitstreamError, match="layout version"):
        SpeedySplat(load_plugins(), None).decode(ContainerReader(writer.to_bytes()))
    writer.version, writer.static["codec"] = 1, "range"
    with pytest.raises(BitstreamError, match="codec"):
        SpeedySplat(load_plugins(), None).decode(ContainerReader(writer.to_bytes()))


def test_what_it_does_not_encode_is_told():
    method = SpeedySplat(load_plugins(), resolve(SpeedySplat).config)
    with pytest.raises(TypeError, match="GaussianModel"):
        method.encode(torch.nn.Module(), ContainerWriter("speedy-splat", 1))
