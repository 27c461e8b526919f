"""Run a step of `sw` in a process of its own, which gets what it is told and nothing else."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

from splatwizard_core.base.files import scratch_folder
from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.runs.facts import DecodingFacts

CHILD = (sys.executable, "-m", "splatwizard_core.cli.fresh_child")
HIDDEN = ("SPLATWIZARD_DATA", "SPLATWIZARD_TEST_DATA")


class FreshProcessError(SplatwizardError):
    """The other process failed; its own message stands on stderr already."""


@contextlib.contextmanager
def started_ahead() -> Iterator[Callable[[Sequence[str]], subprocess.CompletedProcess[str]]]:
    """Start a new interpreter, which imports torch while another step runs; `run_fresh` has it do one in its turn."""
    theirs, ours = os.pipe()
    shown = None if sys.stderr.isatty() else subprocess.PIPE
    with subprocess.Popen([*CHILD, "--ahead"], stdin=theirs, stdout=subprocess.PIPE, stderr=shown, text=True) as child:
        os.close(theirs)

        def do(arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
            with contextlib.suppress(BrokenPipeError):  # it has ended already, as its status tells
                os.write(ours, f"{json.dumps(arguments)}\n".encode())
            printed, said = child.communicate()
            return subprocess.CompletedProcess(arguments, child.returncode, printed, said)

        try:
            yield do
        finally:
            os.close(ours)  # which ends it, if it still runs


def run_fresh(
    arguments: Sequence[str], *, alone_in: Path | None = None, told: Collection[str] = (),
    ahead: Callable[[Sequence[str]], subprocess.CompletedProcess[str]] | None = None,
) -> dict[str, Any]:  # fmt: skip
    """Run `sw ARGUMENTS` in a new interpreter and return the JSON object that it prints.

    alone_in    working directory of one that must not find data sets: what names their folders is not in its
                environment; None: it has ours
    told        lines that the user has read already: they are not repeated
    ahead       has an interpreter do it that was started already, by `started_ahead`

    Its progress and messages go to our stderr. Raises UserInputError or FreshProcessError with its own message if
    it fails, KeyboardInterrupt if it was interrupted.
    """
    environment = {k: v for k, v in os.environ.items() if alone_in is None or k not in HIDDEN}
    theirs, ours = os.pipe()  # it ends when we do: we hold the other end of its input, and the system closes it for us
    try:
        # The display of a terminal must reach it live; anything else is kept for the message.
        done = ahead(arguments) if ahead is not None else subprocess.run(
            [*CHILD, *arguments], cwd=alone_in, env=environment, stdin=theirs, stdout=subprocess.PIPE, text=True,
            check=False, stderr=None if sys.stderr.isatty() else subprocess.PIPE,
        )  # fmt: skip
    finally:
        os.close(ours)
        os.close(theirs)
    said = "\n".join(line for line in (done.stderr or "").strip().splitlines() if line not in told)
    name = f"sw {arguments[0]}"
    if done.returncode == 130:
        raise KeyboardInterrupt
    if done.returncode != 0:
        last = said.splitlines()[-1].removeprefix("error: ") if said else "see above"
        kind = UserInputError if done.returncode == 2 else FreshProcessError
        raise kind(f"`{name}` in a fresh process failed (status {done.returncode}): {last}")
    if said:
        print(said, file=sys.stderr, flush=True)
    with contextlib.suppress(ValueError):
        if isinstance(content := json.loads(done.stdout), dict):
            return content
    raise FreshProcessError(f"`{name}` in a fresh process did not print a JSON object: {done.stdout[:200]!r}")


def decode_fresh(path: Path, device: str, *, repeats: int = 3, threads: int = 0) -> DecodingFacts:
    """Decode a file where there is nothing else: an empty folder that holds only the file, no data set in sight.

    repeats     timed decodes
    threads     CPU threads; 0: all cores
    """
    with scratch_folder("decode") as folder:
        copy = folder / path.name
        shutil.copyfile(path, copy)
        arguments = ["decode", copy.name, "--device", device, "--repeats", str(repeats), "--json"]
        told = run_fresh([*arguments, "--set", f"threads={threads}"], alone_in=folder)
        return DecodingFacts.model_validate(told)
