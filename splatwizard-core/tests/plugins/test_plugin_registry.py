"""A plugin that fails harms nothing else, whatever it had added or claimed before."""

import importlib.metadata
import sys
import types

import pytest

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins import PluginManager, hookimpl


@pytest.fixture
def manager_of(monkeypatch):
    """manager_of(name=function that fills the metric registry, ...) -> a manager of these plugins."""

    def make(**hooks) -> PluginManager:
        for name, hook in hooks.items():
            module = types.ModuleType(f"fake_{name}")
            module.register_metrics = hookimpl(hook)
            monkeypatch.setitem(sys.modules, module.__name__, module)
        return PluginManager(importlib.metadata.EntryPoint(n, f"fake_{n}", "splatwizard") for n in hooks)

    return make


def adds(name: str):
    def register_metrics(registry):
        registry.add(name, "math:fsum", summary="a sum")

    return register_metrics


def adds_and_fails(name: str):
    def register_metrics(registry):
        registry.add(name, "math:fsum", summary="a sum")
        raise OSError("no disk")

    return register_metrics


def test_a_failed_plugin_gives_back_the_name_that_it_claimed(manager_of):
    plugins = manager_of(good=adds("mean"), zz=adds_and_fails("mean"))
    assert [p.key for p in plugins.broken] == ["zz"]
    assert plugins.metrics.clashes == {}
    assert plugins.metrics.entry("mean").distribution == "good"


def test_two_that_claim_a_name_still_clash_when_a_third_failed(manager_of):
    plugins = manager_of(a=adds("mean"), b=adds("mean"), c=adds_and_fails("mean"))
    assert [e.distribution for e in plugins.metrics.clashes["mean"]] == ["a", "b"]
    with pytest.raises(PluginError, match=r"claimed by a .* and b"):
        plugins.metrics.entry("mean")


def test_a_plugin_that_exits_when_imported_is_listed_as_broken(manager_of, tmp_path, monkeypatch):
    (tmp_path / "fake_quitter.py").write_text("raise SystemExit('needs a licence')")
    monkeypatch.syspath_prepend(tmp_path)
    entry_points = [importlib.metadata.EntryPoint("quitter", "fake_quitter", "splatwizard")]
    (info,) = PluginManager(entry_points).plugins
    assert info.error == "SystemExit: needs a licence"
