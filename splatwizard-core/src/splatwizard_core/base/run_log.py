"""log.jsonl: one JSON object a line, appended while a run trains; a resumed run takes back what it will do again.

A line is there once its line break is: a reader passes over what follows the last line break.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
from pathlib import Path
from typing import Any

from splatwizard_core.base.files import naming_full_disk, write_atomic


class RunLog:
    """Appends lines to a file; None as the path: keeps nothing.

    Lines have "stage" (index) and "step", then what is logged: "loss", "parts", "lr", "seconds" and the model's
    `counts()`, "scalars" (curves of tasks); or "task" (its name) and what it "said"; or "metrics" (an evaluation),
    after "train_s" seconds of training.
    """

    def __init__(self, path: Path | None) -> None:
        self.path = path

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

    def write(self, stage: int, step: int, **content: Any) -> None:
        """Append one line; a number that is not finite becomes null. Raises DiskFullError; then no part of it stays."""
        if self.path is None:
            return
        line = (json.dumps(_finite({"stage": stage, "step": step, **content})) + "\n").encode()
        self.path.parent.mkdir(parents=True, exist_ok=True)
        before = self.path.stat().st_size if self.path.exists() else 0
        try:
            with naming_full_disk(self.path, len(line)), self.path.open("ab") as file:
                file.write(line)
        except BaseException:
            with contextlib.suppress(OSError):
                os.truncate(self.path, before)
            raise


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return value
