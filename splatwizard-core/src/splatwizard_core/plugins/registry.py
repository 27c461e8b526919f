"""A registry of one kind of thing: light entries whose targets are imported only when asked for."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import importlib
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Generic, TypeVar

from splatwizard_core.errors import PluginError
from splatwizard_core.plugins.catalogue import catalogue, is_ours, package_of
from splatwizard_core.plugins.fields import illegal
from splatwizard_core.plugins.guards import prints_to_stderr
from splatwizard_core.plugins.migration import migration_hint
from splatwizard_core.plugins.strangers_code import strangers_code

T = TypeVar("T")

TAKEN = "that is a name of {owner}, and stays so: uninstall this package, or have its author rename the entry"


@dataclass(frozen=True)
class Entry:
    """One thing that a distribution provides.

    kind            "rasterizer", "method", ...
    name            how the user and other plugins ask for it
    target          "module:attribute", imported by `load`
    summary         one line for `sw list-plugins`
    declared        what the kind declares besides (a rasterizer's features, a metric's direction)
    distribution    the pip distribution it comes from, and its version
    foreign         that is none of ours: what it provides serves who asks for it, and changes nothing for others
    """

    kind: str
    name: str
    target: str
    summary: str
    declared: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))
    distribution: str = ""
    version: str = ""
    foreign: bool = False

    @property
    def whose(self) -> str:
        """`metric 'sharpness' of sw-theirs 0.2`: how a message names it."""
        return f"{self.kind} '{self.name}' of {self.distribution} {self.version}"

    def held(self, *, imports: bool = False) -> contextlib.AbstractContextManager[Any]:
        """A context for code of this entry: a stranger's is kept from changing what is not its own."""
        return strangers_code(self.whose, imports=imports) if self.foreign else contextlib.nullcontext()

    def load(self) -> Any:
        """Import the target. Raises PluginError that names the distribution."""
        module, _, attribute = self.target.partition(":")
        try:
            with prints_to_stderr(), self.held(imports=True):
                found: Any = functools.reduce(getattr, attribute.split("."), importlib.import_module(module))
        except (Exception, SystemExit) as error:
            why = f"{type(error).__name__}: {error}{migration_hint(self.distribution, error)}"
            raise PluginError(f"{self.whose} could not be loaded from {self.target}: {why}") from error
        own = getattr(found, "name", self.name)
        if self.kind == "method" and own != self.name:  # files and records would name what nobody can ask for
            raise PluginError(f"{self.whose} is called '{own}' by its class: {self.target} needs name = '{self.name}'")
        return found


