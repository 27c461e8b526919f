"""`sw config`: what it lists is what --set takes."""

from __future__ import annotations

import json
from typing import Annotated, Literal

import pytest
from click.testing import CliRunner
from pydantic import BaseModel, Field
from sw_kit.config_command import blocks, config, row, type_name

from splatwizard_core.api import ConfigError
from splatwizard_core.tooling import load_plugins, resolve


@pytest.mark.parametrize(("method", "rate"), [("3dgs", "r3"), ("lightgaussian", None)])
def test_every_key_is_taken_with_the_value_that_is_told(method, rate):
    plugins = load_plugins()
    told = {each["key"]: each["value"] for _, rows in blocks(method, None, rate) for each in rows}
    assert {"iterations", "seed", "resolution", "raster.prefer", "codec.name", "metrics.lpips.weights"} <= set(told)
    own = {key: value for key, value in told.items() if not key.startswith("metrics.") and value not in ("", "none")}
    found = resolve(plugins.methods.load(method), "paper", rate, sets=own, plugins=plugins)
    plain = resolve(plugins.methods.load(method), "paper", rate, plugins=plugins)
    assert (found.config, found.ppl, found.scene) == (plain.config, plain.ppl, plain.scene)
    with pytest.raises(ConfigError, match="no preset 'papr'"):
        list(blocks(method, "papr", None))


def test_every_key_has_a_meaning_and_numbers_have_bounds():
    rows = {each["key"]: each for _, part in blocks("3dgs", "inria", "r2") for each in part}
    assert [key for key, each in rows.items() if not each["meaning"] and not key.startswith("metrics.")] == []
    assert rows["density.settings.start"]["value"] == "600"
    assert rows["codec.settings.position_bits"] == {
        "key": "codec.settings.position_bits", "value": "14", "type": "int", "bounds": ">= 8, <= 21",
        "meaning": "bits per axis of the position grid",
    }  # fmt: skip


def test_types_and_bounds_are_spelled_for_people():
    class Block(BaseModel):
        share: Annotated[float, Field(gt=0, lt=1, description="of all")] | None = Field(
            0.5, ge=0.25, description="part"
        )

    told = row("share", 0.5, Block.model_fields["share"])
    assert (told["type"], told["bounds"], told["meaning"]) == ("float or none", ">= 0.25", "part")
    assert type_name(Literal["a", "b"] | None) == "a | b or none"
    assert type_name(list[str]) == "list of text"
    assert row("on", True, None)["value"] == "true"


def test_the_command_prints_a_table_or_json():
    done = CliRunner().invoke(config, ["3dgs", "--only", "density.settings.absgrad"])
    assert done.exit_code == 0
    assert "sum absolute pixel gradients" in done.output
    done = CliRunner().invoke(config, ["3dgs", "--only", "seed", "--json"])
    assert [each["key"] for each in json.loads(done.output)["keys"]["run"]] == ["seed"]
