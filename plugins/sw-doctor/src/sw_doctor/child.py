"""A process for steps that may take it down, or hang; it reports one JSON line per step."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from splatwizard_core.tooling import Check
from sw_doctor.text import one_line

Step = Callable[[], list[Check]]


@dataclass(frozen=True)
class Answer:
    """Findings of a child process.

    checks      of the steps that ended
    died_in     name of the step that it died in, and how; None if all steps ended
    """

    checks: list[Check]
    died_in: tuple[str, str] | None


def serve(steps: Iterable[tuple[str, Step]]) -> None:
    """Run the steps one by one, in the child, and report each on what was stdout.

    A step turns its exceptions into findings of its own; one that gets here is a broken check in its name.
    """
    report = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what imported packages print must not stand between the lines
    for name, step in steps:
        print(json.dumps({"begin": name}), file=report, flush=True)
        try:
            told = json.dumps({"checks": [check.as_dict() for check in step()]}, allow_nan=False)
        except (Exception, SystemExit) as error:
            found = Check(name, name, "broken", one_line(f"{type(error).__name__}: {error}"))
            told = json.dumps({"checks": [found.as_dict()]})
        print(told, file=report, flush=True)


def ask(module: str, arguments: Sequence[str] = (), *, timeout: float) -> Answer:
    """Run `python -m MODULE ARGUMENTS`, which serves steps, for at most `timeout` seconds."""
    command = [sys.executable, "-m", module, *arguments]
    try:
        done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout, check=False)
    except subprocess.TimeoutExpired as late:
        return _answer(late.stdout or b"", f"gave no answer within {timeout:g} s")
    if done.returncode == 0:
        return _answer(done.stdout, None)
    if done.returncode < 0:
        return _answer(done.stdout, f"was killed by signal {signal.Signals(-done.returncode).name}")
    lines = done.stderr.decode("utf-8", errors="replace").strip().splitlines()
    return _answer(done.stdout, f"ended with status {done.returncode}: {one_line(lines[-1]) if lines else 'no word'}")


def _answer(output: bytes, end: str | None) -> Answer:
    checks: list[Check] = []
    begun, answered = "its start", True
    for line in output.decode("utf-8", errors="replace").splitlines():
        try:
            told = json.loads(line)
        except ValueError:  # the line in which it died
            break
        if "begin" in told:
            begun, answered = told["begin"], False
        else:
            checks += [Check(**content) for content in told["checks"]]
            answered = True
    if end is None and not answered:
        end = "ended before it had answered"
    return Answer(checks, None if end is None else (begun, end))
