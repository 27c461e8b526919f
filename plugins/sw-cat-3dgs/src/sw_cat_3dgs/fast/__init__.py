"""Faster functions of the same signatures as the plain ones, each held against its plain one by a test."""

from __future__ import annotations

import os


def wanted() -> bool:
    """Return whether to run them: yes, unless the environment says `SW_FAST=0`."""
    return os.environ.get("SW_FAST", "") != "0"
