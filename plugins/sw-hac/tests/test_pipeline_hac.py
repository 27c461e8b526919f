"""HAC on the small procedural scene: it learns, trades bytes for quality, resumes; its file holds what it learned."""

import pytest
import torch
from hac_models import PLUGINS, decoded, lattice_of, method
from sw_anchors.coded_anchors import ENTROPY
from sw_kit import short_training
from sw_kit.short_training import demo, file_of, psnr

from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.training.pipeline import TrainingStopped
from sw_hac import codec

pytestmark = pytest.mark.pipeline

STEPS = 170
SMALL = {
    "iterations": STEPS, "voxel_size": 0.02, "feature_dim": 8, "num_offsets": 5, "hidden": 16, "grid.hidden": 16,
    "grid.space": [10, 18], "grid.planes": [18, 34], "grid.features": 2, "grid.log2_space": 9, "grid.log2_planes": 9,
    "phases.quantized": 40, "phases.rebound": 79, "phases.entropy": 80, "growth.start": 30, "growth.stop": 120,
    "growth.pause_start": 1000, "growth.pause_end": 1001, "growth.interval": 20, "growth.start_stat": 10,
    "growth.grad_threshold": 2e-3, "growth.init_factor": 4, "lr.max_steps": STEPS, "lr.features": 0.03,
    "lr.masks_final": 4e-3, "lr.grid_final": 1e-3, "lr.mlp_grid_final": 1e-3, "rate_term.start": "statistics",
    "rate_term.units": "steps", "steps.scales": 0.004,
}  # fmt: skip
WEIGHTS = (0.001, 0.03)


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
    """Weight of the rate -> model, losses, method."""
    return {weight: train(scene, rasterizer, **{"rate_term.weight": weight}) for weight in WEIGHTS}


def test_it_learns_the_scene_and_the_rate(scene, rasterizer, trained):
    model, losses, _ = trained[WEIGHTS[0]]
    assert len(losses) == STEPS
    assert model.phase == ENTROPY
    assert psnr(model, scene, rasterizer) > 22

    def mean(name, steps):
        found = [losses[s][name] for s in steps if name in losses[s]]
        return sum(found) / len(found)

    assert mean("l1", range(STEPS - 20, STEPS)) < 0.6 * mean("l1", range(20))
    assert "rate" not in losses[79]
    losses = trained[WEIGHTS[-1]][1]
    assert mean("rate", range(STEPS - 20, STEPS)) < 0.8 * mean("rate", range(80, 90))


def test_a_larger_weight_gives_a_smaller_and_worse_file(scene, rasterizer, trained):
    sizes, quality = [], []
    for model, _, made in trained.values():
        data = file_of(made, model)
        sizes.append(len(data))
        quality.append(psnr(decoded(data), scene, rasterizer))
    assert sizes[0] > sizes[1]
    assert quality[0] > quality[1]


def test_the_file_holds_what_was_learned(scene, rasterizer, trained):
    model, _, made = trained[WEIGHTS[0]]
    data = file_of(made, model)
    found = decoded(data)
    assert found.counts() == model.counts()
    assert psnr(found, scene, rasterizer) > psnr(model, scene, rasterizer) - 0.2


def test_estimates_of_a_trained_model_are_its_size(trained):
    model, _, made = trained[WEIGHTS[0]]
    lattice, writer = lattice_of(model)
    assert writer.to_bytes() == file_of(made, model)
    sections = writer.sections
    size = 8 * sum(sections[name] for name in codec.SECTIONS.values())
    assert size == pytest.approx(lattice.bits, rel=0.01)
    rows = torch.nonzero(model.kept()).squeeze(1)
    numbers = len(rows) * (8 + 6 + 15)
    model.train()
    try:
        with torch.no_grad():
            sampled = [float(model.attributes(rows).extras["rate"].bits) for _ in range(40)]
            grids = float(model.grid.with_bits(*model.context_of(rows[:1]))[1])
    finally:
        model.eval()
    assert sum(sampled) / 40 * numbers == pytest.approx(size, rel=0.03)
    # 22 bytes of framing; the estimate counts 32 bits for the share of ones.
    assert 8 * (sections["grids"] - 22) == pytest.approx(grids - 32, rel=0.05)


def test_an_interrupted_training_ends_as_a_whole_one(scene, rasterizer, tmp_path):
    short = {"iterations": 60, "phases.quantized": 20, "phases.rebound": 29, "phases.entropy": 30, "growth.stop": 55}
    whole = train(scene, rasterizer, **short)[0]
    for stop in (25, 45):  # in the second phase; in the third, between two adjustments
        with pytest.raises(TrainingStopped):
            train(scene, rasterizer, tmp_path, stop, **short)
    assert train(scene, rasterizer, tmp_path, **short)[0].digest() == whole.digest()
