"""A request to end, while compilers run, ends them and what they started."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(os.name != "posix", reason="processes in groups, as POSIX has them")

BUILD = """
import signal, sys
signal.signal(signal.SIGTERM, signal.default_int_handler)  # as `sw` has it
from splatwizard_native import NativeModule
from sw_doctor.building import build_all
{call}
"""
MODULE = "NativeModule('slow', {package!r}, 'face.h', ('answer.cpp', 'second.cpp')).build()"
ALL = "build_all([{package!r} + '.native:SLOW'])"


def alive(number: int) -> bool:
    """Whether a process runs, and is no zombie."""
    try:
        return Path(f"/proc/{number}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def until(condition) -> None:
    """Wait; looked at so often only by a test that hangs."""
    for _ in range(6_000):
        if condition():
            return
        time.sleep(0.05)
    raise AssertionError("it never came about")


@pytest.mark.parametrize(("call", "jobs"), [(MODULE, 2), (ALL, 1)], ids=["module", "build_all, a file waits"])
def test_sigterm_ends_compilers_and_their_children(package, tmp_path, call, jobs):
    package.write("second.cpp", "int second() { return 2; }\n")
    package.write(
        "native.py",
        "from splatwizard_native import NativeModule\n"
        f"SLOW = NativeModule('slow', '{package.folder.name}', 'face.h', ('answer.cpp', 'second.cpp'))\n",
    )
    notes = tmp_path / "compilers"
    notes.mkdir()
    compiler = tmp_path / "slow-c++"  # starts what does the work, as g++ does
    compiler.write_text(
        f'#!/bin/sh\n[ "$1" = --version ] && exit\nsleep 300 &\necho $$ $! > {notes}/half-$$\n'
        f"mv {notes}/half-$$ {notes}/$$\nwait\n"
    )
    compiler.chmod(0o755)
    code = textwrap.dedent(BUILD).format(call=call.format(package=package.folder.name))
    paths = [str(package.folder.parent), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = {**os.environ, "CXX": str(compiler), "MAX_JOBS": str(jobs), "PYTHONPATH": os.pathsep.join(paths)}
    process = subprocess.Popen([sys.executable, "-c", code], env=environment, stderr=subprocess.PIPE, text=True)
    try:
        until(lambda: len([f for f in notes.iterdir() if f.name.isdigit()]) == jobs)
        numbers = [int(word) for file in notes.iterdir() for word in file.read_text().split()]
        assert all(map(alive, numbers))
        process.send_signal(signal.SIGTERM)
        _, told = process.communicate(timeout=300)
        assert "KeyboardInterrupt" in told
        until(lambda: not any(map(alive, numbers)))  # what was killed has to be taken from the list
    finally:
        process.kill()
