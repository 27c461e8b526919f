"""Checks of targets can fail: on classes and functions without the form of their contract."""

from __future__ import annotations

import pytest
from sw_kit.checks.targets import check_target
from sw_kit.finding import BrokenContractError

from splatwizard_core.api import (
    Params,
)
from splatwizard_core.tooling import load_plugins

PLUGINS = load_plugins()


class NeedsAnArgument:
    uses_statistics = False

    def __init__(self, power):
        pass

    def score(self, model, cameras, rasterizer, background=None):
        pass


class NoBackground(NeedsAnArgument):
    def __init__(self):
        pass

    def score(self, model, cameras, rasterizer):
        pass


class Scores:
    uses_statistics = False

    def __init__(self, power=1.0):
        pass

    def score(self, model, cameras, rasterizer, background=None):
        pass


class WithoutDefault(Scores):
    class Settings(Params):
        power: float


class NotTaken(Scores):
    class Settings(Params):
        strength: float = 1.0


class OtherDefault(Scores):
    class Settings(Params):
        power: float = 2.0


class NoModel(Scores):
    Settings = 3


@pytest.mark.parametrize(
    ("target", "said"),
    [(WithoutDefault, "Settings is a pydantic model"), (NotTaken, "unexpected keyword argument 'strength'"),
     (OtherDefault, "'power' is 1.0 or 2.0 by default"), (NoModel, "cannot be made with its Settings")],
)  # fmt: skip
def test_settings_that_the_class_is_not_made_with(entry_of, target, said):
    assert "has the signatures" in check_target(entry_of("pruner", Scores), PLUGINS)
    with pytest.raises(BrokenContractError, match=said):
        check_target(entry_of("pruner", target), PLUGINS)


@pytest.mark.parametrize(
    ("kind", "target", "declared", "said"),
    [("pruner", NeedsAnArgument, {}, "cannot be made with its defaults"),
     ("pruner", NoBackground, {}, "cannot be called so"),
     ("pruner", object, {}, r"has no score\(\)"),
     ("metric", lambda render: 0.0, {}, "cannot be called with 2 arguments"),
     ("command", print, {}, "use @click.command"),
     ("dataset", NoBackground, {}, r"has no detect\(\)"),
     ("coder", NoBackground, {"codes": "arrays"}, r"has no encode\(\)")],
)  # fmt: skip
def test_targets_without_the_contracts_form(entry_of, kind, target, declared, said):
    with pytest.raises(BrokenContractError, match=said):
        check_target(entry_of(kind, target, **declared), PLUGINS)
