"""An option that a command lacks, where its name is that of a key of `--set`."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Sequence

import click

from sw_doctor.words import words


def set_hint(error: click.NoSuchOption, arguments: Sequence[str]) -> str | None:
    """Return what to give in place of `--iterations 300`, or of `--grad-threshold=4e-4`; None: no key is called so.

    Keys are those of the methods on the command line, of the run and of the scene.
    """
    context = error.ctx
    if context is None or not {"sets", "config_file"} & {each.name for each in context.command.params}:
        return None
    given, equals, value = next(
        (word.partition("=") for word in arguments if _named(word, error.option_name)), ("", "", "")
    )
    if not given:
        return None
    methods = [after for word, after in itertools.pairwise(arguments) if word in ("--method", "-m")]
    context.params["methods"] = tuple(methods)  # the parser did not come so far
    keys = [key.removesuffix("=") for key in words("key", context)]
    name = _plain(given)
    found = [key for key in keys if _plain(key) == name] or [
        key for key in keys if _plain(key.rpartition(".")[2]) == name
    ]
    if not found:
        return None
    if not equals:
        after = next((after for word, after in itertools.pairwise(arguments) if word == given), "VALUE")
        value = "VALUE" if after.startswith("--") else after
    told = " or ".join(f"--set {shlex.quote(f'{key}={value}')}" for key in found[:3])
    return f"no option {given}: it is a key of the configuration, give {told}"


def _named(word: str, option: str) -> bool:
    return word.partition("=")[0] == option


def _plain(name: str) -> str:
    return name.lstrip("-").replace("-", "_")
