"""log.jsonl: one JSON object a line, appended while a run trains; a resumed run takes back what it will do again."""

from __future__ import annotations

import json
import math
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from splatwizard_core.files import write_atomic


class RunLog:
    """Appends lines to a file; None as the path: keeps nothing.

    Lines have "stage" (index) and "step", then what is logged: "loss", "parts", "num_gaussians" or "num_anchors",
    "lr", "seconds"; or "task" (a task that logs); or "metrics" (an evaluation).
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self._file: TextIO | None = None

    def rewind(self, stage: int, step: int) -> None:
        """Drop the lines after this step of this stage (and a last line that was cut off)."""
        if self.path is None or not self.path.exists():
            return
        kept = []
        for line in self.path.read_text(encoding="utf-8", errors="replace").splitlines():
            try:
                content = json.loads(line)
                if (content["stage"], content["step"]) <= (stage, step):
                    kept.append(line + "\n")
            except (ValueError, KeyError, TypeError):
                continue
        write_atomic(self.path, "".join(kept))

    def clear(self) -> None:
        """Start the file again."""
        if self.path is not None:
            self.path.unlink(missing_ok=True)

    def __enter__(self) -> RunLog:
        if self.path is not None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self.path.open("a", encoding="utf-8", buffering=1)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file is not None:
            self._file.close()
            self._file = None

    def write(self, stage: int, step: int, **content: Any) -> None:
        """Append one line; a number that is not finite becomes null."""
        if self._file is not None:
            self._file.write(json.dumps(_finite({"stage": stage, "step": step, **content})) + "\n")


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value
