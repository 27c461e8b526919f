"""The native modules that are compiled ahead of time and before a run's clocks start."""

from __future__ import annotations

from sw_doctor.building import resolve_module
from sw_doctor.declared_modules import CORE_MODULES, declared_modules

from splatwizard_core.plugins.manager import PluginManager
from splatwizard_native import NativeModule


def test_modules_of_entries_come_after_the_cores_each_once():
    plugins = PluginManager([])
    for kind, name, native in (
        ("rasterizer", "a", "k:A"), ("rasterizer", "b", "k:A"), ("coder", "c", ["k:B", "k:C"]), ("coder", "d", None),
    ):  # fmt: skip
        plugins.registries[kind].add(name, "nowhere:Thing", summary="", native=native)
    assert sorted(declared_modules(plugins)) == sorted([*CORE_MODULES, "k:A", "k:B", "k:C"])
    assert declared_modules(plugins)[: len(CORE_MODULES)] == [*CORE_MODULES]


def test_every_native_module_of_the_core_exists():
    assert CORE_MODULES
    assert all(isinstance(resolve_module(target), NativeModule) for target in CORE_MODULES)
