"""Names of a new package: one word everywhere, and none that somebody else has."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from splatwizard_core.api import UserInputError

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

LEGAL = re.compile(r"[a-z][a-z0-9]*(-[a-z0-9]+)*")
LONGEST = 30
PREFIX = "sw-"
CORE = "splatwizard-core"


@dataclass(frozen=True)
class Names:
    """The names of a package, all from one.

    key             how users ask for what it provides, and its entry point: "opacity-prune"
    """

    key: str

    @property
    def distribution(self) -> str:
        """Name of the distribution: "sw-opacity-prune"."""
        return PREFIX + self.key

    @property
    def snake(self) -> str:
        """The key as an identifier: "opacity_prune"."""
        return self.key.replace("-", "_")

    @property
    def package(self) -> str:
        """Name of the import package: "sw_opacity_prune"."""
        return f"sw_{self.snake}"

    @property
    def pascal(self) -> str:
        """The key as a class: "OpacityPrune"."""
        return "".join(part.capitalize() for part in self.key.split("-"))


def legal_names(name: str) -> Names:
    """Return the names that a package called `name` has, with or without the prefix "sw-".

    Raises UserInputError for a name that is no distribution, package and class at once.
    """
    key = name.removeprefix(PREFIX)
    if not LEGAL.fullmatch(key):
        near = re.sub(r"[^a-z0-9]+", "-", key.lower()).strip("-0123456789")
        hint = f"; '{near}' is one" if LEGAL.fullmatch(near) else ""
        raise UserInputError(
            f"'{name}' is no name for a package: lower-case letters, digits and single hyphens, a letter first{hint}"
        )
    if len(key) > LONGEST:
        raise UserInputError(f"'{key}' has {len(key)} letters, a name has at most {LONGEST}")
    return Names(key)


def check_free(names: Names, registry_kind: str, plugins: PluginManager) -> None:
    """Raise UserInputError if somebody has one of the names already, as far as this installation knows.

    registry_kind   of what the package will provide: "method", "coder", ...
    """
    known = {info.key: info for info in plugins.plugins}
    if names.key in known:
        info = known[names.key]
        raise UserInputError(f"'{names.key}' is taken: the plugin of {info.distribution} {info.version} is called so")
    if names.distribution in _ours():
        raise UserInputError(f"'{names.distribution}' is taken: it is a package of Splatwizard itself")
    registry = plugins.registries[registry_kind]
    if names.key in registry or names.key in registry.clashes:
        owner = registry.entry(names.key).distribution if names.key in registry else "two packages"
        raise UserInputError(f"the {registry_kind} '{names.key}' is taken: {owner} provides it")
    try:
        version = importlib.metadata.version(names.distribution)
    except importlib.metadata.PackageNotFoundError:
        version = None
    if version is not None:
        raise UserInputError(f"'{names.distribution}' is taken: version {version} of it is installed here")
    if importlib.util.find_spec(names.package) is not None:
        raise UserInputError(f"the import name '{names.package}' is taken: such a package is installed here")


def _ours() -> set[str]:
    """Distributions of this project, installed or not: those that an extra of the core lists."""
    listed = importlib.metadata.requires(CORE) or []
    return {re.split(r"[ <>=!~\[(;]", line, maxsplit=1)[0] for line in listed if "extra ==" in line}
