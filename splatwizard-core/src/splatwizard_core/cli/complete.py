"""Parameters whose words the TAB key completes. The words are known to the command that declares `completes`."""

from __future__ import annotations

from typing import Any, Literal

import click
from click.shell_completion import CompletionItem

COMPLETION_VARIABLE = "_SW_COMPLETE"
"""The shell's script sets it to ask `sw` for completions."""


class Word(click.ParamType):  # type: ignore[type-arg]  # generic only in new releases of click
    """A word, or a comma list of words.

    kind    "rate", "preset", "key", "scene", or the kind of a registry
    paths   the shell offers these beside the words
    """

    name = "text"

    def __init__(self, kind: str, paths: Literal["file", "dir"] | None = None) -> None:
        self.kind, self.paths = kind, paths

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        command = completing_command()
        return [] if command is None else command.items(self, ctx, incomplete)


def completing_command() -> Any:
    """Return the command that knows words by its methods `items` and `hint`; None if it is not installed."""
    from splatwizard_core.plugins import load_plugins

    return next((entry.load() for entry in load_plugins().commands if entry.declared.get("completes")), None)


RATE, PRESET, KEY = Word("rate"), Word("preset"), Word("key")
SCENE, SCENE_OR_FILE = Word("scene", "dir"), Word("scene", "file")
name_of = Word
"""The type of a parameter that takes registered names of a kind."""
