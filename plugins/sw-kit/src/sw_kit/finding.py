"""One check of a package: a function that raises if something does not hold, and the line that tells of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from splatwizard_core.api import SplatwizardError
from splatwizard_core.tooling import Check

log = logging.getLogger(__name__)


class BrokenContractError(AssertionError):
    """A contract that a package does not keep: the reason in one line, and what mends it."""

    def __init__(self, reason: str, mend: str) -> None:
        super().__init__(f"{reason} -> {mend}")
        self.reason, self.mend = reason, mend


class NotCheckedError(Exception):
    """A check that cannot be made here: the reason, and what makes it possible."""

    def __init__(self, reason: str, mend: str) -> None:
        super().__init__(f"{reason} -> {mend}")
        self.reason, self.mend = reason, mend


@dataclass(frozen=True)
class PackageCheck:
    """One check of one distribution. Called, it raises BrokenContractError, NotCheckedError or what was raised inside.

    name        what is checked: "registration is light", "method 'hac' runs"
    function    () -> what was found, in one line
    """

    distribution: str
    name: str
    function: Callable[[], str]

    def __call__(self) -> str:
        return self.function()

    def __str__(self) -> str:
        return self.name

    def finding(self) -> Check:
        """Make the check; the outcome as one line, whatever happens."""
        try:
            return Check(self.distribution, self.name, "ok", self.function())
        except NotCheckedError as error:
            return Check(self.distribution, self.name, "missing", error.reason, error.mend)
        except BrokenContractError as error:
            return Check(self.distribution, self.name, "broken", error.reason, error.mend)
        except (Exception, SystemExit) as error:
            log.debug("%s: %s", self.distribution, self.name, exc_info=True)
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            tells = isinstance(error, (SplatwizardError, AssertionError)) and str(error)  # its line says what to do
            mend = None if tells else "--debug shows the traceback"
            return Check(self.distribution, self.name, "broken", reason[:600], mend)


def hold(condition: object, reason: str, mend: str) -> None:
    """Raise BrokenContractError unless a condition holds."""
    if not condition:
        raise BrokenContractError(reason, mend)