class Registry:
    """The entries of one kind, by name. Plugins see only `add`."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._entries: dict[str, Entry] = {}
        self._clashes: dict[str, list[Entry]] = {}
        self._owner: tuple[str, str, bool] = ("", "", False)
        self.refused: list[tuple[Entry, str]] = []  # (entry, why) of what was added in vain
        self._recorders: list[list[Entry]] = []

    def add(self, name: str, target: str, *, summary: str, **declared: Any) -> None:
        """Add one entry.

        target      "module:attribute"; it is not imported now
        summary     one line
        declared    fields of the kind, plain values that can be printed as JSON; `aliases` of an entry of ours are
                    further names that it is asked for by

        A name of ours stays ours. One that two others claim belongs to neither: asking for it is an error that names
        both. An entry with a name or a field that is not legal is refused alone.
        Raises PluginError if the target is malformed.
        """
        distribution, version, foreign = self._owner
        module_name, separator, attribute = target.partition(":")
        if not (separator and module_name and attribute):
            raise PluginError(
                f"{distribution}: {self.kind} '{name}' has target '{target}'; it must be 'module:attribute'"
            )
        summary = " ".join(str(summary).split())
        entry = Entry(self.kind, name, target, summary, MappingProxyType(declared), distribution, version, foreign)
        fault = illegal(self.kind, name, declared)
        if fault is not None:
            self.refused.append((dataclasses.replace(entry, name=str(name)), fault))
            return
        rivals = [*self._clashes.get(name, ()), *filter(None, [self._entries.get(name)])]
        owner = next((e.distribution for e in rivals if not e.foreign), None)
        if foreign and (owner := owner or catalogue().get(self.kind, {}).get(name)) is not None:
            self.refused.append((entry, TAKEN.format(owner=owner)))
        elif not foreign and any(e.foreign for e in rivals):
            self.refused += [(e, TAKEN.format(owner=distribution)) for e in rivals]
            self._clashes.pop(name, None)
            self._entries[name] = entry
        elif name in self._clashes:
            self._clashes[name].append(entry)
        elif name in self._entries:
            # Neither wins: which one a name means must not depend on the order of installation.
            self._clashes[name] = [self._entries.pop(name), entry]
        else:
            self._entries[name] = entry

    def _withdraw(self, distribution: str) -> None:
        """Take back everything that one distribution added (its hook failed half way)."""
        claims = self._clashes | {n: [e] for n, e in self._entries.items()}
        left = {n: [e for e in found if e.distribution != distribution] for n, found in claims.items()}
        self.refused = [each for each in self.refused if each[0].distribution != distribution]
        # A name that only one other still claims belongs to that one again.
        self._entries = {n: found[0] for n, found in left.items() if len(found) == 1}
        self._clashes = {n: found for n, found in left.items() if len(found) > 1}

    @property
    def clashes(self) -> dict[str, list[Entry]]:
        """Names that several distributions claim; asking for one is an error."""
        return {name: sorted(found, key=lambda e: e.distribution) for name, found in self._clashes.items()}

    @property
    def aliases(self) -> dict[str, Entry]:
        """Further names of entries of ours, those aside that are an entry's own."""
        named = ((alias, e) for e in self if not e.foreign for alias in e.declared.get("aliases", ()))
        return {alias: entry for alias, entry in named if alias not in self._entries}

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self.aliases

    def __iter__(self) -> Iterator[Entry]:
        return iter(sorted(self._entries.values(), key=lambda e: e.name))

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def names(self) -> list[str]:
        """Sorted names that can be asked for, aliases included."""
        return sorted({*self._entries, *self.aliases})

    def of_suffix(self, path: object) -> str | None:
        """Name of the entry whose declared suffix a path has: of ours before others', then the longest; else None."""
        told = [(not e.foreign, e.declared.get("suffix") or "\0", e.name) for e in self]
        return max(((o, len(s), n) for o, s, n in told if str(path).lower().endswith(s)), default=(0, 0, None))[2]

    @property
    def default(self) -> str | None:
        """Name of the entry that a package of ours declares as default; None: it is not installed."""
        return next((e.name for e in self if e.declared.get("default") and is_ours(e.distribution)), None)

    def entry(self, name: str) -> Entry:
        """The entry called `name`, or of which that is an alias.

        Raises PluginError that names the package to install, or suggests the nearest installed name.
        """
        found = self._entries.get(name) or self.aliases.get(name)
        if found is not None:
            return found
        if name in self._clashes:
            owners = " and ".join(f"{e.distribution} {e.version}" for e in self.clashes[name])
            raise PluginError(
                f"{self.kind} '{name}' is claimed by {owners}: uninstall one, or restrict with SW_PLUGINS"
            )
        raise PluginError(
            f"no {self.kind} is called '{name}'; {nearest(self.kind, name, self.names)} (`sw list-plugins` shows all)",
            kind=self.kind,
            name=name,
        )

    def load(self, name: str) -> Any:
        """Import and return what `name` stands for. Raises PluginError as `entry` does, or if the import fails."""
        entry = self.entry(name)
        for record in self._recorders:
            record.append(entry)
        return entry.load()


class TypedRegistry(Registry, Generic[T]):
    """A registry whose targets have the type T: the contract of its kind."""

    def load(self, name: str) -> T:
        """Import and return what `name` stands for. Raises PluginError as `entry` does, or if the import fails."""
        found: T = super().load(name)
        return found


class Coders(Generic[T]):
    """The coders of one sort, typed: those entries of the coder registry that declare `codes` so."""

    def __init__(self, registry: Registry, codes: str) -> None:
        self._registry = registry
        self.codes = codes

    def __contains__(self, name: object) -> bool:
        return name in self.names

    @property
    def names(self) -> list[str]:
        """Sorted names that can be asked for."""
        return [entry.name for entry in self._registry if entry.declared.get("codes") == self.codes]

    def entry(self, name: str) -> Entry:
        """The entry called `name`. Raises PluginError if none of this sort is."""
        if name in self._registry and name not in self.names:
            raise PluginError(
                f"coder '{name}' does not code {self.codes}; those that do: {', '.join(self.names) or 'none'}",
                kind=self._registry.kind,
                name=name,
            )
        return self._registry.entry(name)

    def load(self, name: str) -> Callable[..., T]:
        """The class or factory called `name`. Raises PluginError as `entry` does, or if the import fails."""
        found: Callable[..., T] = self._registry.load(self.entry(name).name)
        return found


def nearest(kind: str, name: str, installed: list[str]) -> str:
    """Hint where `name` could come from: its package, the installed name spelt most alike, or all installed names."""
    package = package_of(kind, name)
    if package is not None:
        return f"it comes with {package}: pip install {package}"
    ours, chosen = catalogue().get(kind, {}).get(name), os.environ.get("SW_PLUGINS")
    if ours is not None and chosen is not None:
        return f"it comes with {ours}, which SW_PLUGINS={chosen} leaves out"
    import difflib

    near = difflib.get_close_matches(name, installed, n=1)
    return f"did you mean '{near[0]}'?" if near else f"installed: {', '.join(installed) or 'none'}"
