"""Compilation of several native modules at once, ahead of time."""

from __future__ import annotations

import pkgutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from splatwizard_native import NativeBuildError, NativeModule, Toolchain, toolkit_mismatch


@dataclass(frozen=True)
class BuildRow:
    """Outcome of `build_all` for one module. state: built, up to date, or failed; `error` says why."""

    name: str
    state: str
    seconds: float
    path: Path | None
    error: str | None = None


def resolve_module(target: str) -> NativeModule:
    """The NativeModule that "module:attribute" names. Raises NativeBuildError."""
    try:
        found = pkgutil.resolve_name(target)
    except (Exception, SystemExit) as error:
        raise NativeBuildError(f"native module {target} cannot be imported: {type(error).__name__}: {error}") from error
    if not isinstance(found, NativeModule):
        raise NativeBuildError(f"{target} is not a NativeModule but {type(found).__name__}")
    return found


def build_all(
    targets: Sequence[str],
    *,
    march: str = "native",
    into_packages: bool = False,
    force: bool = False,
    cuda: bool = False,
    jobs: int | None = None,
    say: Callable[[str], None] | None = None,
) -> list[BuildRow]:
    """Build the native modules that `targets` ("module:attribute") name; one row each, in their order.

    One that has CUDA operations in a library of their own is followed by it, where that can be built.

    march, force    as for `NativeModule.build`
    cuda            fail where a module's CUDA kernels cannot be built, instead of building what is left
    into_packages   put the libraries beside their packages' sources instead of into the user's cache
    jobs            most compilers at once, over all modules; None: the cores
    A module that fails has its reason in its row and stops no other one.
    Raises CompilerMissingError if there is no compiler.
    """
    tools = Toolchain(jobs)

    def build(target: str) -> list[BuildRow]:
        try:
            module = resolve_module(target)
        except NativeBuildError as error:
            return [BuildRow(target, "failed", 0.0, None, str(error))]
        with_cuda = module.cuda is not None and (cuda or toolkit_mismatch() is None)
        return [build_one(target, each) for each in (module, module.cuda if with_cuda else None) if each is not None]

    def build_one(target: str, module: NativeModule) -> BuildRow:
        started = time.monotonic()
        try:
            missing = toolkit_mismatch() if cuda and module.cuda_sources else None
            if missing is not None:
                raise NativeBuildError(f"the CUDA kernels of '{module.name}' cannot be built: {missing}")
            folder = module.prebuilt_folder if into_packages else module.cache_folder
            fresh = not force and module.is_built(march, folder)
            path = module.build(march=march, folder=folder, force=force, tools=tools, say=say)
        except NativeBuildError as error:
            return BuildRow(target, "failed", time.monotonic() - started, None, str(error))
        return BuildRow(module.name, "up to date" if fresh else "built", time.monotonic() - started, path)

    with ThreadPoolExecutor(max_workers=max(1, len(targets))) as pool:
        try:
            return [row for rows in pool.map(build, targets) for row in rows]
        except BaseException:  # asked to end: the threads of the pool wait for compilers
            tools.stop()
            raise
