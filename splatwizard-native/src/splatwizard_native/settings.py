"""Settings from the environment: the cache folder, the switches, and the longest wait for another process."""

import os
import sys
from pathlib import Path

BUILD_TIMEOUT = 600.0
SWITCHED_OFF = "native code is switched off by SPLATWIZARD_NATIVE=0"


def cache_root() -> Path:
    """Folder of this user's caches: $SPLATWIZARD_CACHE, else the platform's cache folder."""
    chosen = os.environ.get("SPLATWIZARD_CACHE")
    if chosen:
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "splatwizard"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", str(Path.home()))) / "splatwizard"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "splatwizard"


def switched_off() -> bool:
    """Whether $SPLATWIZARD_NATIVE asks to do without native code."""
    return os.environ.get("SPLATWIZARD_NATIVE", "1").strip().lower() in ("0", "off", "no", "false")


def fast_enabled() -> bool:
    """Whether functions in `fast/` folders stand in for the plain ones, to the same result: unless $SW_FAST is 0."""
    return os.environ.get("SW_FAST", "1").strip().lower() not in ("0", "off", "no", "false")


def build_timeout() -> float:
    """Seconds to wait for another process's build: $SPLATWIZARD_BUILD_TIMEOUT, else 600."""
    try:
        return float(os.environ.get("SPLATWIZARD_BUILD_TIMEOUT", BUILD_TIMEOUT))
    except ValueError:
        return BUILD_TIMEOUT
