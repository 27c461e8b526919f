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
_NAME = re.compile(r"""[\w-]+|"(?:[^"\\\n]|\\.){0,200}"|'[^'\n]{0,200}'""")
"""A part of a key, or a short text."""


def read_toml(path: str | Path, what: str) -> tuple[dict[str, Any], str]:
    """Return tables and text of a file. Raises ConfigError that names it, as `what` where it cannot be read."""
    try:
        # Opening a pipe waits for a writer; a shell gives one of its own as /dev/fd/63.
        if stat.S_ISFIFO(os.stat(path).st_mode) and not str(path).startswith(("/dev/", "/proc/")):
            raise ConfigError(f"cannot read {what} {path}: it is a pipe")
        with open(path, "rb") as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise ConfigError(f"cannot read {what} {path}: {MAX_BYTES:,} bytes are the most")
        text = content.decode()
        _check_keys(text)
        return tomllib.loads(text), text
    except OSError as error:
        raise ConfigError(f"cannot read {what} {path}: {error.strerror or error}") from error
    except RecursionError:
        raise ConfigError(f"{path} is not valid TOML here: its brackets are nested too deeply") from None
    except ValueError as error:  # of the parser, of bytes that are no text, of an integer of many digits
        raise ConfigError(f"{path} is not valid TOML: {error}") from error


def _check_keys(text: str) -> None:
    """Raise ValueError for a key of many parts, also within a text of several lines."""
    if '"""' not in text and "'''" not in text:  # in such a text a # begins no comment
        text = re.sub(r"(?m)^[ \t]*#.*", "", text)
    outline = re.sub(r"[ \t]", "", _NAME.sub("a", text))
    if (found := re.search(rf"(?:a\.){{{MAX_PARTS}}}", outline)) is not None:
        line = outline.count("\n", 0, found.start()) + 1
        raise ValueError(f"line {line} has a key of more than {MAX_PARTS} parts")
