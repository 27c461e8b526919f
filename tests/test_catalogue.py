"""The core's catalogue of packages names everything that our packages register, and nothing else."""

from __future__ import annotations

import importlib.util

from import_graph import ROOT

from splatwizard_core.plugins.catalogue import catalogue


def test_the_catalogue_is_what_the_tool_makes_of_the_installed_packages():
    path = ROOT / "tools" / "make_catalogue.py"
    spec = importlib.util.spec_from_file_location("make_catalogue", path)
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    assert tool.CATALOGUE.read_text("utf-8") == tool.generate(), "make docs"


def test_it_knows_who_provides_the_defaults():
    assert catalogue()["default"] == {"method": "sw-3dgs", "dataset": "sw-datasets"}
