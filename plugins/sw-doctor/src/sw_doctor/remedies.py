"""Advice about a plugin that does not work, in one line."""

from __future__ import annotations

import importlib.metadata
import re

from packaging.utils import canonicalize_name

from sw_doctor.packages import import_names


def remedy_of(distribution: str, why: str, *, foreign: bool) -> str:
    """Return the command that helps against `why`, which a plugin or an entry of `distribution` gave.

    foreign     it is none of ours: a newer version may help, and nobody needs it

    A module that is missing is installed; reinstalling who lacks it would leave it missing.
    """
    _, told, command = why.rpartition("pip install ")
    if told:
        return f"pip install {command}"
    try:
        own = import_names(importlib.metadata.distribution(distribution))
    except Exception:  # not installed, or its metadata cannot be read
        own = [distribution]
    lacks = re.search(r"No module named '([^'.]+)'", why)
    if lacks is not None and canonicalize_name(lacks[1]) not in map(canonicalize_name, own):
        return f"pip install {lacks[1]}"
    if not foreign:
        return f"pip install --force-reinstall --no-deps {distribution}"
    if "its entry point is called" in why:
        return f"pip uninstall {distribution}"
    return f"pip install --upgrade {distribution}  (or, to be without it: pip uninstall {distribution})"
