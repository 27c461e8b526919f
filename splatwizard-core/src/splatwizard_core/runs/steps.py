"""Which steps of a run are finished, and from what: so that nothing is done twice."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from splatwizard_core.files import write_json

NAME = "steps.json"


class StepLog:
    """The finished steps of a run directory, each with the key of what went into it and the facts that came out.

    A step counts as done only under the same key, so that changed inputs do it again.
    """

    def __init__(self, directory: Path) -> None:
        self.path = directory / NAME
        self._steps: dict[str, Any] = {}
        try:
            content = json.loads(self.path.read_text())
        except (OSError, ValueError):
            return  # none yet, or damaged: then the steps are done again
        if isinstance(content, dict):
            self._steps = {k: v for k, v in content.items() if isinstance(v, dict) and {"key", "facts"} <= set(v)}

    def done(self, step: str, key: str) -> dict[str, Any] | None:
        """The facts of a finished step, or None if it was not done from these inputs."""
        found = self._steps.get(step)
        return found["facts"] if found is not None and found["key"] == key else None

    def finish(self, step: str, key: str, facts: dict[str, Any]) -> None:
        """Remember a finished step."""
        self._steps[step] = {"key": key, "facts": facts}
        write_json(self.path, self._steps)
