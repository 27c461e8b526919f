"""Fixtures of the tests of checks: entries of things made up on the spot, and an installed package."""

from __future__ import annotations

import sys
import types

import pytest

from splatwizard_core.tooling import Entry, PluginInfo


@pytest.fixture
def entry_of(monkeypatch):
    """entry_of(kind, target, **declared): an entry whose target is this object."""

    def make(kind, target, **declared):
        module = types.ModuleType("sw_bad_things")
        module.target = target
        monkeypatch.setitem(sys.modules, "sw_bad_things", module)
        return Entry(kind, "bad-thing", "sw_bad_things:target", "one line", declared, "sw-bad", "0.1")

    return make


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """installed(source, requires): a distribution sw-bad with one module sw_bad."""

    def make(source, requires=("splatwizard-core>=0.3,<0.4",)):
        (tmp_path / "sw_bad.py").write_text(source)
        info = tmp_path / "sw_bad-0.1.dist-info"
        info.mkdir()
        lines = "".join(f"Requires-Dist: {line}\n" for line in requires)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sw-bad\nVersion: 0.1\n{lines}\n")
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{':'.join(filter(None, sys.path))}")
        return PluginInfo("bad", "sw-bad", "0.1", "sw_bad")

    return make
