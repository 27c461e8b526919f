"""Errors of native modules; each message says what is wrong and what to do."""

from __future__ import annotations


class NativeBuildError(Exception):
    """A native module cannot be compiled or loaded."""


class CompilerMissingError(NativeBuildError):
    """There is no compiler on this machine."""
