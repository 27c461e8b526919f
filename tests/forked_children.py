"""Processes of `sw`, forked from one that has imported torch: importing it is most of their time.

`sw run` decodes and evaluates in processes of their own, and tests start `sw` beside packages that only another process
has on its path: each does little work after two seconds of imports. A test session starts hundreds. Here a server
imports torch and the core once and forks for each: the child has an own working directory, environment, path of
imports, input and output, and nothing of the test's memory, plugins included; what it runs in fresh processes is forked
from the same server. A child that asks for what only a new interpreter gives (another locale, other threads, hash
seeds) gets one.

Two failures stay unseen here: an import that only the server's own imports make good, and a crash while an interpreter
ends. Inside `starting()` tests start what users start.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import splatwizard_core.runs.fresh

MODULES = ("splatwizard_core.cli.fresh_child", "splatwizard_core")
PLAIN = (
    "SW_", "SPLATWIZARD_", "PYTHONPATH", "PYTEST_", "COV_", "TEST_", "TMPDIR", "HOME", "XDG_", "TORCH_HOME", "COLUMNS",
    "PATH", "CXX",
)  # fmt: skip
"""Variables that mean the same to a process that reads them late; any other difference needs a new interpreter."""


def run_python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Do what `subprocess.run` does of this interpreter with the arguments `-m MODULE ...` or `-c PROGRAM ...`.

    Forked if the session forks. What it prints is kept, as text.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    ran: subprocess.CompletedProcess[str] = splatwizard_core.runs.fresh.subprocess.run(
        [sys.executable, *arguments], **{"env": None, "cwd": None, **pipes, **options}
    )
    return ran


class ForkServer:
    """The server's process, started with the first request and ended with its socket.

    connection      to the server that forked this process; None: this one starts a server of its own
    """

    def __init__(self, connection: socket.socket | None = None, environment: Mapping[str, str] | None = None) -> None:
        self._server: subprocess.Popen[bytes] | None = None
        self._socket = connection
        self._environment = dict(os.environ if environment is None else environment)

    def run(self, command: Sequence[str], **options: Any) -> subprocess.CompletedProcess[str]:
        """Do what `subprocess.run` does, of the command and the options that `run_fresh` and `run_python` use."""
        environment = dict(os.environ) if options["env"] is None else options["env"]
        work = _work(command)
        if work is None or not self._serves(environment):
            return subprocess.run(command, **options)
        with contextlib.ExitStack() as open_files:
            given, out, err = (open_files.enter_context(tempfile.TemporaryFile("w+")) for _ in range(3))
            given.write(options.get("input", ""))
            given.seek(0)
            ended, end = os.pipe()
            stderr = err.fileno() if options["stderr"] == subprocess.PIPE else 2
            request = {**work, "environment": environment, "folder": str(options["cwd"] or os.getcwd())}
            try:
                self._send(
                    json.dumps(request).encode(),
                    [options.get("stdin", given.fileno()), out.fileno(), stderr, end],
                )
            finally:
                os.close(end)
            with open(ended, "rb") as status:
                told = status.read()
            if not told:
                raise RuntimeError("the server that forks fresh processes has died")
            out.seek(0)
            err.seek(0)
            return subprocess.CompletedProcess(command, int(told), out.read(), err.read())

    def _serves(self, environment: Mapping[str, str]) -> bool:
        differing = dict(environment.items() ^ self._environment.items())
        return all(name.startswith(PLAIN) for name in differing)

    def _send(self, request: bytes, files: list[int]) -> None:
        if self._socket is None:
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._server = subprocess.Popen(
                    [sys.executable, __file__, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    env=self._environment,  # not that of the test which asks first
                )
        with tempfile.TemporaryFile() as text:  # an environment may be longer than a packet
            text.write(request)
            text.flush()
            try:
                socket.send_fds(self._socket, [b"run"], [text.fileno(), self._socket.fileno(), *files])
            except OSError as error:
                raise RuntimeError("the server that forks fresh processes has died") from error

    def close(self) -> None:
        """End the server; children that still run go on."""
        if self._server is not None and self._socket is not None:
            self._socket.close()
            self._server.wait()
            self._server = self._socket = None


def _work(command: Sequence[str]) -> dict[str, Any] | None:
    """What a forked child does in place of the command, None if only a new process can."""
    python, kind, what, *arguments = command
    if python != sys.executable or (kind != "-c" and (kind != "-m" or what not in MODULES)):
        return None
    return {"program" if kind == "-c" else "module": what, "arguments": arguments}


@contextlib.contextmanager
def forking() -> Iterator[None]:
    """Fork what `run_fresh` starts, where the system can; the block's end ends the server."""
    if sys.platform != "linux":
        yield
        return
    server, fresh = ForkServer(), splatwizard_core.runs.fresh
    before = fresh.subprocess
    fresh.subprocess = SimpleNamespace(run=server.run, PIPE=subprocess.PIPE)  # type: ignore[assignment]
    try:
        yield
    finally:
        fresh.subprocess = before
        server.close()


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Start new interpreters inside the block, as users' runs do."""
    fresh = splatwizard_core.runs.fresh
    before, fresh.subprocess = fresh.subprocess, subprocess
    try:
        yield
    finally:
        fresh.subprocess = before


