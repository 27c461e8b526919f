"""Words on the command line by kind: registered names, rate points, presets, scenes; only keys take importing torch."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from click.shell_completion import CompletionItem

from splatwizard_core.tooling import load_plugins

if TYPE_CHECKING:
    import click

    from splatwizard_core.tooling import Entry

DATA = "SPLATWIZARD_DATA"  # `tooling.DATA_VARIABLE` says the same, and imports torch
# What every method has (design: presets `paper` and `quick`, the aliases of rate points).
COMMON_PRESETS = ("paper", "quick")
RATE_ALIASES = ("low", "default", "high", "all")
MOST = 500  # items; nobody reads more, and a folder may hold a hundred thousand


def items(kind: str, paths: str | None, context: click.Context, incomplete: str) -> list[CompletionItem]:
    """Complete the last word of a comma list; those that stand in it already are not offered again.

    kind    as that of `Word` in the core
    paths   "file" or "dir": the shell offers these besides
    """
    before, comma, _ = incomplete.rpartition(",")
    known = {
        before + comma + word: told for word, told in words(kind, context).items() if word not in before.split(",")
    }
    found = [CompletionItem(word, help=told) for word, told in known.items() if word.startswith(incomplete)]
    return [*([CompletionItem(incomplete, type=paths)] if paths else []), *found[:MOST]]


def words(kind: str, context: click.Context) -> Mapping[str, str | None]:
    """Return the words of a kind, each with a line about it."""
    find = KINDS.get(kind)
    return {entry.name: entry.summary for entry in _registered(kind)} if find is None else find(context)


def _registered(kind: str) -> Iterable[Entry]:
    return load_plugins().registries[kind]


def _scenes(_context: click.Context) -> Mapping[str, str | None]:
    """Find the default scene, and dataset/scene below $SPLATWIZARD_DATA."""
    found: dict[str, str | None] = {e.name: e.summary for e in _registered("dataset") if e.declared.get("default")}
    if root := os.environ.get(DATA):
        folders = (path for path in Path(root).expanduser().glob("[!.]*/[!.]*") if path.is_dir())
        found |= {f"{path.parent.name}/{path.name}": None for path in sorted(folders)}
    return found


def _methods(context: click.Context) -> list[Entry]:
    """The methods on the command line, else the default one; none where the command takes none."""
    if not {"method", "methods"} & {each.name for each in context.command.params}:
        return []
    given = context.params.get("methods") or context.params.get("method") or ()
    named = {name.strip() for text in ([given] if isinstance(given, str) else given) for name in text.split(",")}
    return [e for e in _registered("method") if (e.name in named if named else e.declared.get("default"))]


def _declared(context: click.Context, field: str) -> list[str]:
    """Declared values of these methods, without importing them."""
    return [value for entry in _methods(context) for value in entry.declared.get(field, ())]


def _rates(context: click.Context) -> Mapping[str, str | None]:
    return dict.fromkeys([*_declared(context, "rates"), *RATE_ALIASES])


def _presets(context: click.Context) -> Mapping[str, str | None]:
    return dict.fromkeys(_declared(context, "presets") or COMMON_PRESETS)


def _keys(context: click.Context) -> Mapping[str, str | None]:
    """Keys of --set: of these methods, which are imported for it, of the run and of the scene."""
    from splatwizard_core.api import PipelineParams
    from splatwizard_core.tooling import SceneParams, block_keys

    found: dict[str, str | None] = {}
    for entry in _methods(context):
        with contextlib.suppress(Exception):  # one that is broken offers nothing
            config = entry.load().Config
            found |= {**block_keys(config), **config().settings_keys(load_plugins())}
    return {f"{key}=": told for key, told in (found | block_keys(PipelineParams) | block_keys(SceneParams)).items()}


KINDS: Mapping[str, Callable[[click.Context], Mapping[str, str | None]]] = {
    "rate": _rates, "preset": _presets, "key": _keys, "scene": _scenes,
}  # fmt: skip
"""Kind that is no registry's -> words."""
