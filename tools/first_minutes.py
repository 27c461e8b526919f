"""A newcomer's first minutes: the commands of README.md and docs/guide.md as pasted, in a fresh clone, with seconds.

    python tools/first_minutes.py                    # until ten minutes are over
    python tools/first_minutes.py --minutes 60       # all of both pages
    python tools/first_minutes.py --here DIR         # in a clone that is there, with the environment that it has

The set-up (`make demo`) comes first, wherever the page has it; then everything else in the order of the pages, each in
a shell of its own with `.venv/bin` on its path. Caches are new: kernels are compiled, the demo scene is drawn. Left
out are the tests and benchmarks of the README, which are no first steps. `path/to/garden` is a small photographed scene
and `path/to/data` an empty folder, which are made between set-up and first command and are not counted.

Prints the seconds and the exit status of each command, the last line of what failed, and what was not reached in
time. Status 1 if a command failed.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PAGES = ("README.md", "docs/guide.md")
SETUP = "make demo"
LATER = ("make", "benchmarks/", "tools/")
"""Beginnings of words of commands that are no first steps."""
PLACES = "sw data synth path/to/garden --size tiny && mkdir -p path/to/data"
OWN = ("PYTHONPATH", "VIRTUAL_ENV", "SPLATWIZARD_CACHE", "SPLATWIZARD_DATA", "OMP_NUM_THREADS", "OMP_WAIT_POLICY")
"""Variables of the environment that a newcomer would not have."""


@dataclass(frozen=True)
class Step:
    """A pasted command; status None: it was not reached in time, or was stopped.

    told    last line that it printed
    """

    command: str
    seconds: float
    status: int | None
    told: str


def commands(page: Path) -> list[str]:
    """Return the lines of a page's indented blocks, without trailing comments."""
    lines = [line[4:] for line in page.read_text("utf-8").splitlines() if line.startswith("    ") and line.strip()]
    return [line.split("  #")[0].split(" # ")[0].strip() for line in lines]


def first_steps(pages: Iterable[Path]) -> list[str]:
    """Return what a newcomer pastes from the pages: the set-up, then every other command once, in order."""
    found = [command for page in pages for command in commands(page)]
    steps = [command for command in found if _is_command(command) and not _is_for_later(command)]
    return list(dict.fromkeys([SETUP, *steps]))


def _is_command(line: str) -> bool:
    words = shlex.split(line, comments=True) if line.count('"') % 2 == 0 else []
    return bool(words) and Path(words[0]).name in ("sw", "python", "export", "pip", "make")


def _is_for_later(command: str) -> bool:
    return any(word.startswith(LATER) for word in shlex.split(command))


def paste(steps: Sequence[str], folder: Path, environment: dict[str, str], seconds: float,
          say: Callable[[str], None] = print) -> list[Step]:  # fmt: skip
    """Run the commands one after another, until their time is over; variables that one exports hold for the next."""
    done: list[Step] = []
    exports = ""
    for command in steps:
        spent = sum(step.seconds for step in done)
        if spent >= seconds:
            done.append(Step(command, 0.0, None, "not reached"))
            continue
        if command.startswith("export "):
            exports += f"{command}\n"
        done.append(_run(exports + command, command, folder, environment, seconds - spent))
        step = done[-1]
        say(f"{step.seconds:8.1f} s  {'late' if step.status is None else step.status:>4}  {command}")
        if step.status:
            say(f"{'':17}{step.told}")
    return done


def _run(script: str, command: str, folder: Path, environment: dict[str, str], seconds: float) -> Step:
    began = time.monotonic()
    process = subprocess.Popen(
        ["bash", "-c", script], cwd=folder, env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, errors="replace", start_new_session=True,
    )  # fmt: skip
    try:
        text, _ = process.communicate(timeout=seconds)
        status: int | None = process.returncode
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGTERM)
        text, status = process.communicate()[0], None
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return Step(command, time.monotonic() - began, status, lines[-1] if lines else "")


def newcomer(home: Path, clone: Path) -> dict[str, str]:
    """Return the environment of someone who has installed nothing."""
    kept = {name: value for name, value in os.environ.items() if name not in OWN}
    path = os.pathsep.join([str(clone / ".venv" / "bin"), *_outside_environments(kept.get("PATH", ""))])
    return {**kept, "PATH": path, "XDG_CACHE_HOME": str(home / "cache"), "PIP_CACHE_DIR": _pip_cache(kept)}


def _outside_environments(path: str) -> list[str]:
    return [folder for folder in path.split(os.pathsep) if not (Path(folder).parent / "pyvenv.cfg").exists()]


def _pip_cache(environment: dict[str, str]) -> str:
    """Return where downloads are kept: what a package weighs is not what is measured."""
    return environment.get("PIP_CACHE_DIR") or str(Path.home() / ".cache" / "pip")


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="after which no command is begun (default: 10)")
    parser.add_argument("--here", type=Path, metavar="DIR", help="a clone that is there (default: a fresh one)")
    args = parser.parse_args()
    home = Path(tempfile.mkdtemp(prefix="first-minutes-"))
    try:
        clone = args.here or home / "splatwizard"
        if args.here is None:
            subprocess.run(["git", "clone", "-q", str(ROOT), str(clone)], check=True)
        clone = clone.resolve()
        environment, seconds = newcomer(home, clone), 60 * args.minutes
        setup, *others = first_steps(clone / page for page in PAGES)
        done = paste([setup], clone, environment, seconds)
        if done[0].status == 0:
            subprocess.run(["bash", "-c", PLACES], cwd=clone, env=environment, check=True, capture_output=True)
            done += paste(others, clone, environment, seconds - done[0].seconds)
    finally:
        shutil.rmtree(home, ignore_errors=True)
    failed = [step for step in done if step.status]
    late = [step for step in done if step.status is None]
    total = sum(step.seconds for step in done)
    print(f"{len(done) - len(failed) - len(late)} commands in {total:.0f} s; {len(failed)} failed, {len(late)} not "
          f"reached or not finished in {args.minutes:g} minutes")  # fmt: skip
    for step in late:
        print(f"{'':10}  late  {step.command}")
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
