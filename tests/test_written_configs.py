"""What a run writes into config.toml is read back to the same values, for every method of ours, and encodes again."""

from __future__ import annotations

from pathlib import Path

import pytest

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours
from splatwizard_core.runs.config import ResolvedConfig, resolve

METHODS = [entry.name for entry in load_plugins().methods if is_ours(entry.distribution)]
# Values of the run and the scene that no preset sets, one of them None.
BESIDES = {
    "seed": 7, "raster.prefer": ["reference"], "random_background": True, "resolution": 4, "split": "every5",
    "images": None, "background": "white", "scale_schedule": True, "iterations": 123, "raster.profile": "3dgs",
    "raster.antialias": False, "raster.eps2d": 0.1, "deterministic": True,
}  # fmt: skip
SMALL_ANCHORS = {
    "voxel_size": 0.03, "feature_dim": 8, "num_offsets": 4, "hidden": 12, "growth.start_stat": 5, "growth.start": 20,
    "growth.interval": 10, "growth.pause_start": 30, "growth.pause_end": 40,
}  # fmt: skip
TINY = {
    "hac": {
        **SMALL_ANCHORS, "iterations": 70, "lr.max_steps": 70, "growth.stop": 40, "grid.hidden": 12,
        "grid.space": [10, 18], "grid.planes": [18, 34], "grid.features": 2, "grid.log2_space": 9,
        "grid.log2_planes": 9, "phases.quantized": 45, "phases.rebound": 54, "phases.entropy": 55,
    },
    "cat-3dgs": {
        **SMALL_ANCHORS, "iterations": 70, "lr.max_steps": 70, "growth.stop": 50, "context.channels": 4,
        "context.hidden": 12, "context.slices": [2, 6], "context.slice_hidden": 8, "context.neighbors": 20,
        "phases.quantize": 30, "phases.triplane": 40, "phases.warmup": 50, "phases.scene": 55, "phases.planes": 60,
    },
}  # fmt: skip
"""Method -> values of a training of seconds that goes through every phase."""


def contents(config: ResolvedConfig) -> dict[str, object]:
    """All values; where they were set is another thing in a file."""
    return {**config.as_dict(), "provenance": None, "scene_spec": config.scene_spec}


@pytest.mark.parametrize("name", METHODS)
def test_a_written_configuration_is_read_back_to_the_same_values(tmp_path: Path, name: str):
    method = load_plugins().methods.load(name)
    presets, rates, path = list(method.PRESETS), list(method.RATES), tmp_path / "config.toml"
    chosen = [(preset, rates[-1], {}) for preset in presets] + [(presets[0], rate, BESIDES) for rate in rates]
    for preset, rate, sets in chosen:
        first = resolve(method, preset, rate, sets=sets, scene="demo:tiny")
        path.write_text(first.toml())
        again = resolve(method, config_file=path)
        assert contents(again) == contents(first)
        assert again.training_hash() == first.training_hash()


@pytest.mark.pipeline
@pytest.mark.parametrize("name", TINY)
def test_a_run_of_an_anchor_method_encodes_again_from_its_directory(tmp_path: Path, monkeypatch, name: str):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    sets = [f"--set={key}={value}" for key, value in TINY[name].items()]
    out = tmp_path / "out"
    assert main(["train", "--method", name, "--scene", "demo:tiny", "--device", "cpu", "--out", str(out), *sets]) == 0
    (run,) = (path.parent for path in out.rglob("config.toml"))
    sizes = []
    for asked in ([], ["--set", "codec.settings.weights=float32"]):
        file = tmp_path / f"{len(sizes)}.swz"
        assert main(["encode", str(run), "--device", "cpu", "--out", str(file), *asked]) == 0
        sizes.append(file.stat().st_size)
    assert 1000 < sizes[0] < sizes[1]
