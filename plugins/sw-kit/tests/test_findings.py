"""A finding tells the reason and what mends it, and never raises."""

from __future__ import annotations

from sw_kit.finding import BrokenContractError, NotCheckedError, PackageCheck

from splatwizard_core.api import (
    ConfigError,
)
from splatwizard_core.tooling import load_plugins

PLUGINS = load_plugins()


def test_a_finding_tells_reason_and_cure_and_never_raises():
    def raising(error):
        def check():
            raise error

        return PackageCheck("sw-bad", "name", check).finding()

    broken = raising(BrokenContractError("why", "do this"))
    assert (broken.state, broken.detail, broken.mend) == ("broken", "why", "do this")
    # What says itself what to do has no second line; an error of Python's has the way to its traceback.
    assert raising(ConfigError("'k' is unknown: say 'key'")).mend is None
    assert raising(AssertionError("cut sections must be refused")).mend is None
    assert "--debug" in raising(AssertionError()).mend
    assert "--debug" in raising(KeyError("k")).mend
    assert raising(NotCheckedError("no GPU", "find one")).state == "missing"
    assert raising(SystemExit(3)).detail == "SystemExit: 3"
    assert PackageCheck("sw-bad", "name", lambda: "fine").finding().state == "ok"
