"""Checks of a registration can fail: on what is heavy, imports what is not declared, or has illegal fields."""

from __future__ import annotations

import pytest
from sw_kit.checks import registration
from sw_kit.checks.fields import check_entry
from sw_kit.finding import BrokenContractError
from sw_kit.suite import checks_of

from splatwizard_core.api import (
    UserInputError,
)
from splatwizard_core.tooling import Entry, PluginInfo, load_plugins

PLUGINS = load_plugins()


HOOK = """
from splatwizard_core.api import hookimpl

@hookimpl
def register_methods(registry):
    {}
"""


@pytest.mark.parametrize(
    ("line", "said"),
    [("import sys; sys.modules['torch'] = sys", "imports torch"),
     ("print('hello')", "prints 'hello'"), ("1 / 0", "ZeroDivisionError"),
     ("for _ in range(30_000):\n        pass", r"executes 6\d,\d{3} lines of Python, at most 50,000"),
     ("import numpy", "lines of Python")],
)  # fmt: skip
def test_registration_that_is_not_light(installed, line, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_light(installed(HOOK.format(line)))


@pytest.mark.parametrize(
    ("requires", "said"),
    [((), "does not require splatwizard-core"), (("splatwizard-core",), "no lower or no upper"),
     (("splatwizard-core>=0.2",), "no upper bound"), (("splatwizard-core~=0.2", "numpy"), "no version of numpy")],
)  # fmt: skip
def test_requirements_without_versions(installed, requires, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_requirements(installed("", requires))


@pytest.mark.parametrize(
    ("source", "said"),
    [("from splatwizard_core.runs.run import run", r"splatwizard_core.runs.run.run \(sw_bad.py\)"),
     ("def f():\n    import sw_codecs.testing", r"sw-codecs \(sw_bad.py\) without requiring"),
     ("import json\nimport rich", r"imports rich \(sw_bad.py\) without requiring it -> .*add 'rich' to dependencies"),
     ("from PIL import Image", "imports pillow .*add 'pillow'"),
     ("from splatwizard_core import api, runs", "splatwizard_core.runs")],
)  # fmt: skip
def test_imports_of_what_is_not_promised(installed, source, said):
    with pytest.raises(BrokenContractError, match=said):
        registration.check_imports(installed(source))


def test_what_only_a_type_checker_reads_may_come_from_anywhere(installed):
    source = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from splatwizard_core.runs.run import run\n"
    registration.check_imports(installed(source + "from splatwizard_core.api import Camera"))


def test_what_is_required_by_any_spelling_may_be_imported(installed):
    source = "import sw_bad, json, no_such_module\nimport numpy.random\nfrom PIL import Image\n"
    registration.check_imports(installed(source, ("splatwizard-core~=0.2", "numpy>=1", "Pillow>=1 ; extra == 'more'")))


def test_a_plugin_that_did_not_load():
    with pytest.raises(BrokenContractError, match="the plugin is broken: no such"):
        registration.check_loads(PluginInfo("bad", "sw-bad", "0.1", "sw_bad", error="no such module"))


def test_a_plugin_with_an_entry_that_is_refused(monkeypatch):
    entry = Entry("metric", "psnr", "m:f", "one line", distribution="sw-bad", version="0.1", foreign=True)
    monkeypatch.setattr(load_plugins().metrics, "refused", [(entry, "that is a name of ours")])
    registration.check_loads(PluginInfo("good", "sw-good", "0.1", "sw_good"))
    with pytest.raises(BrokenContractError, match="metric 'psnr' is refused: that is a name of ours"):
        registration.check_loads(PluginInfo("bad", "sw-bad", "0.1", "sw_bad"))


@pytest.mark.parametrize(
    ("entry", "said"),
    [(Entry("method", "a name", "m:C", "one line"), "nobody can type"),
     (Entry("method", "name", "m:C", ""), "summary"),
     (Entry("method", "name", "m:C", "two\nlines"), "summary"),
     (Entry("method", "name", "m:C", "TODO: one line"), "still has the summary 'TODO: one line'"),
     (Entry("method", "name", "m:C", "line", {"rates": "r1"}), "must be a list of names"),
     (Entry("method", "name", "m:C", "line", {"rate": ["r1"]}), "'rate', which its kind does not have"),
     (Entry("metric", "name", "m:C", "line"), "does not declare 'direction'"),
     (Entry("metric", "name", "m:C", "line", {"directoin": "higher"}), "'direction', but 'directoin', which"),
     (Entry("metric", "name", "m:C", "line", {"direction": "up"}), "direction='up'"),
     (Entry("metric", "name", "m:C", "line", {"direction": "lower", "over": "mesh"}), "over='mesh'"),
     (Entry("coder", "name", "m:C", "line", {"codes": "colours"}), "codes='colours'"),
     (Entry("exporter", "name", "m:C", "line", {"suffix": "ply"}), "suffix='ply'"),
     (Entry("command", "name", "m:C", "line", {"position": print}), "no plain value")],
)  # fmt: skip
def test_fields_that_are_not_legal(entry, said):
    with pytest.raises(BrokenContractError, match=said):
        check_entry(entry)


def test_an_unknown_feature_of_a_rasterizer():
    with pytest.raises(Exception, match="unknown features"):
        check_entry(Entry("rasterizer", "name", "m:C", "line", {"features": ["GLOSS"]}))


@pytest.mark.parametrize("folder", ["./sw-rows", "plugins/sw-rows", "sw-rows/"])
def test_a_folder_in_place_of_a_name(folder):
    with pytest.raises(UserInputError, match=r"is a folder: give the name .* \(as 'sw-rows'\)"):
        checks_of(folder)
