"""HAC++ on the small procedural scene: it learns, its rate prunes, it resumes; its file holds what it learned."""

import pytest
import torch
from hac_plus_models import PLUGINS, decoded, method, recorded
from sw_anchors.coded_anchors import ENTROPY
from sw_kit import short_training
from sw_kit.short_training import demo, file_of, psnr

from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.method import create_method
from splatwizard_core.rendering.negotiation import NegotiatedRasterizer
from splatwizard_core.training.pipeline import TrainingStopped
from sw_codecs.entropy.further_rates import mixture_bits
from sw_codecs.entropy.rows import RowMixture

pytestmark = pytest.mark.pipeline

STEPS = 160
SMALL = {
    "iterations": STEPS, "voxel_size": 0.02, "feature_dim": 8, "num_offsets": 5, "hidden": 16, "grid.hidden": 16,
    "grid.space": [10, 18], "grid.planes": [18, 34], "grid.features": 2, "grid.log2_space": 9, "grid.log2_planes": 9,
    "phases.quantized": 30, "phases.rebound": 49, "phases.entropy": 50, "growth.start": 20, "growth.stop": 80,
    "growth.pause_start": 1000, "growth.pause_end": 1001, "growth.interval": 20, "growth.start_stat": 10,
    "growth.grad_threshold": 2e-3, "growth.init_factor": 4, "lr.max_steps": STEPS, "lr.features": 0.03,
    "lr.masks_init": 0.1, "lr.masks_final": 0.1, "lr.grid_final": 1e-3, "lr.mlp_grid_final": 1e-3,
    "lr.channel_final": 2e-3, "rate_term.start": "statistics", "rate_term.units": "steps", "steps.scales": 0.004,
    "channel.slices": [4, 4], "channel.hidden": 8, "rate_term.sample": 0.5,
}  # fmt: skip
WEIGHTS = (0.001, 0.05)


@pytest.fixture(scope="module")
def scene():
    return demo()


@pytest.fixture(scope="module")
def rasterizer():
    return NegotiatedRasterizer(PLUGINS, device="cpu")


def train(scene, rasterizer, directory=None, stop_after=None, **values):
    made = method(**{**SMALL, **values})
    model, losses = short_training.train(made, scene, rasterizer, directory=directory, stop_after=stop_after)
    return model.eval(), losses, made


@pytest.fixture(scope="module")
def trained(scene, rasterizer):
    """Weight of the rate -> model, losses, method."""
    return {weight: train(scene, rasterizer, **{"rate_term.weight": weight}) for weight in WEIGHTS}


def test_it_learns_the_scene_and_the_rate(scene, rasterizer, trained):
    model, losses, _ = trained[WEIGHTS[0]]
    assert model.phase == ENTROPY
    assert psnr(model, scene, rasterizer) > 22
    assert "rate" not in losses[49]
    losses = [step["rate"] for step in trained[WEIGHTS[-1]][1] if "rate" in step]
    assert sum(losses[-10:]) < 0.6 * sum(losses[:10])


def test_a_larger_weight_prunes_and_gives_a_smaller_and_worse_file(scene, rasterizer, trained):
    counts, files, quality = [], [], []
    for model, _, made in trained.values():
        data = file_of(made, model)
        counts.append(model.counts()["num_gaussians"])
        files.append(ContainerReader(data))
        quality.append(psnr(decoded(data), scene, rasterizer))
    assert counts[1] < 0.9 * counts[0]
    for name in ("features.1", "features.2", "offsets"):
        sizes = [reader.sections[name] for reader in files]
        assert sizes[0] > sizes[1], name
    assert quality[0] > quality[1]


