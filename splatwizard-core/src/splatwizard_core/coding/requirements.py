"""Requirements of decoding a file: the distributions that wrote it, their versions, and what each provided.

It stands in the header under `requires`, so that whoever lacks a plugin or has too old a one can be told what to
install. It is advice and no part of the decoded scene: the names come from a stranger, so they are restricted to what
a shell cannot misread, and a message says that they come from the file.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from packaging.version import Version

MAX_DISTRIBUTIONS = 64
MAX_PROVIDED = 256
DISTRIBUTION = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,62}[A-Za-z0-9])?")
VERSION = re.compile(r"[0-9][0-9A-Za-z.+!]{0,47}")
PROVIDED = re.compile(r"[a-z][a-z ]{0,31}:[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}")


@dataclass(frozen=True)
class Requirement:
    """One distribution that took part in writing a file.

    version     what was installed there; every later one reads what it wrote
    provided    (kind, name) of what the file was written with, such as ("coder", "octree")
    """

    distribution: str
    version: str
    provided: tuple[tuple[str, str], ...] = ()

    @property
    def command(self) -> str:
        """Command that installs it."""
        return f"pip install '{self.distribution}>={self.version}'"

    @property
    def is_well_formed(self) -> bool:
        """Whether it can be written into a header."""
        try:
            dump_requirements([self])
        except ValueError:
            return False
        return True

    def is_newer_than(self, version: str) -> bool:
        """Whether the file was written with a later release than `version`."""
        return _release(self.version) > _release(version)


def dump_requirements(requirements: Iterable[Requirement]) -> dict[str, list[str]]:
    """The header value: {distribution: [version, "kind:name", ...]}.

    Raises ValueError for what `parse_requirements` would refuse.
    """
    found: dict[str, list[str]] = {}
    for each in requirements:
        if each.distribution in found:
            raise ValueError(f"distribution {each.distribution} is required twice")
        found[each.distribution] = [each.version, *(f"{kind}:{name}" for kind, name in each.provided)]
    parse_requirements(found)
    return found


def parse_requirements(value: Any) -> list[Requirement]:
    """Inverse of `dump_requirements`. Raises ValueError for anything else than it makes."""
    if not isinstance(value, dict) or len(value) > MAX_DISTRIBUTIONS:
        raise ValueError(f"'requires' must be an object of at most {MAX_DISTRIBUTIONS} distributions")
    found = []
    for distribution, row in value.items():
        if not isinstance(row, list) or not row or not all(isinstance(item, str) for item in row):
            raise ValueError(f"'requires.{distribution[:64]}' is not [version, provided...]")
        version, *provided = row
        if not DISTRIBUTION.fullmatch(distribution) or not VERSION.fullmatch(version):
            raise ValueError(f"'requires' names no valid distribution and version: {distribution[:64]!r}")
        if len(provided) > MAX_PROVIDED or not all(PROVIDED.fullmatch(item) for item in provided):
            raise ValueError(f"'requires.{distribution}' holds something that is not 'kind:name'")
        pairs = (item.partition(":") for item in provided)
        found.append(Requirement(distribution, version, tuple((kind, name) for kind, _, name in pairs)))
    return found


def requirement_of(requirements: Sequence[Requirement], kind: str, name: str) -> Requirement | None:
    """The distribution that provided one thing, or None if the file does not say."""
    return next((each for each in requirements if (kind, name) in each.provided), None)


def _release(version: str) -> Version:
    """The release segment, such as 0.2.1; what follows (rc1, .dev3, +local) does not count."""
    numbers = re.match(r"[0-9]+(?:\.[0-9]+)*", version.rpartition("!")[2])
    return Version(numbers.group() if numbers else "0")
