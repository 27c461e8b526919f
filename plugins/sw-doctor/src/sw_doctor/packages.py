"""Requirements and extras of the installed packages of the workspace and of third parties."""

from __future__ import annotations

import importlib.metadata
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from importlib.metadata import Distribution, PackageNotFoundError

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from splatwizard_core.tooling import Check, State
from sw_doctor import child
from sw_doctor.text import one_line

IMPORTS = "sw_doctor.imports"
SECONDS = 180.0  # for all imports together; a package that hangs is cut off
# The probe imports it, with everything that depends on it: a second process would pay for it again.
HEAVY = ("torch", "torchvision", "lpips", "torchmetrics")


@dataclass
class Needs:
    """Third-party requirements of the distributions that `sw` is made of.

    required    distribution name -> requirement, of all together
    theirs      those names in `required` that only strangers' packages need
    extras      "dist[extra]" -> its requirements
    """

    required: dict[str, Requirement] = field(default_factory=dict)
    theirs: set[str] = field(default_factory=set)
    extras: dict[str, list[Requirement]] = field(default_factory=dict)

    def names(self) -> list[str]:
        """Every distribution once."""
        optional = [canonicalize_name(r.name) for found in self.extras.values() for r in found]
        return list(dict.fromkeys([*self.required, *optional]))


def collect_needs(distributions: Iterable[str], theirs: Iterable[str] = ()) -> Needs:
    """Read the metadata of these distributions, and of those below the core, which are no plugins.

    theirs  distributions of strangers among the plugins

    What they need of each other is not listed, nor what a stranger needs and has not: its plugin's line tells that.
    """
    needs = Needs()
    foreign = set(theirs)
    names = list(dict.fromkeys([*distributions, *foreign]))
    ours = {canonicalize_name(name) for name in names}
    for name in names:
        try:
            dist = importlib.metadata.distribution(name)
            lines = dist.requires or []
        except (PackageNotFoundError, UnicodeDecodeError):
            continue
        extras = dist.metadata.get_all("Provides-Extra") or []
        for text in lines:
            try:
                requirement = Requirement(text)
            except InvalidRequirement:
                continue
            key = canonicalize_name(requirement.name)
            if key.startswith("splatwizard-") and key not in ours:
                ours.add(key)
                names.append(key)
            if key in ours or key.startswith("sw-"):
                continue  # the plugins' own check
            if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
                if name not in foreign:
                    needs.theirs.discard(key)
                    needs.required.setdefault(key, requirement)
                elif key not in needs.required and installed(requirement) is None:
                    needs.theirs.add(key)
                    needs.required[key] = requirement
                continue
            for extra in extras:
                if requirement.marker.evaluate({"extra": extra}):
                    needs.extras.setdefault(f"{name}[{extra}]", []).append(requirement)
    return needs


def installed(requirement: Requirement) -> str | None:
    """Say in one line what is wrong with the installed version; None if it is there and new enough."""
    try:
        version = importlib.metadata.version(requirement.name)
    except PackageNotFoundError:
        return "is not installed"
    if not requirement.specifier.contains(version, prereleases=True):
        return f"is {version}; needed is {requirement.specifier}"
    return None


def import_names(dist: Distribution) -> list[str]:
    """Top-level modules that a distribution brings, leaving out private and test ones; [] if it does not tell."""
    told = (dist.read_text("top_level.txt") or "").split()
    if not told:
        paths = [p for p in dist.files or [] if p.suffix in (".py", ".so", ".pyd") and ".." not in p.parts]
        told = sorted({p.parts[0].split(".")[0] for p in paths})
    known = [
        name for name in told if name.isidentifier() and not name.startswith("_") and name not in ("tests", "test")
    ]
    alike = [n for n in known if canonicalize_name(n) == canonicalize_name(dist.metadata["Name"])]
    return alike or known[:1]


def try_imports(names: Iterable[str]) -> dict[str, str | None]:
    """Distribution name -> why it cannot be imported, None if it can. Each is really imported, in another process."""
    left = [name for name in names if canonicalize_name(name) not in HEAVY]
    found: dict[str, str | None] = {}
    while left:
        answer = child.ask(IMPORTS, left, timeout=SECONDS)
        found |= {c.name: None if c.state == "ok" else c.detail for c in answer.checks}
        if answer.died_in is None or answer.died_in[0] not in left:
            break
        name, how = answer.died_in
        found[name] = f"the process that imports it {how}"
        left = left[left.index(name) + 1 :]
    return found


def package_checks(needs: Needs, problems: dict[str, str | None]) -> list[Check]:
    """Required packages: one line for all that work, one for each that does not. Extras: one line each."""
    checks = []
    sound = 0
    for name, requirement in needs.required.items():
        why = installed(requirement) or problems.get(name)
        if why is None:
            sound += 1
            continue
        spec = str(requirement).partition(";")[0].strip()
        state: State = "missing" if why == "is not installed" else "broken"
        mend = f"pip install {'' if state == 'missing' else '--upgrade --force-reinstall '}'{spec}'"
        checks.append(Check("packages", name, state, f"{name} {why}", mend, needed=name not in needs.theirs))
    checks.append(Check("packages", "required", "ok", f"{sound} of {len(needs.required)} packages work"))
    return checks + [_extra_check(extra, found, problems) for extra, found in needs.extras.items()]


def _extra_check(extra: str, requirements: list[Requirement], problems: dict[str, str | None]) -> Check:
    absent, broken, there = [], [], []
    for requirement in requirements:
        why = installed(requirement)
        if why == "is not installed":
            absent.append(requirement.name)
        elif why is not None or problems.get(canonicalize_name(requirement.name)) is not None:
            broken.append(f"{requirement.name} {why or problems[canonicalize_name(requirement.name)]}")
        else:
            there.append(f"{requirement.name} {importlib.metadata.version(requirement.name)}")
    if broken:
        name = broken[0].split()[0]
        # A part that is lacking ('gsplat.csrc') is one of a package that is there: pip would leave it as it is.
        lacks = re.search(r"No module named '([^'.]+)'", broken[0])
        own = {canonicalize_name(each) for each in (name, *import_names(importlib.metadata.distribution(name)))}
        if lacks is not None and canonicalize_name(lacks[1]) not in own:
            mend = f"pip install {lacks[1]}"
        else:  # without its dependencies: one of them may be torch
            mend = f"pip install --upgrade --force-reinstall --no-deps {name}"
        return Check("packages", extra, "broken", one_line("; ".join(broken)), mend)
    if absent:
        return Check("packages", extra, "missing", f"not installed: {', '.join(absent)}", f"pip install '{extra}'")
    return Check("packages", extra, "ok", ", ".join(there))
