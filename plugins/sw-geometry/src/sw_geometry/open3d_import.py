"""The import of Open3D, which is large, optional, and needs libraries of the system."""

from __future__ import annotations

import importlib
from functools import cache
from types import ModuleType
from typing import Any

from splatwizard_core.api import CapabilityError

EXTRA = "sw-geometry[mesh]"
SYSTEM_PACKAGES = "libgl1 libegl1 libx11-6 libgomp1 libusb-1.0-0"
"""Debian's and Ubuntu's packages with the libraries that its wheels do not bring."""


class Open3DMissing(CapabilityError):  # noqa: N818 (a fact about the machine, as its base says)
    """Open3D cannot be imported here."""


@cache
def import_open3d() -> Any:
    """Open3D, imported when it is first needed: it takes a second.

    Raises Open3DMissing in one line: it is not installed, a library of the system is missing, or it is broken.
    """
    try:
        found: ModuleType = importlib.import_module("open3d")
    except ImportError as error:
        raise Open3DMissing(why_not(error)) from error
    return found


def why_not(error: ImportError) -> str:
    """One line about an import that failed, with what mends it."""
    if isinstance(error, ModuleNotFoundError) and error.name == "open3d":
        return f"meshes need Open3D: pip install '{EXTRA}'"
    told = " ".join(str(error).split())
    if ".so" in told:
        return f"Open3D needs a library of the system ({told}): apt install {SYSTEM_PACKAGES} (Debian, Ubuntu)"
    return f"Open3D is installed and cannot be imported ({told}): pip install --force-reinstall '{EXTRA}'"
