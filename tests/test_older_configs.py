"""Configuration files that 0.1 wrote are read by every method, and mean the same training and the same file.

tests/golden/configs_0_1 holds the config.toml of a run of each method, with values of its codec and of its pruner that
are not the defaults. The files are never rewritten.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest

from splatwizard_core.cli.main import main
from splatwizard_core.errors import ConfigError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import ResolvedConfig, resolve
from splatwizard_core.runs.identity import stored_config
from splatwizard_core.training.keys import dotted, set_at, value_at
from splatwizard_core.training.params import PipelineParams, SceneParams

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

FOLDER = Path(__file__).parent / "golden" / "configs_0_1"
BESIDE = {"method", "preset", "rate", "scene", *PipelineParams.model_fields, *SceneParams.model_fields}
MEANS: dict[str, dict[str, Any]] = {
    "3dgs": {"codec.name": "gaussians-quantized", "codec.settings.dc_step": 0.1, "codec.settings.position_bits": 14},
    "hac": {"codec.settings.mode": "float", "codec.settings.weights": "float16"},
    "cat-3dgs": {"codec.settings.mode": "float", "codec.settings.weights": "float16"},
    "lightgaussian": {
        "prune.settings.v_pow": 0.2, "score.settings.v_pow": 0.2, "codec.name": "vectree", "codec.settings.ratio": 0.8,
        "codec.settings.training": "kmeans", "codec.settings.size": 64,
    },
    "pup-3dgs": {"prune.settings.resolution": 2, "codec.name": "gaussians-zstd", "codec.settings": {}},
    "speedy-splat": {"prune.settings.channel_mode": "per_channel", "codec.name": "gaussians-ply"},
    "trimming-the-fat": {"codec.name": "gaussians-zstd", "prune.settings": {}},
    "chimerags": {
        "score.settings.v_pow": 0.3, "codec.sh2": {"ratio": 0.5}, "codec.sh3": {"ratio": 0.6},
        "codec.settings.size": 128, "codec.settings.training": "kmeans",
    },
}  # fmt: skip
"""Method -> values of today's keys that its file stands for."""


def read(name: str, **sets: Any) -> ResolvedConfig:
    values = {key.replace("__", "."): value for key, value in sets.items()}
    return resolve(load_plugins().methods.load(name), config_file=FOLDER / f"{name}.toml", sets=values)


def test_there_is_a_file_of_every_method_that_0_1_had():
    assert {path.stem for path in FOLDER.glob("*.toml")} == set(MEANS)


@pytest.mark.parametrize("name", MEANS)
def test_an_older_file_means_what_it_meant(name: str):
    config = read(name).config
    assert {key: value_at(config, key) for key in MEANS[name]} == MEANS[name]


@pytest.mark.parametrize("name", MEANS)
def test_a_training_is_known_by_the_values_that_0_1_hashed(name: str):
    """Checkpoints of 0.1 hold these values under these keys: they are those of the same training today."""
    old = {k: v for k, v in tomllib.loads((FOLDER / f"{name}.toml").read_text()).items() if k not in BESIDE}
    nested: dict[str, Any] = {}
    for key, value in dotted(old, "").items():  # in JSON, where the file says "none" but for a word of its own
        set_at(nested, key, None if value == "none" and key != "bound_margin" else value)
    stored = {"method": name, "config": nested, "pipeline": {}, "scene": {}}
    assert stored_config(load_plugins(), stored, absent=True).given == read(name).given


@pytest.mark.parametrize("name", MEANS)
def test_what_is_written_now_is_read_back_to_the_same_run(name: str, tmp_path: Path):
    first = read(name)
    (tmp_path / "config.toml").write_text(first.toml())
    again = resolve(load_plugins().methods.load(name), config_file=tmp_path / "config.toml")
    assert again.config == first.config
    assert (again.training_hash(), again.config_hash()) == (first.training_hash(), first.config_hash())
    assert "vq_" not in first.toml()


def test_older_keys_work_on_the_command_line_and_typos_in_them_are_told():
    assert read("pup-3dgs", prune__resolution="1").config.prune.settings == {"resolution": 1}
    assert read("3dgs", codec__mode="exact").config.codec.settings == {}
    with pytest.raises(ConfigError, match=r"unknown key 'prune\.resolutio'"):
        read("pup-3dgs", prune__resolutio="1")
    with pytest.raises(ConfigError, match=r"unknown key 'vq\.siz'"):
        read("chimerags", vq__siz="1")


@pytest.mark.parametrize("name", MEANS)
def test_a_plan_is_printed_from_an_older_file(name: str, capsys: pytest.CaptureFixture[str]):
    assert main(["schedule", name, "--config", str(FOLDER / f"{name}.toml"), "--json"]) == 0
    assert '"plan"' in capsys.readouterr().out


def test_another_rate_point_of_an_older_run_changes_what_that_point_sets(tmp_path: Path):
    from splatwizard_core.cli.setup import Choices

    run = tmp_path / "3dgs"
    run.mkdir()
    (run / "config.toml").write_text((FOLDER / "3dgs.toml").read_text())
    plugins = load_plugins()
    codecs = [Choices(rate=rate).with_rate_of(run, plugins).resolve_one(plugins).config.codec for rate in ("r1", "r6")]
    assert [codec.name for codec in codecs] == ["gaussians-quantized", "gaussians-exact"]
    assert (codecs[0].settings["dc_step"], codecs[1].settings) == (0.2, {})
    named = Choices(rate="r1", sets=("codec=gaussians-zstd",)).with_rate_of(run, plugins).resolve_one(plugins)
    assert (named.config.codec.name, named.config.codec.settings) == ("gaussians-zstd", {})
