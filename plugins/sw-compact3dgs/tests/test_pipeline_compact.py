"""Compact3DGS on the small procedural scene: it learns, removes Gaussians, resumes, and its file holds all of it."""

import pytest
from compact_models import PLUGINS, decoded, method
from sw_compact3dgs.model import QUANTIZED
from sw_kit import short_training
from sw_kit.short_training import demo, file_of, psnr

from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.training.pipeline import TrainingStopped

pytestmark = pytest.mark.pipeline

STEPS = 160
SMALL = {
    "iterations": STEPS, "lr.max_steps": STEPS, "lr.position_init": 2e-3, "lr.position_final": 2e-5, "lr.scales": 0.02,
    "densify.start": 20, "densify.stop": 80, "densify.interval": 20, "densify.grad_threshold": 1e-3,
    "densify.reset_interval": 10_000, "mask.lr": 0.1, "mask.interval": 20, "grid.levels": 6, "grid.growth": 1.6,
    "grid.log2_size": 10, "network.hidden": 16, "network.warm_up": 10, "network.lr": 0.02,
    "network.lr_steps": [120, 140], "rvq.start": 130, "rvq.size": 32, "rvq.stages": 4,
    "codec.settings.grid_threshold": 0.02,
}  # fmt: skip


@pytest.fixture(scope="module")
def scene():
    return demo()


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(PLUGINS, device="cpu")


def train(scene, rasterizer, directory=None, stop_after=None, **values):
    made = method(**{key.replace(".", "__"): value for key, value in {**SMALL, **values}.items()})
    model, losses = short_training.train(made, scene, rasterizer, directory=directory, stop_after=stop_after)
    return model.eval(), losses, made


@pytest.fixture(scope="module")
def trained(scene, rasterizer):
    """Factor of the mask's weight -> model, losses, method."""
    return {factor: train(scene, rasterizer, **{"mask.factor": factor}) for factor in (1.0, 300.0)}


def test_it_learns_the_scene(scene, rasterizer, trained):
    model, losses, _ = trained[1.0]
    assert len(losses) == STEPS
    assert model.phase == QUANTIZED
    assert psnr(model, scene, rasterizer) > 22
    assert "codebooks" not in losses[128]
    assert "codebooks" in losses[129]
    assert sum(each["l1"] for each in losses[-20:]) < 0.5 * sum(each["l1"] for each in losses[:20])


def test_a_larger_weight_of_the_mask_leaves_fewer_gaussians_and_a_smaller_file(trained):
    (few, _, heavy), (many, _, light) = trained[300.0], trained[1.0]
    assert few.num_rows < 0.8 * many.num_rows
    assert len(file_of(heavy, few)) < len(file_of(light, many))


def test_the_file_holds_what_was_learned(scene, rasterizer, trained):
    model, _, made = trained[1.0]
    found = decoded(file_of(made, model))
    assert found.num_rows == int(model.mask_on().sum())
    assert psnr(found, scene, rasterizer) > psnr(model, scene, rasterizer) - 0.5


def test_an_interrupted_training_ends_as_a_whole_one(scene, rasterizer, tmp_path):
    short = {"iterations": 60, "densify.stop": 40, "rvq.start": 45, "mask.interval": 5}
    whole = train(scene, rasterizer, **short)[0]
    for stop in (25, 50):  # while it densifies; after its codebooks were made
        with pytest.raises(TrainingStopped):
            train(scene, rasterizer, tmp_path, stop, **short)
    assert train(scene, rasterizer, tmp_path, **short)[0].digest() == whole.digest()
