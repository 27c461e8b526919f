"""The package keeps the contracts of Splatwizard; `sw check-plugin sw-third-party` adds a small run."""

import pytest
from sw_kit.suite import checks_of


@pytest.mark.parametrize("check", checks_of("sw-third-party", quick=True), ids=str)
def test_contract(check):
    check()
