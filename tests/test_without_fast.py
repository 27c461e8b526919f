"""SW_FAST=0 trains with the plain functions alone: a few steps of each anchor method, all phases, both ways."""

import pytest
import torch
from sw_anchors.fast.replay import DECODERS, FixedDecoder
from sw_anchors.native import ANCHORS
from sw_kit.short_training import demo, train

from splatwizard_core.plugins import load_plugins
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.runs.config import resolve
from splatwizard_core.runs.pretrained import make_method
from splatwizard_core.streams import stream

PLUGINS = load_plugins()
SMALL = {
    "iterations": 9, "voxel_size": 0.02, "feature_dim": 8, "num_offsets": 5, "hidden": 16, "growth.start": 2,
    "growth.start_stat": 0, "growth.stop": 5, "growth.interval": 1, "growth.success": 1.0, "rate_term.sample": 0.5,
}  # fmt: skip
GRID = {
    "grid.hidden": 16, "grid.space": [10, 18], "grid.planes": [18, 34], "grid.features": 2, "grid.log2_space": 9,
    "grid.log2_planes": 9, "phases.quantized": 3, "phases.rebound": 4, "phases.entropy": 5,
}  # fmt: skip
PLANS = {
    "hac": {**SMALL, **GRID},
    "hac-plus": {**SMALL, **GRID, "channel.slices": [3, 5], "channel.hidden": 6},
    "cat-3dgs": {
        **SMALL, "context.channels": 4, "context.hidden": 16, "context.slices": [3, 5], "context.slice_hidden": 8,
        "phases.quantize": 2, "phases.triplane": 3, "phases.warmup": 6, "phases.scene": 7, "phases.planes": 8,
    },
}  # fmt: skip


def made(name, **values):
    sets = {**PLANS[name], **values}
    return make_method(PLUGINS, resolve(PLUGINS.methods.load(name), "paper", sets=sets, plugins=PLUGINS))


def trained(name, monkeypatch, fast):
    monkeypatch.setenv("SW_FAST", "1" if fast else "0")
    return train(made(name), demo(), NegotiatedRasterizer(PLUGINS, device="cpu"))


@pytest.mark.pipeline
@pytest.mark.parametrize("name", PLANS)
def test_a_few_steps_are_the_same(name, monkeypatch):
    fast, plain = (trained(name, monkeypatch, fast) for fast in (True, False))
    assert {part for step in plain.losses for part in step} >= {"l1", "volume", "rate"}
    # Float32 sums in another order, which Adam's first steps amplify: its update is a sign where a gradient is small.
    for one, other in zip(fast.losses, plain.losses, strict=True):
        assert one == pytest.approx(other, rel=2e-2, abs=1e-6)
    assert fast.losses[0] == pytest.approx(plain.losses[0], rel=1e-5, abs=1e-8)
    assert fast.model.num_rows == plain.model.num_rows
    assert torch.isfinite(plain.model.features).all()


@pytest.mark.pipeline
@pytest.mark.skipif(ANCHORS.available() is not None, reason=str(ANCHORS.available()))
@pytest.mark.parametrize("name", PLANS)
def test_a_training_prepares_few_steps(name):
    """As on a GPU, where each is two graphs: once per phase, and where a part of the model is another one."""
    ANCHORS.load()
    method, captures = made(name, iterations=20), []

    def model():
        found = method.create_model(demo(), stream(0, "init"))
        DECODERS[found] = FixedDecoder(graphs=False)
        return found

    def on_step(model, record):
        captures.append(DECODERS[model].captures if model in DECODERS else None)

    train(method, demo(), NegotiatedRasterizer(PLUGINS, device="cpu"), model=model, on_step=on_step)
    assert captures[0] == 1
    assert captures[-1] <= 6
    assert captures[10] == captures[-1]  # anchors no longer grow, and phases are over
