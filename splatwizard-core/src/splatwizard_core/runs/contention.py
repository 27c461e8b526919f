"""Name the timed phases of a run that had to share the cores with other processes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from splatwizard_native import CoreTime

CONTENDED = "contended"  # the flag, and the key of a step's facts


def contention(phase: str, cores: CoreTime) -> dict[str, float]:
    """Return the phase, timed since `cores` was made, with the share of the cores that it had; empty if it had all."""
    share = cores.shortage()
    return {} if share is None else {phase: share}


def contended_phases(*steps: Mapping[str, Any]) -> dict[str, float]:
    """Return the phases of all steps that had to share; an older release noted none."""
    return {phase: share for facts in steps for phase, share in facts.get(CONTENDED, {}).items()}
