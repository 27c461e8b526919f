"""Processes of `sw`, forked from one that has imported torch: importing it is most of their time.

`sw run` decodes and evaluates in processes of their own, and tests start `sw` beside packages that only another process
has on its path: each does little work after two seconds of imports. A test session starts hundreds. Here a server
imports torch, the core and what of the plugins nearly every run needs once and forks for each: the child has an own
working directory, environment, path of imports, input and output, and nothing of the test's memory; modules of plugins
are not there until it imports one of them; what it runs in fresh processes is forked from the same server. A child
that asks for what only a new interpreter gives (another locale, other threads, hash seeds) gets one.

Two failures stay unseen here: an import that only the server's own imports make good, and a crash while an interpreter
ends. Inside `starting()` tests start what users start.
"""

from __future__ import annotations

import contextlib
import copy
import ctypes
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping
from importlib.machinery import ModuleSpec
from importlib.metadata import entry_points
from types import ModuleType, SimpleNamespace
from typing import IO, Any

import splatwizard_core.runs.fresh
from splatwizard_core.plugins import PluginManager, loading

MODULES = (
    "splatwizard_core.cli.fresh_child", "splatwizard_core", "sw_bench.child", "sw_doctor.probe", "sw_doctor.imports",
    "sw_doctor.child_check",
)  # fmt: skip
PLAIN = (
    "SW_", "_SW_", "SPLATWIZARD_", "PYTHONPATH", "PYTEST_", "COV_", "TEST_", "TMPDIR", "HOME", "XDG_", "TORCH_HOME",
    "COLUMNS", "PATH", "CXX", "TOY_", "OMP_NUM_THREADS", "PYTHONDONTWRITEBYTECODE", "TORCHINDUCTOR_", "GLIBC_TUNABLES",
    "CUBLAS_WORKSPACE_CONFIG",
)  # fmt: skip
"""Variables that mean the same to a process that reads them late; any other difference needs a new interpreter.

TORCHINDUCTOR_ and CUBLAS_WORKSPACE_CONFIG are set by a training: without them every run after the first training of a
session would get one.
"""
BIG_PAGES = {"GLIBC_TUNABLES": "glibc.malloc.hugetlb=1"}
"""Lets the server's memory lie in big pages, of which a fork copies few entries."""
THEIRS = (
    "torch", "numpy", "pydantic", "pydantic.dataclasses", "rich.console", "safetensors.torch", "PIL.Image", "jinja2",
    "scipy.ndimage", "scipy.spatial", "constriction", "plyfile", "zlib_ng.zlib_ng", "tomli_w",
)  # fmt: skip
OURS = (
    *(f"splatwizard_core.{name}" for name in ("cli.run", "cli.codec", "builtin", "tooling", "runs.measure")),
    "sw_3dgs.method", "sw_codecs.models.codecs", "sw_datasets.demo.dataset", "sw_metrics.perceptual",
    "sw_rasterizers.standard", "sw_report.after_run", "sw_view.after_run",
    *(entry.value for entry in entry_points(group="splatwizard") if entry.value.startswith("sw_")),
)  # fmt: skip
"""Modules that nearly every run imports: of others, and of ours."""
SELDOM = 50_000
"""Objects after which garbage is looked for, here and in tests: after 700, as usual, it takes 5 % of the time."""
START = subprocess.run


