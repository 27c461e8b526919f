"""The checks of one installed distribution, in order: `sw check-plugin` prints them, a package's own tests call them.

@pytest.mark.parametrize("check", checks_of("sw-their-method", quick=True), ids=str)
def test_contract(check):
    check()
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.api import UserInputError
from splatwizard_core.tooling import load_plugins
from sw_kit.checks import registration
from sw_kit.finding import PackageCheck

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry, PluginInfo


def checks_of(distribution: str, *, quick: bool = False, settings: Sequence[str] = ()) -> list[PackageCheck]:
    """Return the checks of a distribution; nothing is checked, and nothing of it imported, before they are called.

    quick       only what takes no run: registration, declared fields, signatures, presets and rate points
    settings    "KEY=VALUE" for the small runs of methods, as `--set` takes them

    Raises UserInputError if no plugin of that name is installed.
    """
    plugins = load_plugins()
    info = _find(distribution, plugins)
    name = info.distribution
    entries = plugins.provided_by(info)
    found = [
        PackageCheck(name, "loads", functools.partial(registration.check_loads, info)),
        PackageCheck(name, "states its requirements", functools.partial(registration.check_requirements, info)),
        PackageCheck(name, "imports what it may", functools.partial(registration.check_imports, info)),
    ]
    if info.error is not None:
        return found
    found += [
        PackageCheck(name, "registers lightly", functools.partial(registration.check_light, info)),
        PackageCheck(name, "declares legal fields", functools.partial(registration.check_fields, entries)),
    ]
    for entry in entries:
        found += _of_entry(entry, plugins, quick, settings)
    return found


def _find(distribution: str, plugins: PluginManager) -> PluginInfo:
    wanted = distribution.lower().replace("_", "-")
    for info in plugins.plugins:
        if wanted in (info.distribution.lower().replace("_", "-"), info.key):
            return info
    if "/" in distribution or "\\" in distribution or (Path(distribution) / "pyproject.toml").is_file():
        name = Path(distribution).resolve().name
        raise UserInputError(f"'{distribution}' is a folder: give the name of the installed distribution (as '{name}')")
    known = ", ".join(sorted(info.distribution for info in plugins.plugins))
    raise UserInputError(f"no plugin called '{distribution}' is installed; there are: {known} (pip install -e FOLDER)")


def _of_entry(entry: Entry, plugins: PluginManager, quick: bool, settings: Sequence[str]) -> list[PackageCheck]:
    """Return the checks of one entry. Modules that import torch are imported when a check is called."""
    whose = f"{entry.kind} '{entry.name}'"

    def signatures() -> str:
        from sw_kit.checks.targets import check_target

        return check_target(entry, plugins)

    def configuration() -> str:
        from sw_kit.checks.methods import check_configuration

        return check_configuration(entry, plugins)

    def figures() -> str:
        from sw_kit.checks.published import check_published

        return check_published(entry, plugins)

    def behaviour() -> str:
        from sw_kit.checks.behaviour import BEHAVIOUR

        return BEHAVIOUR[entry.kind](entry, plugins)

    def small_run() -> str:
        from sw_kit.checks.small_run import check_small_run

        return check_small_run(entry, plugins, settings)

    def rate_points() -> str:
        from sw_kit.checks.rate_points import check_rate_points

        return check_rate_points(entry, plugins, settings)

    is_method = entry.kind == "method"
    found = [PackageCheck(entry.distribution, f"{whose} has the contract's form", signatures)]
    if is_method:
        found.append(PackageCheck(entry.distribution, f"{whose} has presets and rate points", configuration))
    if is_method and "published" in entry.declared:
        found.append(PackageCheck(entry.distribution, f"{whose} has published figures", figures))
    if not quick and entry.kind in BEHAVES:
        found.append(PackageCheck(entry.distribution, f"{whose} keeps the contract", behaviour))
    if not quick and is_method:
        found.append(PackageCheck(entry.distribution, f"{whose} runs on a tiny scene", small_run))
        found.append(PackageCheck(entry.distribution, f"{whose} has its rate points in order", rate_points))
    return found


BEHAVES = (
    "pruner",
    "density control",
    "metric",
    "dataset",
    "rasterizer",
    "coder",
    "exporter",
    "importer",
    "check",
    "download",
)
"""Kinds whose providers can be held to their contract without knowing more of them."""
