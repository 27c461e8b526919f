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


class ArchiveError(FetchError):
    """An archive is damaged or hostile, or does not hold what it should."""
