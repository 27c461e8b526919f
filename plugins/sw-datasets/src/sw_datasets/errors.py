"""Errors of fetching data sets."""

from __future__ import annotations

from splatwizard_core.api import SplatwizardError


class FetchError(SplatwizardError):
    """A data set could not be downloaded, verified or unpacked.

    address     where it was to come from, if that is known
    """

    def __init__(self, message: str, *, address: str | None = None) -> None:
        super().__init__(message)
        self.address = address


class UnreachableError(FetchError):
    """Nothing comes from an address: no connection, or an answer that there is no such file, or not for everybody."""


class ArchiveError(FetchError):
    """An archive is damaged or hostile, or does not hold what it should."""
