"""`python -m sw_doctor.child_check NAME`: run one registered check in this process."""

from __future__ import annotations

import functools
import json
import sys

from splatwizard_core.tooling import Check, load_plugins
from sw_doctor.child import serve
from sw_doctor.registered import failed
from sw_doctor.text import one_line


def run_check(name: str) -> list[Check]:
    """Findings of the check of this name; whatever it raises, or returns instead of findings, is a broken one."""
    entry = load_plugins().checks.entry(name)
    try:
        found = entry.load()()
        if not isinstance(found, list) or not all(isinstance(each, Check) for each in found):
            raise TypeError(f"it returned {found!r}, which is no list of Check")
        json.dumps([check.facts for check in found], allow_nan=False)
    except (Exception, SystemExit) as error:
        return [failed(entry, one_line(f"failed: {type(error).__name__}: {error}"))]
    return found


if __name__ == "__main__":
    serve([(sys.argv[1], functools.partial(run_check, sys.argv[1]))])
