"""Compilation of the native modules of all installed packages, ahead of time: `sw build-kernels`."""

from __future__ import annotations

import pkgutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from splatwizard_core.errors import NativeBuildError
from splatwizard_core.native import toolchain
from splatwizard_core.native.loader import NativeModule, Say
from splatwizard_core.native.toolchain import Toolchain

if TYPE_CHECKING:
    from splatwizard_core.plugins.manager import PluginManager

# By name: this room imports no other one.
CORE_MODULES = ("splatwizard_core.training.native:TRAINING",)


@dataclass(frozen=True)
class BuildRow:
    """Outcome of `build_all` for one module. state: built, up to date, or failed; `error` says why."""

    name: str
    state: str
    seconds: float
    path: Path | None
    error: str | None = None


def declared_modules(plugins: PluginManager) -> list[str]:
    """Targets "module:attribute", each once: the core's own, then those that registry entries declare as `native`."""
    targets = [*CORE_MODULES]
    for registry in plugins.registries.values():
        for entry in registry:
            declared = entry.declared.get("native") or ()
            targets += [declared] if isinstance(declared, str) else declared
    return list(dict.fromkeys(targets))


def resolve_module(target: str) -> NativeModule:
    """The NativeModule that "module:attribute" names. Raises NativeBuildError."""
    try:
        found = pkgutil.resolve_name(target)
    except Exception as error:
        raise NativeBuildError(f"native module {target} cannot be imported: {type(error).__name__}: {error}") from error
    if not isinstance(found, NativeModule):
        raise NativeBuildError(f"{target} is not a NativeModule but {type(found).__name__}")
    return found


def build_all(
    plugins: PluginManager,
    *,
    march: str = "native",
    into_packages: bool = False,
    force: bool = False,
    cuda: bool = False,
    jobs: int | None = None,
    say: Say | None = None,
) -> list[BuildRow]:
    """Build the core's and all plugins' native modules; one row each, in the order of `declared_modules`.

    march, force    as for `NativeModule.build`
    cuda            fail where a module's CUDA kernels cannot be built, instead of building what is left
    into_packages   put the libraries beside their packages' sources instead of into the user's cache
    jobs            most compilers at once, over all modules; None: the cores
    A module that fails has its reason in its row and stops no other one.
    Raises CompilerMissingError if there is no compiler.
    """
    tools = Toolchain(jobs)

    def build(target: str) -> BuildRow:
        started = time.monotonic()
        try:
            module = resolve_module(target)
            missing = toolchain.cuda_mismatch() if cuda and module.cuda_sources else None
            if missing is not None:
                raise NativeBuildError(f"the CUDA kernels of '{module.name}' cannot be built: {missing}")
            folder = module.prebuilt_folder if into_packages else module.cache_folder
            fresh = not force and module.is_built(march, folder)
            path = module.build(march=march, folder=folder, force=force, tools=tools, say=say)
        except NativeBuildError as error:
            return BuildRow(target, "failed", time.monotonic() - started, None, str(error))
        return BuildRow(module.name, "up to date" if fresh else "built", time.monotonic() - started, path)

    targets = declared_modules(plugins)
    with ThreadPoolExecutor(max_workers=len(targets)) as pool:
        return list(pool.map(build, targets))
