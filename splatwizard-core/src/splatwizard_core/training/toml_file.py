"""TOML from strangers, configurations and plans of sweeps: bounded before it is parsed."""

from __future__ import annotations

import os
import re
import stat
import sys
from pathlib import Path
from typing import Any

from splatwizard_core.errors import ConfigError

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

MAX_BYTES = 1 << 20
MAX_PARTS = 32
"""Names that a dotted key may have: the parser's time grows with the square of their number."""
MAX_BRACKETS = 100
"""Brackets that may be open at once."""
_NAME = re.compile(r"""[\w-]+|"(?:[^"\\\n]|\\.){0,200}"|'[^'\n]{0,200}'""")
"""A part of a key, or a short text."""


def read_toml(path: str | Path, what: str) -> tuple[dict[str, Any], str]:
    """Return the tables of a file, and its text. Raises ConfigError that names file and line.

    what    for a file that cannot be read, such as "--config"
    """
    try:
        # Opening a pipe waits for a writer; a shell gives one of its own as /dev/fd/63.
        if stat.S_ISFIFO(os.stat(path).st_mode) and not str(path).startswith(("/dev/", "/proc/")):
            raise ConfigError(f"cannot read {what} {path}: it is a pipe")
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ConfigError(f"cannot read {what} {path}: {MAX_BYTES:,} bytes are the most")
        text = content.decode()
    except OSError as error:
        raise ConfigError(f"cannot read {what} {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is not valid TOML: {error}") from error
    _check_nesting(text, path)
    try:
        return tomllib.loads(text), text
    except RecursionError:
        raise ConfigError(f"{path} is nested too deeply") from None
    except (tomllib.TOMLDecodeError, ValueError) as error:  # an integer of many digits is a ValueError
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def _check_nesting(text: str, path: str | Path) -> None:
    """Raise ConfigError for keys of many parts and for deep brackets, those within strings included."""
    if '"""' not in text and "'''" not in text:  # in a text of several lines a # begins no comment
        text = re.sub(r"(?m)^[ \t]*#.*", "", text)
    outline = re.sub(r"[ \t]", "", _NAME.sub("a", text))
    if (found := re.search(rf"(?:a\.){{{MAX_PARTS}}}", outline)) is not None:
        line = outline.count("\n", 0, found.start()) + 1
        raise ConfigError(f"{path}: line {line} has a key of more than {MAX_PARTS} parts")
    depth = 0
    for bracket in re.findall(r"[\[\]{}]", outline):
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0)
        if depth > MAX_BRACKETS:
            raise ConfigError(f"{path}: more than {MAX_BRACKETS} brackets are open at once")
