"""Installed distributions of strangers, as importlib.metadata sees them: modules and metadata in a folder."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from forked_children import run_python


@dataclass(frozen=True)
class Site:
    """A folder of installed distributions, and `sw` in a process that has it on its path before all else."""

    folder: Path

    def install(
        self,
        name: str,
        source: str,
        *,
        key: str | None = None,
        requires: Iterable[str] = (),
        metadata: bytes | None = None,
        **modules: str,
    ) -> str:
        """Write the distribution `name` 0.1 whose plugin module is `source`; returns the module's name.

        key         name of its entry point; None: that of the distribution without `sw-`
        metadata    content of METADATA instead of a sound one; empty: there is none
        modules     further modules that it brings
        """  # fmt: skip
        module = name.replace("-", "_")
        info = self.folder / f"{module}-0.1.dist-info"
        info.mkdir(parents=True)
        for each, text in {module: source, **modules}.items():
            (self.folder / f"{each}.py").write_text(HEAD + textwrap.dedent(text))
        if metadata is None:
            needs = "".join(f"Requires-Dist: {line}\n" for line in requires)
            metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1\n{needs}\n".encode()
        if metadata:
            (info / "METADATA").write_bytes(metadata)
        (info / "entry_points.txt").write_text(f"[splatwizard]\n{key or name.removeprefix('sw-')} = {module}\n")
        files = [f"{each}.py" for each in (module, *modules)] + [f"{info.name}/entry_points.txt"]
        (info / "RECORD").write_text("".join(f"{file},,\n" for file in files))
        return module

    def sw(self, *arguments: object, check: bool = True, **env: str) -> subprocess.CompletedProcess[str]:
        """Run `sw ARGUMENTS`; AssertionError with its output if it fails or shows a traceback."""
        done = self.run("-m", "splatwizard_core", *map(str, arguments), **env)
        told = f"sw {' '.join(map(str, arguments))} exited {done.returncode}:\n{done.stdout}\n{done.stderr}"
        assert done.returncode == 0 or not check, told
        assert "Traceback" not in done.stderr, told
        return done

    def sw_each(self, commands: Sequence[Sequence[str]]) -> list[Done]:
        """Run several commands one after the other in one process, which imports what they need once."""
        done = self.run("-c", EACH, given=json.dumps(commands))
        assert done.returncode == 0, done.stderr
        return [Done(*each) for each in json.loads(done.stdout)]

    def run(
        self, *arguments: str, given: str = "", cwd: Path | None = None, **env: str
    ) -> subprocess.CompletedProcess[str]:
        """Run Python, with its path, from its folder or another one."""
        return run_python(*arguments, cwd=cwd or self.folder, env=self._environment(env), input=given)

    def _environment(self, more: Mapping[str, str]) -> dict[str, str]:
        path = os.pathsep.join([str(self.folder), *filter(None, [os.environ.get("PYTHONPATH")])])
        kept = {k: v for k, v in os.environ.items() if not k.startswith(("SW_", "_SW_"))}
        return {**kept, "PYTHONPATH": path, **more}

    def start(self, *arguments: str, **env: str) -> subprocess.Popen[str]:
        """Start `sw ARGUMENTS` as a foreground process of a terminal would run: Ctrl-C (SIGINT) reaches it."""

        def heed_interrupts() -> None:
            # What a shell started in the background ignores, its children ignore too.
            signal.signal(signal.SIGINT, signal.SIG_DFL)

        return subprocess.Popen(
            [sys.executable, "-m", "splatwizard_core", *arguments], cwd=self.folder, env=self._environment(env),
            stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, preexec_fn=heed_interrupts,
        )  # fmt: skip

    def listed(self, **env: str) -> Listed:
        """`sw list-plugins --json`."""
        return Listed(json.loads(self.sw("list-plugins", "--json", **env).stdout))


EACH = """
import contextlib, io, json, logging, sys
from splatwizard_core.cli.main import main

found = []
for arguments in json.load(sys.stdin):
    out, err = io.StringIO(), io.StringIO()
    logging.basicConfig(stream=err, level=logging.WARNING, format="%(levelname)s: %(message)s", force=True)
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        status = main(arguments)
    found.append([status, out.getvalue(), err.getvalue()])
print(json.dumps(found))
"""
HEAD = "from splatwizard_core.api import hookimpl\n"


@dataclass(frozen=True)
class Done:
    """Exit status of a command, and what it said."""

    status: int
    stdout: str
    stderr: str


@dataclass(frozen=True)
class Listed:
    """What `sw list-plugins --json` prints."""

    content: Mapping[str, Any]

    def of(self, distribution: str) -> dict[str, Any]:
        """The row of a distribution."""
        (row,) = (row for row in self.content["plugins"] if row["distribution"] == distribution)
        return row

    @property
    def names(self) -> set[str]:
        """Names of all distributions."""
        return {row["distribution"] for row in self.content["plugins"]}

    @property
    def working(self) -> dict[str, set[str]]:
        """Distribution -> "kind name" of all that it provides, of those that are not broken."""
        rows = (row for row in self.content["plugins"] if row["error"] is None)
        return {row["distribution"]: {f"{e['kind']} {e['name']}" for e in row["provides"]} for row in rows}
