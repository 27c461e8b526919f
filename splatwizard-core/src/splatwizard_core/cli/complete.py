"""Words that the TAB key completes: registered names, rate points, presets, scenes; only keys take importing torch."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import click
from click.shell_completion import CompletionItem

if TYPE_CHECKING:
    from splatwizard_core.plugins import Entry

COMPLETION_VARIABLE = "_SW_COMPLETE"
"""The shell's script sets it to ask `sw` for completions."""
DATA = "SPLATWIZARD_DATA"  # the room that reads scenes has it too, and imports torch
# What every method has (design: presets `paper` and `quick`, the aliases of rate points).
COMMON_PRESETS = ("paper", "quick")
RATE_ALIASES = ("low", "default", "high", "all")
MOST = 500  # items; nobody reads more, and a folder may hold a hundred thousand

Find = Callable[[click.Context], Mapping[str, "str | None"]]


class Word(click.ParamType):  # type: ignore[type-arg]  # generic only in new releases of click
    """A word, or a comma list of words, that `find` knows: (context) -> word -> a line about it, or None.

    paths   the shell offers these beside the words
    """

    name = "text"

    def __init__(self, find: Find, paths: Literal["file", "dir"] | None = None) -> None:
        self.find, self.paths = find, paths

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Complete the last word of the list; those that stand in it already are not offered again."""
        before, comma, _ = incomplete.rpartition(",")
        known = {before + comma + word: told for word, told in self.find(ctx).items() if word not in before.split(",")}
        items = [CompletionItem(word, help=told) for word, told in known.items() if word.startswith(incomplete)]
        return [*([CompletionItem(incomplete, type=self.paths)] if self.paths else []), *items[:MOST]]


def name_of(kind: str) -> Word:
    """Return the type of a parameter that takes registered names of a kind."""
    return Word(lambda _: {entry.name: entry.summary for entry in _registered(kind)})


def _scenes(_context: click.Context) -> dict[str, str | None]:
    """Find the default scene, and dataset/scene below $SPLATWIZARD_DATA."""
    found: dict[str, str | None] = {e.name: e.summary for e in _registered("dataset") if e.declared.get("default")}
    if root := os.environ.get(DATA):
        folders = (path for path in Path(root).expanduser().glob("[!.]*/[!.]*") if path.is_dir())
        found |= {f"{path.parent.name}/{path.name}": None for path in sorted(folders)}
    return found


def _registered(kind: str) -> Iterable[Entry]:
    from splatwizard_core.plugins import load_plugins

    return load_plugins().registries[kind]


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


def _keys(context: click.Context) -> dict[str, str | None]:
    """Keys of --set: of these methods, which are imported for it, of the run and of the scene."""
    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.training.keys import block_keys
    from splatwizard_core.training.params import PipelineParams, SceneParams

    found: dict[str, str | None] = {}
    for entry in _methods(context):
        with contextlib.suppress(Exception):  # one that is broken offers nothing
            config = entry.load().Config
            found |= {**block_keys(config), **config().settings_keys(load_plugins())}
    return {f"{key}=": told for key, told in (found | block_keys(PipelineParams) | block_keys(SceneParams)).items()}


RATE = Word(lambda context: dict.fromkeys([*_declared(context, "rates"), *RATE_ALIASES]))
PRESET = Word(lambda context: dict.fromkeys(_declared(context, "presets") or COMMON_PRESETS))
KEY = Word(_keys)
SCENE = Word(_scenes, "dir")
SCENE_OR_FILE = Word(_scenes, "file")