def test_the_file_holds_what_was_learned(scene, rasterizer, trained):
    model, _, made = trained[WEIGHTS[0]]
    data = file_of(made, model)
    found = decoded(data)
    assert found.counts() == model.counts()
    assert psnr(found, scene, rasterizer) > psnr(model, scene, rasterizer) - 0.2
    reader = ContainerReader(data)
    size = 8 * sum(reader.sections[name] for name in ("features.1", "features.2", "scalings", "offsets"))
    model.train()
    try:
        with torch.no_grad():
            rows = torch.arange(2)
            sampled = [model.attributes(rows).extras["rate"] for _ in range(40)]
    finally:
        model.eval()
    numbers = model.num_rows * (8 + 6 + 15)
    assert sum(float(rate.bits) for rate in sampled) / 40 * numbers == pytest.approx(size, rel=0.06)


def test_the_file_is_as_small_as_the_mixtures_of_a_trained_model_ask_for(trained):
    model, _, made = trained[WEIGHTS[0]]
    estimate = tables = 0.0
    recorder, _ = recorded(model)
    for symbols, context in recorder.mixed:
        wide = {name: torch.as_tensor(value).double() / 4096 for name, value in vars(context).items()}
        bits = mixture_bits(
            symbols * wide["step"],
            torch.stack([wide["logit"], torch.zeros_like(wide["logit"])], dim=-1),
            torch.stack([wide["mean"], wide["second_mean"]], dim=-1),
            torch.stack([wide["scale"], wide["second_scale"]], dim=-1).clamp(min=1e-9),
            wide["step"],
            p_min=1e-12,
        )
        estimate += float(bits.sum())
        tables += float(recorder.further[RowMixture].bits(symbols, context).sum())
    assert estimate < tables < 1.002 * estimate
    sections = ContainerReader(file_of(made, model)).sections
    size = 8 * sum(sections[name] for name in ("features.1", "features.2"))
    assert size - tables < 2 * 8 * 20  # framing and checksums: of so small a section they are most of the difference


@pytest.mark.slow
@pytest.mark.skipif("hac" not in PLUGINS.methods, reason="needs sw-hac")
def test_a_file_of_hac_plus_is_smaller_than_one_of_hac_and_no_worse(scene, rasterizer):
    """Without the networks, which are most of so small a file; a plan of 240 steps, the same for both.

    Not at equal lambda: the rate of HAC++ pulls in each step at anchors that the view does not see, so that the same
    lambda is further down its curve (measured once, at 0.001: 0.3 dB below HAC in 0.74 of the bytes).
    """
    plan = {key: value for key, value in SMALL.items() if not key.startswith("channel.")} | {
        "iterations": 240, "lr.max_steps": 240, "phases.quantized": 40, "phases.rebound": 79, "phases.entropy": 80,
        "growth.start": 30, "growth.stop": 120, "rate_term.sample": 0.05, "lr.masks_init": 0.01, "lr.masks_final": 4e-3,
    }  # fmt: skip
    del plan["lr.channel_final"]
    own = {"channel.slices": [4, 4], "channel.hidden": 8, "lr.channel_final": 2e-3, "rate_term.sample": 0.5}
    sizes, quality = [], []
    for name, values in (("hac", {"rate_term.weight": 0.004}), ("hac-plus", {"rate_term.weight": 0.001, **own})):
        made = create_method(PLUGINS, name, {**plan, **values})
        model = short_training.train(made, scene, rasterizer).model.eval()
        reader = ContainerReader(file_of(made, model))
        sizes.append(sum(reader.sections.values()) - reader.sections["networks"])
        quality.append(psnr(made.decode(reader), scene, rasterizer))
    assert sizes[1] < 0.95 * sizes[0], sizes
    assert quality[1] > quality[0], quality


def test_an_interrupted_training_ends_as_a_whole_one(scene, rasterizer, tmp_path):
    short = {"iterations": 40, "phases.quantized": 10, "phases.rebound": 19, "phases.entropy": 20, "growth.stop": 35}
    whole = train(scene, rasterizer, **short)[0]
    with pytest.raises(TrainingStopped):
        train(scene, rasterizer, tmp_path, 25, **short)
    assert train(scene, rasterizer, tmp_path, **short)[0].digest() == whole.digest()
