"""Checks of methods can fail: on declarations, rate points and published figures that do not fit."""

from __future__ import annotations

import sys

import pytest
from sw_kit.checks import rate_points
from sw_kit.checks.fields import check_entry
from sw_kit.checks.methods import check_configuration
from sw_kit.checks.published import check_published
from sw_kit.checks.rate_points import check_rate_points
from sw_kit.checks.small_run import _check_encoding, _lengths
from sw_kit.finding import BrokenContractError
from sw_kit.samples import some_gaussians

from splatwizard_core.api import (
    Method,
    OptimizationParams,
    Params,
    Stage,
)
from splatwizard_core.tooling import Entry, load_plugins

PLUGINS = load_plugins()


class Config(OptimizationParams):
    strength: float = 1.0


class BadMethod(Method):
    name = "bad-thing"
    Config = OptimizationParams

    def stages(self):
        return [Stage(self.config)]

    def create_model(self, scene, generator):
        return some_gaussians()

    def encode(self, model, writer):
        model.means.data += 1

    def decode(self, reader):
        return some_gaussians()


class BadTask(Stage):
    def register_post_task(self, scheduler, ppl, opt):
        scheduler.register_task(1, self.prune)

    def prune(self, model):
        pass


@pytest.mark.parametrize(
    ("changes", "declared", "said"),
    [({"name": "other"}, {}, "called 'other'"), ({}, {"rates": ["r1", "r2"]}, "rates are declared"),
     ({"PRESETS": {"paper": {}}}, {"presets": ["paper"]}, "no preset quick"),
     ({"DEFAULT_RATE": "r9"}, {}, "DEFAULT_RATE is 'r9'"), ({"Config": Config}, {}, "no description of strength"),
     ({"RATES": {"r1": {"no_such_key": 1}}}, {}, "no_such_key"),
     ({"stages": lambda self: []}, {}, "return one or more"),
     ({"stages": Method.stages}, {}, r"no stages\(\) -> def stages\(self\): return"),
     ({"decode": Method.decode}, {}, r"no decode\(\) -> def decode\(self, reader\): a model"),
     ({"create_model": Method.create_model}, {}, r"no create_model\(\), .* -> def create_model\(self, scene"),
     ({"stages": lambda self: [BadTask(self.config)]}, {}, "'model'")],
)  # fmt: skip
def test_declarations_of_a_method_that_do_not_fit_it(entry_of, changes, declared, said):
    entry = entry_of("method", type("Changed", (BadMethod,), changes), **declared)
    with pytest.raises(Exception, match=said):
        check_configuration(entry, PLUGINS)


def test_an_encoder_that_changes_its_model():
    with pytest.raises(BrokenContractError, match="encode changes the model"):
        _check_encoding(BadMethod(PLUGINS, None), some_gaussians())


@pytest.mark.parametrize(("sizes", "broken"), [((500, 400), True), ((400, 500), False), ((410, 400), False)])
def test_a_first_rate_point_with_the_largest_file(entry_of, monkeypatch, sizes, broken):
    bytes_of = dict(zip(("r1", "r2"), sizes, strict=True))
    monkeypatch.setattr(rate_points, "_size", lambda entry, plugins, settings, rate: bytes_of[rate])
    entry = entry_of("method", type("Two", (BadMethod,), {"RATES": {"r1": {}, "r2": {}}}))
    if broken:
        with pytest.raises(BrokenContractError, match="of r1 has 500 bytes, that of r2 400"):
            check_rate_points(entry, PLUGINS)
    else:
        assert check_rate_points(entry, PLUGINS).startswith(f"r1 {sizes[0]} bytes")
    assert "nothing to compare" in check_rate_points(entry_of("method", BadMethod), PLUGINS)


def test_every_length_of_a_stage_is_found():
    class Block(Params):
        iterations: int = 1
        steps: int = 2

    class Nested(OptimizationParams):
        base_iterations: int = 3
        block: Block = Block()

    assert list(_lengths(Nested)) == ["iterations", "base_iterations", "block.iterations"]


FIGURES = """
[[tables]]
dataset = "mipnerf360"
protocol = "survey"
source = "a paper"
year = 2024
verified = false
figures = [{}]
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (FIGURES.format('{ scene = "room", psnr = 30.0, rate = "r9" }'), "rate 'r9' is none of r1"),
        (FIGURES.format('{ scene = "room", psnr = 30.0, preset = "none" }'), "cannot be run with preset 'none'"),
        (FIGURES.format('{ psnr = 30.0, preset = "paper" }'), "cannot be run with preset 'paper'"),
        (FIGURES.format('{ scene = "room" }'), "neither psnr nor bytes"),
        (FIGURES.format('{ scene = "room", psnr = "high" }'), "table 1, figure 1: psnr"),
        ("", "holds no figure"),
    ],
)
def test_published_figures_that_are_wrong(text, said, tmp_path, monkeypatch):
    package = tmp_path / "sw_bad_figures"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "published.toml").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "sw_bad_figures", raising=False)
    ours = PLUGINS.methods.entry("3dgs")
    entry = Entry("method", "3dgs", ours.target, "one line", {"published": "sw_bad_figures:published.toml"}, "sw-bad")
    with pytest.raises(BrokenContractError, match=said):
        check_published(entry, PLUGINS)


def test_published_figures_that_are_right_are_counted(tmp_path, monkeypatch):
    assert check_published(PLUGINS.methods.entry("3dgs"), PLUGINS).endswith("of them second-hand")


def test_the_place_of_published_figures_is_a_file_of_a_package(entry_of):
    with pytest.raises(BrokenContractError, match="published"):
        check_entry(entry_of("method", Method, published="published.toml"))