def _serve(connection: socket.socket) -> tuple[dict[str, Any], int]:
    """Fork for each request; return in the child its content, which it does, and the descriptor to ask for more.

    The server itself never returns.
    """
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever asked is interrupted, and its child
    while True:
        _, files, _, _ = socket.recv_fds(connection, 16, 6)
        if not files:
            os._exit(0)  # the session has ended
        text, asking, *ends = files
        if os.fork() == 0:  # one process waits for the child and tells its status, so that the server need not
            child = os.fork()
            if child == 0:
                break
            told = str(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])).encode()
            os.write(ends[3], told)
            os._exit(0)
        for file in files:
            os.close(file)
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
    signal.signal(signal.SIGINT, signal.default_int_handler)
    connection.close()
    with open(text, "rb") as request:
        request.seek(0)
        content: dict[str, Any] = json.load(request)
    for wanted, file in enumerate(ends[:3]):
        os.dup2(file, wanted)
    for file in ends:
        os.close(file)
    return content, asking


def _become(content: dict[str, Any], asking: int, ours: list[str]) -> None:
    """Be the process that `python -m MODULE ARGUMENTS` or `python -c PROGRAM ARGUMENTS` would be."""
    import atexit
    import runpy
    import traceback

    import numpy as np
    import torch

    np.random.seed()  # a new interpreter draws both seeds anew; `random` does so after each fork
    torch.seed()
    os.chdir(content["folder"])
    again = ForkServer(socket.socket(fileno=asking), os.environ)
    splatwizard_core.runs.fresh.subprocess = SimpleNamespace(run=again.run, PIPE=subprocess.PIPE)  # type: ignore[assignment]
    os.environ.clear()
    os.environ.update(content["environment"])
    paths = filter(None, content["environment"].get("PYTHONPATH", "").split(os.pathsep))
    sys.path[:] = list(dict.fromkeys([content["folder"], *map(os.path.abspath, paths), *ours]))
    sys.argv[:] = ["-c", *content["arguments"]]
    status = 1
    try:
        if "module" in content:
            runpy.run_module(content["module"], run_name="__main__", alter_sys=True)
        else:
            exec(compile(content["program"], "<string>", "exec"), {"__name__": "__main__"})
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            print(end.code, file=sys.stderr)
    except BaseException:
        traceback.print_exc()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)  # taking the interpreter apart would copy all its memory


if __name__ == "__main__":
    import gc
    import importlib

    for name in ("torch", "numpy", "pydantic", "rich.console", "safetensors.torch", "PIL.Image", "scipy.ndimage"):
        importlib.import_module(name)
    for name in ("cli.main", "runs.decode", "runs.session", "runs.measure", "method", "coding.container"):
        importlib.import_module(f"splatwizard_core.{name}")
    gc.freeze()  # else the children's first collections copy all its memory
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    ours = [path for path in sys.path[1:] if path not in given]  # the first is this file's folder
    _become(*_serve(socket.socket(fileno=int(sys.argv[1]))), ours)
