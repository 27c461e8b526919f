"""Tests that may take their process down, or hang, run in a process of its own that reports one JSON line a test."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sw_doctor.check import Check, one_line

Step = Callable[[], list[Check]]


@dataclass(frozen=True)
class Answer:
    """What a child process told before it ended.

    checks      of the steps that ended
    died_in     name of the step that it died in, and how; None if it ended by itself
    """

    checks: list[Check]
    died_in: tuple[str, str] | None


def serve(steps: Iterable[tuple[str, Step]]) -> None:
    """In the child: run the steps one by one and report each on what was stdout.

    An exception of a step is its caller's to turn into a finding; one that gets here is a broken check in its name.
    """
    report = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what imported packages print must not stand between the lines
    for name, step in steps:
        print(json.dumps({"begin": name}), file=report, flush=True)
        try:
            found = step()
        except Exception as error:
            found = [Check(name, name, "broken", one_line(f"{type(error).__name__}: {error}"))]
        print(json.dumps({"checks": [c.as_dict() for c in found]}), file=report, flush=True)


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
    begun = "its start"
    for line in output.decode("utf-8", errors="replace").splitlines():
        try:
            told = json.loads(line)
        except ValueError:  # the line in which it died
            break
        if "begin" in told:
            begun = told["begin"]
        else:
            checks += [Check(**content) for content in told["checks"]]
    return Answer(checks, None if end is None else (begun, end))
