"""Checks of rasterizers: the conformance suite of sw-reference, on the CPU."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

from sw_reference.rasterizer import ReferenceRasterizer
from sw_reference.testing.raster_gradients import GRADIENT_CASES, applies, check_against
from sw_reference.testing.rasterizer_checks import checks_for

from splatwizard_native import NativeBuildError
from sw_kit.checks.targets import make
from sw_kit.finding import BrokenContractError, NotCheckedError, hold

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry


def check_rasterizer(entry: Entry, plugins: PluginManager) -> str:
    """Hold a rasterizer to every fact that its features ask for, and its values and gradients to the reference's."""
    rasterizer, oracle = make(entry, plugins), ReferenceRasterizer()
    hold(
        rasterizer.info.name == entry.name,
        f"its info is that of '{rasterizer.info.name}'",
        f"info = RasterizerInfo.declared(register_rasterizers, '{entry.name}')",
    )
    facts = checks_for(rasterizer.info)
    for fact in facts:
        _held(str(fact), functools.partial(fact, rasterizer, "cpu"))
    if rasterizer.info.exactness not in ("exact", "tight"):
        return f"{len(facts)} facts hold; values are approximate, so not compared"
    cases = [case for case in GRADIENT_CASES if applies(case, rasterizer.info)]
    if entry.name != oracle.info.name:
        for case in cases:
            _held(case.name, functools.partial(check_against, rasterizer, oracle, case))
    return f"{len(facts)} facts hold, values and gradients of {len(cases)} scenes are the reference's"


def _held(name: str, check: Callable[[], None]) -> None:
    try:
        check()
    except NativeBuildError as error:
        raise NotCheckedError(" ".join(str(error).split()), "install a compiler: sw doctor") from error
    except Exception as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise BrokenContractError(
            f"{name}: {reason}", "sw_reference.testing has this check: run it alone in your own tests"
        ) from error
