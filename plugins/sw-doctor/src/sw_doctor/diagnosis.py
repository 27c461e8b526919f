"""Runs all checks side by side, and puts their findings into the order in which they are read."""

from __future__ import annotations

import importlib.metadata
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from splatwizard_core.api import PluginError
from splatwizard_core.tooling import Check, Entry, load_plugins
from sw_doctor import child, compilers, packages, system
from sw_doctor.registered import MAIN_JOB, SECONDS, needs_of, run_registered
from sw_doctor.remedies import remedy_of
from sw_doctor.text import OF, SLOWLY, one_line

DIED_IN = {"torch": ("torch", "CUDA"), "rasterizers": ("rasterizers",), MAIN_JOB: ("sw run",)}
PROBE = "sw_doctor.probe"
GROUPS = (
    MAIN_JOB, "system", "torch", "compilers", "kernels", "rasterizers", "plugins", "packages", "metrics", "data",
)  # fmt: skip


@dataclass(frozen=True)
class Diagnosis:
    """Findings in reading order, and the seconds that they took."""

    checks: list[Check]
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether `sw run` on the demo scene can run: no needed check is missing or broken."""
        return all(c.state == "ok" for c in self.checks if c.needed)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as `sw doctor --json` prints them."""
        return {"ok": self.ok, "seconds": round(self.seconds, 2), "checks": [c.as_dict() for c in self.checks]}


def examine() -> Diagnosis:
    """Try everything that `sw run` and the installed packages need.

    Whatever imports torch or a package, runs a compiler or was registered by a plugin does so in other processes at the
    same time, so a crash there is a finding here.
    """
    started = time.monotonic()
    with ThreadPoolExecutor(max_workers=5) as pool:
        probe = pool.submit(child.ask, PROBE, timeout=SECONDS)
        cxx = pool.submit(_guarded, "C++", compilers.check_cxx)
        nvcc = pool.submit(_guarded, "nvcc", compilers.check_nvcc)
        checks, needs = plugin_checks()
        registered = [(entry, pool.submit(run_registered, entry)) for entry in registered_entries()]
        problems = pool.submit(packages.try_imports, needs.names())
        for check in (system.check_python, system.check_memory, system.check_cores, system.check_cache,
                      system.check_working_folder):  # fmt: skip
            checks.append(_guarded(check.__name__, check))
        checks += probed(probe.result())
        torch_cuda = next((c.facts.get("cuda") for c in checks if c.name == "torch"), None)
        judged = compilers.judge_nvcc(nvcc.result(), torch_cuda)
        checks += [cxx.result(), judged]
        checks += packages.package_checks(needs, problems.result())
        works = {check.name for check in checks if check.state == "ok"}
        theirs = [check for entry, found in registered if needs_of(entry) <= works for check in found.result()]
    obstacle = next((c for c in checks if c.name in ("C++", "cache folder") and c.state != "ok"), None)
    checks = [_without_builds(c, obstacle, judged) for c in checks]
    checks += theirs
    order = {group: place for place, group in enumerate(GROUPS)}
    checks.sort(key=lambda c: order.get(c.group, len(order)))
    return Diagnosis(checks, time.monotonic() - started)


def probed(answer: child.Answer) -> list[Check]:
    """Findings of the probe; the step that it died in, if it died, is broken, and with it the main job.

    After the main job only what strangers provide is tried: dying there decides nothing.
    """
    checks = list(answer.checks)
    if answer.died_in is not None:
        step, how = answer.died_in
        group = next((g for g, steps in DIED_IN.items() if step in steps), "kernels" if ":" in step else "plugins")
        needed = not any(check.group == MAIN_JOB for check in checks)
        mend = "sw build-kernels --force" if group == "kernels" else "pip install --force-reinstall torch"
        if OF in step:
            mend = remedy_of(step.partition(OF)[2], how, foreign=True)
        checks.append(Check(group, step, "broken", f"the process that tried it {how}", mend, needed))
    return checks


