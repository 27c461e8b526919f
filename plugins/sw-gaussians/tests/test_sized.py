"""Configs of trainings to a size: what follows from it, and what contradicts it."""

from collections.abc import Mapping
from typing import Any

import pytest
from sw_gaussians.choices import CodecChoice
from sw_gaussians.sized import BYTES, FILLING

from splatwizard_core.api import ConfigError, apply_overrides, parse_size
from splatwizard_core.tooling import load_plugins
from sw_3dgs.config import ThreeDGSConfig

USUAL = {"codec.name": "gaussians-quantized", "codec.settings.dc_step": 0.03}


def completed(values: Mapping[str, Any], usual: Mapping[str, Any] = USUAL) -> ThreeDGSConfig:
    config = apply_overrides(ThreeDGSConfig(), usual, source="rate 'r3'")
    config = apply_overrides(config, values, source="--set")
    sources = {**dict.fromkeys(usual, "rate 'r3'"), **dict.fromkeys(values, "--set")}
    return config.completed(load_plugins(), sources)


def test_a_size_chooses_the_codec_and_the_most_gaussians():
    config = completed({"size": "1.2MB", "density.settings.grad_threshold": 3e-4})
    assert config.codec == CodecChoice(name=FILLING, settings={"size": "1.2MB"})
    assert config.density.name == "budget"
    assert config.density.settings["cap"] == 1_200_000 // BYTES
    assert config.density.settings["score"] == "gradient"
    assert config.density.settings["grad_threshold"] == 3e-4


def test_a_number_of_gaussians_keeps_the_codec():
    config = completed({"gaussians": 5_000})
    assert config.codec.name == "gaussians-quantized"
    assert config.codec.settings["dc_step"] == 0.03
    assert config.density.settings["cap"] == 5_000


@pytest.mark.parametrize("name", ["mcmc", "budget"])
def test_a_control_with_a_cap_of_its_own_stays(name: str):
    config = completed({"density": name, "size": "120kB"})
    assert (config.density.name, config.density.settings["cap"]) == (name, 120_000 // BYTES)


def test_a_cap_that_is_given_holds():
    """Files of runs give it: another size of a trained scene does not train it again."""
    config = completed({"density": "budget", "density.settings.cap": 77, "size": "9kB", "gaussians": 99})
    assert config.density.settings["cap"] == 77


def test_a_completed_config_is_complete():
    config = completed({"size": "800kB"})
    assert config.completed(load_plugins(), {"codec.name": "run.toml", "density.settings.cap": "run.toml"}) == config


def test_the_size_of_a_file_is_no_part_of_the_training():
    assert "size" in ThreeDGSConfig.ENCODING
    assert "gaussians" not in ThreeDGSConfig.ENCODING


def test_nothing_follows_from_no_size():
    config = completed({})
    assert (config.codec.name, config.density.name) == ("gaussians-quantized", "adc")


def test_a_codec_beside_a_size_is_an_error():
    with pytest.raises(ConfigError, match=r"size=1MB chooses the codec: leave out codec\.name"):
        completed({"size": "1MB", "codec.name": "gaussians-exact"})


@pytest.mark.parametrize("size", ["7kilos", "0", "-1"])
def test_what_is_no_size_is_told(size: str):
    with pytest.raises(ConfigError, match="'size' in --set: must be bytes, or a number with kB"):
        completed({"size": size})


def test_sizes_may_be_numbers():
    assert parse_size(completed({"size": "9000"}).size) == 9000
