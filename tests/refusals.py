"""What a reader says of a file that it refuses, and how much it does before."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from counted_lines import lines_of

from splatwizard_core.api import SplatwizardError


def refusal(work: Callable[[], object]) -> tuple[int, str]:
    """Lines of Python that are executed until `work` raises SplatwizardError, and its message."""
    said = []

    def refused() -> None:
        with pytest.raises(SplatwizardError) as caught:
            work()
        said.append(str(caught.value))

    return lines_of(refused), said[0]