def plugin_checks() -> tuple[list[Check], packages.Needs]:
    """Check every plugin, and every name that several claim or may not have; also return what they all need."""
    try:
        plugins = load_plugins()
    except PluginError as error:
        wrong = Check("plugins", "SW_PLUGINS", "broken", one_line(error), "unset SW_PLUGINS", True)
        return [wrong], packages.collect_needs(["splatwizard-core"])
    checks = []
    restricted = os.environ.get("SW_PLUGINS")
    if restricted is not None:
        detail = f"only these load: {restricted or 'none, the core alone'}"
        checks.append(Check("plugins", "SW_PLUGINS", "ok", detail))
    for info in plugins.plugins:
        if info.error is None:
            provided = len(plugins.provided_by(info))
            checks.append(Check("plugins", info.distribution, "ok", f"{info.version}, provides {provided}"))
            continue
        mend = remedy_of(info.distribution, info.error, foreign=info.foreign)
        checks.append(Check("plugins", info.distribution, "broken", one_line(f"{info.version}: {info.error}"), mend))
    for info in plugins.plugins:
        for entry, why in plugins.refused_of(info):
            detail = one_line(f"{info.distribution} {info.version} adds it in vain: {why}")
            checks.append(Check("plugins", f"{entry.kind} {entry.name}", "broken", detail,
                                f"pip uninstall {info.distribution}  (what else it provides works)"))  # fmt: skip
    for kind, registry in plugins.registries.items():
        for name, entries in registry.clashes.items():
            owners = [e.distribution for e in entries]
            checks.append(Check("plugins", f"{kind} {name}", "broken", f"claimed by {' and '.join(owners)}",
                                f"pip uninstall {'  (or: pip uninstall '.join(owners[:2])})"))  # fmt: skip
    checks += [twice for info in plugins.plugins if (twice := check_shadowed(info.distribution)) is not None]
    theirs = [info.distribution for info in plugins.plugins if info.foreign]
    ours = [info.distribution for info in plugins.plugins if not info.foreign]
    return checks, packages.collect_needs(ours, theirs)


def check_shadowed(distribution: str) -> Check | None:
    """A distribution in two places, of which the first on the path hides the other; None: it is in one."""
    found = {Path(str(d.locate_file(""))).resolve(): d for d in importlib.metadata.distributions(name=distribution)}
    if len(found) < 2:
        return None
    (used, first), (hidden, second) = list(found.items())[:2]
    detail = f"{first.version} in {used} is used, {second.version} in {hidden} is shadowed by it"
    mend = f"pip uninstall {distribution}  (until it is gone; then install the one that you want)"
    return Check("plugins", f"{distribution} twice", "broken", one_line(detail), mend)


def registered_entries() -> list[Entry]:
    """Checks that the installed plugins register."""
    try:
        return list(load_plugins().checks)
    except PluginError:  # told by `plugin_checks`
        return []


def _guarded(name: str, check: Callable[[], Check]) -> Check:
    """A test that fails in a way nobody foresaw is a finding as well."""
    try:
        return check()
    except Exception as error:
        return Check("system", name, "broken", one_line(f"the test failed: {type(error).__name__}: {error}"))


def _without_builds(check: Check, obstacle: Check | None, nvcc: Check) -> Check:
    """A check, knowing that nothing can be compiled here until the obstacle is gone: its line is what mends.

    For kernels of CUDA the finding about nvcc comes first: without one that fits torch a C++ compiler is of no use.
    """
    if check.facts.get("target") == "cuda" and nvcc.state != "ok" and nvcc.mend is not None:
        obstacle = nvcc
    if obstacle is None:
        return check
    if check.facts.get("compiled_first"):
        return replace(check, detail=f"on {check.facts['device']}, but {SLOWLY}", mend=obstacle.mend)
    if check.mend is not None and check.mend.startswith("sw build-kernels"):
        return replace(check, mend=obstacle.mend)
    return check
