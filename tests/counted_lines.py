"""Lines of Python that a piece of work executes: they stand for time, and are the same on every machine, however busy.

What a single line does in C counts as one; memory bounds that where it matters.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from types import FrameType
from typing import Any

TRACED = """
import atexit, json, sys
count = 0
def trace(frame, event, argument):
    global count
    if frame.f_code.co_filename.startswith("<frozen importlib"):
        return None
    count += event == "line"
    return trace
def tell():
    sys.settrace(None)
    print("\\n" + json.dumps([count, sorted(sys.modules)]), file=sys.__stdout__)
atexit.register(tell)
sys.argv[:] = {argv!r}
sys.settrace(trace)
exec(compile({program!r}, "program", "exec"), {{"__name__": "__main__"}})
"""


def lines_of(work: Callable[[], Any]) -> int:
    """Lines that are executed in this thread until `work` returns, its own and those of what it calls."""
    count, before = 0, sys.gettrace()

    def trace(frame: FrameType, event: str, argument: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    sys.settrace(trace)
    try:
        work()
    finally:
        sys.settrace(before)
    return count


def lines_of_process(program: str, *arguments: str) -> tuple[int, list[str]]:
    """Lines that `python -c PROGRAM ARGUMENTS` executes, and the modules that it has imported in the end.

    Once untraced before, so that no module has to be compiled. The search for modules does not count: it goes through
    as many folders as the path happens to have.
    """
    subprocess.run([sys.executable, "-c", program, *arguments], capture_output=True, check=True, timeout=300)
    traced = TRACED.format(program=program, argv=["-c", *arguments])
    done = subprocess.run([sys.executable, "-c", traced], capture_output=True, text=True, check=True, timeout=300)
    count, modules = json.loads(done.stdout.splitlines()[-1])
    return count, modules