def run_python(*arguments: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """Do what `subprocess.run` does of this interpreter with the arguments `-m MODULE ...` or `-c PROGRAM ...`.

    Forked if the session forks. What it prints is kept, as text.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    ran: subprocess.CompletedProcess[str] = splatwizard_core.runs.fresh.subprocess.run(
        [sys.executable, *arguments], **{"env": None, "cwd": None, **pipes, **options}
    )
    return ran


def start_python(*arguments: str, **options: Any) -> Any:
    """Start what `run_python` runs and return its `Popen`; options are those of `Forked`."""
    started = splatwizard_core.runs.fresh.subprocess.Popen
    return started([sys.executable, *arguments], **options)


def keep_freed_memory() -> None:
    """Let this process and what it forks keep a gigabyte of freed memory for later; of the allocator of Linux alone."""
    libc = ctypes.CDLL(None) if sys.platform == "linux" else None
    if hasattr(libc, "mallopt"):
        # M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD of malloc.h
        for option, value in ((-1, 1 << 30), (-2, 1 << 26), (-3, 1 << 25)):
            libc.mallopt(option, value)


def leave_files_to_the_system() -> None:
    """Write files without waiting for the disk: what a loss of power leaves is nothing that a test can see."""
    os.fsync = lambda file: None


class Forked:
    """Counterpart of `subprocess.Popen` for a forked child: its pid, pipes, signals and end.

    ended       the end of a pipe that tells its pid, then its status
    """

    def __init__(self, ended: int, pipes: Mapping[str, IO[Any] | None]) -> None:
        self._ended = os.fdopen(ended, "rb", buffering=0)
        self._told = b""
        while not self._told.endswith(b" "):
            self._read()
        self.pid = int(self._told)
        self._told, self._one_reads = b"", threading.Lock()
        self.stdin, self.stdout, self.stderr = (pipes.get(name) for name in ("stdin", "stdout", "stderr"))
        self.returncode: int | None = None

    def _read(self) -> bool:
        told = self._ended.read(1)
        if not told and not self._told:
            raise RuntimeError("the server that forks fresh processes has died")
        self._told += told
        return bool(told)

    def wait(self, timeout: float | None = None) -> int:
        with self._one_reads:
            while self.returncode is None:
                if not select.select([self._ended], [], [], timeout)[0]:
                    raise subprocess.TimeoutExpired("a forked child", timeout or 0)
                if not self._read():
                    self.returncode = int(self._told)
                    self._ended.close()
            return self.returncode

    def poll(self) -> int | None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.wait(0)
        return self.returncode

    def communicate(self, timeout: float | None = None) -> tuple[Any, Any]:
        """All that it prints, where at most one of both streams is long."""
        if timeout is not None:
            self.wait(timeout)
        told = tuple(None if pipe is None or pipe.closed else pipe.read() for pipe in (self.stdout, self.stderr))
        self.wait()
        return told

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        self.wait()


class ForkServer:
    """The server's process, started with the first request and ended with its socket.

    connection      to the server that forked this process; None: this one starts a server of its own
    """

    def __init__(self, connection: socket.socket | None = None, environment: Mapping[str, str] | None = None) -> None:
        self._server: subprocess.Popen[bytes] | None = None
        self._socket = connection
        self._one_begins = threading.Lock()
        self._environment = dict(os.environ if environment is None else environment)

    def run(self, command: Any, **options: Any) -> subprocess.CompletedProcess[Any]:
        """Do what `subprocess.run` does; forked where the command and its surroundings allow it."""
        work = self._work_of(command, options)
        if work is None:
            return START(command, **options)
        with contextlib.ExitStack() as open_files:
            given, out, err = (open_files.enter_context(tempfile.TemporaryFile()) for _ in range(3))
            text, said = options.get("text", False), options.get("input") or b""
            given.write(said.encode() if isinstance(said, str) else said)
            given.seek(0)
            kept = subprocess.PIPE if options.get("capture_output") else None
            ends = {"stdin": given, "stdout": out, "stderr": err} | {
                name: number
                for name, number in (("stdin", options.get("stdin")), ("stderr", options.get("stderr", kept)))
                if number not in (subprocess.PIPE, None) or (name, number) == ("stderr", None)
            }
            status = self._fork(work, options, ends).wait()
            printed = []
            for file in (out, err):
                file.seek(0)
                printed.append(file.read().decode() if text else file.read())
        done = subprocess.CompletedProcess(command, status, *printed)
        if options.get("check"):
            done.check_returncode()
        return done

    def popen(self, command: Any, **options: Any) -> Any:
        """Do what `subprocess.Popen` does; a `Forked` where the command and its surroundings allow it."""
        work = self._work_of(command, options)
        return subprocess.Popen(command, **options) if work is None else self._fork(work, options, options)

    def _work_of(self, command: Any, options: Mapping[str, Any]) -> dict[str, Any] | None:
        environment = dict(os.environ) if options.get("env") is None else dict(options["env"])
        work = _work(command)
        if work is None or not self._serves(environment):
            return None
        folder = str(options.get("cwd") or os.getcwd())
        session = bool(options.get("start_new_session"))
        return {**work, "environment": environment, "folder": folder, "session": session, "parent": os.getpid()}

    def _fork(self, work: dict[str, Any], options: Mapping[str, Any], wanted: Mapping[str, Any]) -> Forked:
        """Ask for a child whose streams are files, descriptors, or pipes to here."""
        mode, pipes, theirs = "" if options.get("text") else "b", {}, []
        with contextlib.ExitStack() as until_sent:
            for number, name in enumerate(("stdin", "stdout", "stderr")):
                file = wanted.get(name)
                if file == subprocess.PIPE:
                    ends = os.pipe()
                    pipes[name] = os.fdopen(ends[number == 0], ("w" if number == 0 else "r") + mode)
                    file = ends[number != 0]
                    until_sent.callback(os.close, file)
                elif file == subprocess.DEVNULL:
                    file = until_sent.enter_context(open(os.devnull, "r+b")).fileno()
                elif file == subprocess.STDOUT:
                    file = theirs[1]
                elif file is None:
                    file = number
                theirs.append(file if isinstance(file, int) else file.fileno())
            ended, end = os.pipe()
            until_sent.callback(os.close, end)
            self._send(json.dumps(work).encode(), [*theirs, end])
        return Forked(ended, pipes)

    def _serves(self, environment: Mapping[str, str]) -> bool:
        differing = dict(environment.items() ^ self._environment.items())
        return all(name.startswith(PLAIN) for name in differing)

    def _begin(self) -> socket.socket:
        if self._socket is None:
            self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with theirs:
                self._server = subprocess.Popen(
                    [sys.executable, __file__, str(theirs.fileno())],
                    pass_fds=[theirs.fileno()],
                    stdin=subprocess.DEVNULL,
                    env={**self._environment, **BIG_PAGES},  # not that of the test which asks first
                )
        return self._socket

    def _send(self, request: bytes, files: list[int]) -> None:
        with self._one_begins:
            connection = self._begin()
        with tempfile.TemporaryFile() as text:  # an environment may be longer than a packet
            text.write(request)
            text.flush()
            try:
                socket.send_fds(connection, [b"run"], [text.fileno(), connection.fileno(), *files])
            except OSError as error:
                raise RuntimeError("the server that forks fresh processes has died") from error

    def close(self) -> None:
        """End the server; children that still run go on."""
        if self._server is not None and self._socket is not None:
            self._socket.close()
            self._server.wait()
            self._server = self._socket = None


def _work(command: Any) -> dict[str, Any] | None:
    """What a forked child does in place of the command, None if only a new process can."""
    if not isinstance(command, (list, tuple)) or len(command) < 3:
        return None
    python, kind, what, *arguments = map(str, command)
    if python != sys.executable or (kind != "-c" and (kind != "-m" or what not in MODULES)):
        return None
    return {"program" if kind == "-c" else "module": what, "arguments": arguments}


@contextlib.contextmanager
def forking(*, at_once: bool = False) -> Iterator[None]:
    """Fork what `run_fresh` starts, where the system can; the block's end ends the server.

    at_once     start the server before anything asks for it
    """
    if sys.platform != "linux":
        yield
        return
    server, fresh = ForkServer(), splatwizard_core.runs.fresh
    before = fresh.subprocess
    if at_once:
        server._begin()
    fresh.subprocess = SimpleNamespace(**{**vars(subprocess), "run": server.run, "Popen": server.popen})  # type: ignore[assignment]
    try:
        yield
    finally:
        fresh.subprocess = before
        server.close()


def are_forked() -> bool:
    """Whether this process forks what `run_fresh` starts."""
    return splatwizard_core.runs.fresh.subprocess is not subprocess


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Start new interpreters inside the block, as users' runs do."""
    fresh = splatwizard_core.runs.fresh
    before, fresh.subprocess = fresh.subprocess, subprocess
    try:
        yield
    finally:
        fresh.subprocess = before


class Imported:
    """Holds modules of plugins that were imported before the fork, unseen until somebody imports one of them."""

    def __init__(self, names: Iterable[str]) -> None:
        for name in names:
            with contextlib.suppress(ImportError):  # whoever needs it is told
                importlib.import_module(name)
        if "sw_report.page" in sys.modules:
            sys.modules["sw_report.page"].page_template()  # compiling it is a quarter of a short run
        if "sw_datasets.demo.synthetic" in sys.modules:
            demo = sys.modules["sw_datasets.demo.synthetic"]
            demo.make_scene(demo.SIZES["tiny"])  # most runs are of it
        with contextlib.suppress(Exception):  # a child looks itself; read metadata and parsed requirements are kept
            PluginManager(loading.installed_entry_points("splatwizard"))
        loading._installed_version.cache_clear()
        found = [name for name in sys.modules if name.startswith("sw_")]
        self._modules = {name: sys.modules.pop(name) for name in found}

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        if name not in self._modules:
            return None
        sys.modules.update(self._modules)
        sys.meta_path.remove(self)
        self._own = self._modules[name].__spec__
        spec = copy.copy(self._own)
        spec.loader = self  # type: ignore[union-attr]
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self._modules[spec.name]

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self._own


def _serve(connection: socket.socket) -> tuple[dict[str, Any], int]:
    """Fork for each request; return in the child its content, which it does, and the descriptor to ask for more.

    The server itself never returns.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # whoever asked is interrupted, and its child
    ends_of: dict[int, tuple[int, int]] = {}  # descriptor of a child -> its pid, and where its status is told
    while True:
        ready = select.select([connection, *ends_of], [], [])[0]
        for child in set(ready) & set(ends_of):
            pid, end = ends_of.pop(child)
            with contextlib.suppress(BrokenPipeError):  # nobody wants to know any more
                os.write(end, str(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])).encode())
            os.close(child)
            os.close(end)
        if connection not in ready:
            continue
        _, files, _, _ = socket.recv_fds(connection, 16, 6)
        if not files:
            os._exit(0)  # the session has ended
        text, asking, *ends = files
        pid = os.fork()
        if pid == 0:
            break
        with contextlib.suppress(BrokenPipeError):
            os.write(ends[3], f"{pid} ".encode())
        ends_of[os.pidfd_open(pid)] = pid, ends[3]
        for file in files[:-1]:
            os.close(file)
    for child, (_, end) in ends_of.items():
        os.close(child)
        os.close(end)
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
    for number, name in enumerate(("stdin", "stdout", "stderr")):  # the server's know whether its own can seek
        stream = getattr(sys, name)
        kind = {"encoding": stream.encoding, "errors": stream.errors, "closefd": False}
        setattr(sys, name, open(number, "w" if number else "r", buffering=1 if number == 2 else -1, **kind))  # noqa: SIM115
    again = ForkServer(socket.socket(fileno=asking), os.environ)
    if "module" in content:  # of a program, which may be pytest, only what `run_fresh` starts is forked
        subprocess.run = again.run  # type: ignore[assignment]
    else:
        splatwizard_core.runs.fresh.subprocess = SimpleNamespace(**{**vars(subprocess), "run": again.run})  # type: ignore[assignment]
    os.getppid = lambda: content["parent"]
    if content["session"]:
        os.setsid()
    os.environ.clear()
    os.environ.update(content["environment"])
    sys.dont_write_bytecode = bool(os.environ.get("PYTHONDONTWRITEBYTECODE"))
    if (threads := os.environ.get("OMP_NUM_THREADS", "")).isdecimal():
        torch.set_num_threads(int(threads))
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
    import weakref

    keep_freed_memory()
    leave_files_to_the_system()
    for name in THEIRS:
        importlib.import_module(name)
    sys.meta_path.insert(0, Imported(OURS))
    gc.freeze()  # else the children's first collections copy all its memory
    gc.set_threshold(SELDOM)
    for finalizer in list(weakref.finalize._registry):  # type: ignore[attr-defined]
        finalizer.atexit = False  # torch would take its operators apart in each child
    given = [os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    ours = [path for path in sys.path[1:] if path not in given]  # the first is this file's folder
    _become(*_serve(socket.socket(fileno=int(sys.argv[1]))), ours)
