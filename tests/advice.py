"""Advice in messages, as the code writes it: without the place of pip and of what it installs."""

from __future__ import annotations

import re


def as_written(text: str) -> str:
    """Return a text with `pip` for the pip of an environment, and names for the wheels in a folder."""
    text = re.sub(r"\S*(?:/pip|python\S* -m pip)(?= (?:un)?install)", "pip", text)
    found = re.sub(r"(pip install(?: -\S+)*) --find-links \S+((?: '[^']+')+)", _unquoted, text)
    return re.sub(r" \(WHEELS: [^)]*\)", "", found)


def _unquoted(found: re.Match[str]) -> str:
    return found[1] + re.sub(r"'([\w-]+)'", r"\1", found[2])
