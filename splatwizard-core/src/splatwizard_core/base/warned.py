"""Warnings that are given once per process."""

import logging

WARNED: list[str] = []
"""Those of this process, which another one for the same run need not repeat."""


def warn_once(line: str) -> None:
    """Log a warning unless it was given already: several rasterizers may share one kernel module, say."""
    if line not in WARNED:
        WARNED.append(line)
        logging.getLogger(__name__).warning("%s", line)
