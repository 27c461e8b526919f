"""Runs tests in several processes, forked when all is imported and collected.

The processes of pytest-xdist import and collect everything each, ten seconds of every core, and each report goes
through another interpreter. Here each worker takes whole files, one after the other in the order of collection, and the
process that collected reports what it finds. The workers share the server of `forked_children`.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import queue
import signal
import sys
import threading
import traceback
from pathlib import Path
from typing import Any, BinaryIO

import forked_children
import pytest
import torch

DIGITS = 6
"""Of the number of a file, as workers take it from the pipe of those that nobody has taken."""


def run_forked(session: pytest.Session, jobs: int, threads: int) -> bool:
    """Run what was collected in so many workers. Raises RuntimeError if one dies, `Failed` after `--maxfail`.

    threads     of torch in each worker; this process must have used one alone, or the workers would wait for its others

    Returns False where nothing ran, since tests that need a GPU must run in this process: a forked one cannot use it.
    """
    if needs_gpu(session.items):
        torch.set_num_threads(threads)
        os.environ.pop("TEST_JOBS", None)
        print("\nthe tests run in one process: forked ones cannot use the GPU")
        return False
    files = [list(items) for _, items in itertools.groupby(session.items, key=lambda item: item.path)]
    base = session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]
    waiting, numbers = os.pipe()
    os.write(numbers, b"".join(b"%*d" % (DIGITS, number) for number in range(len(files))))  # a pipe holds 10,000
    os.close(numbers)
    told: queue.Queue[tuple[int, str, Any]] = queue.Queue()
    ends, workers = [], []
    with contextlib.nullcontext() if forked_children.are_forked() else forked_children.forking(at_once=True):
        for worker in range(jobs):
            end, telling = os.pipe()
            sys.stdout.flush()
            if (pid := os.fork()) == 0:
                torch.set_num_threads(threads)
                _work(session, files, base / f"worker-{worker}", waiting, os.fdopen(telling, "wb"))
            os.close(telling)
            workers.append(pid)
            ends.append(os.fdopen(end, "rb"))
        os.close(waiting)
        for worker, file in enumerate(ends):  # after all forks: a forked process has no threads
            threading.Thread(target=_listen, args=(file, worker, told), daemon=True).start()
        try:
            _report(session, jobs, told)
        except BaseException:
            for pid in workers:
                os.kill(pid, signal.SIGTERM)
            raise
        finally:
            for pid in workers:
                os.waitpid(pid, 0)
    return True


def needs_gpu(items: list[pytest.Item]) -> bool:
    """Whether CUDA is set up here already, or a test among these uses a GPU that is there: both end with a fork."""
    if torch.cuda.is_initialized():
        return True
    return any(item.get_closest_marker("cuda") for item in items) and torch.cuda.is_available()


def _listen(file: BinaryIO, worker: int, told: queue.Queue[tuple[int, str, Any]]) -> None:
    with contextlib.suppress(EOFError):
        while True:
            told.put((worker, *pickle.load(file)))
    told.put((worker, "end", None))


def _report(session: pytest.Session, jobs: int, told: queue.Queue[tuple[int, str, Any]]) -> None:
    """Tell pytest what the workers tell, until all of them have ended."""
    hook, config = session.config.hook, session.config
    tests, done = ["its first test"] * jobs, set()
    for worker, kind, content in iter(told.get, None):
        if kind == "test":
            tests[worker] = content
        elif kind == "report":
            hook.pytest_runtest_logreport(report=hook.pytest_report_from_serializable(config=config, data=content))
        elif kind == "warning":
            hook.pytest_warning_recorded.call_historic(kwargs=content)
        elif kind == "done":
            done.add(worker)
        elif kind == "error" or worker not in done:
            raise RuntimeError(f"a process that runs tests has ended in {tests[worker]}: {content or 'killed'}")
        elif not (jobs := jobs - 1):
            return
        if session.shouldfail:
            raise session.Failed(session.shouldfail)


class _Teller:
    """The plugin of a worker that sends what happens to its tests."""

    def __init__(self, config: pytest.Config, file: BinaryIO) -> None:
        self._config, self._file = config, file

    def tell(self, kind: str, content: Any = None) -> None:
        self._file.write(pickle.dumps((kind, content)))
        self._file.flush()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        self.tell("test", nodeid)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.tell("report", self._config.hook.pytest_report_to_serializable(config=self._config, report=report))

    def pytest_warning_recorded(self, warning_message: Any, when: str, nodeid: str, location: Any) -> None:
        told = {"warning_message": warning_message, "when": when, "nodeid": nodeid, "location": location}
        with contextlib.suppress(Exception):  # one that holds what cannot be pickled is not told
            self.tell("warning", told)


def _work(session: pytest.Session, files: list[list[pytest.Item]], base: Path, waiting: int, file: BinaryIO) -> None:
    """Be a worker with a folder `base` for temporary files: run files as long as there are some, and end the process.

    waiting     end of the pipe with the numbers of the files that nobody has taken
    """
    config, plugins = session.config, session.config.pluginmanager
    teller = _Teller(config, file)
    try:
        os.environ["TEST_WORKER"] = base.name  # fixtures share by it what is made once for all workers
        del os.environ["TEST_JOBS"]  # tests of pytest itself run in one process
        plugins.unregister(name="terminalreporter")
        plugins.register(teller)
        capture = plugins.getplugin("capturemanager")  # its files are those of the process that was forked
        capture.stop_global_capturing()
        capture.start_global_capturing()
        base.mkdir()
        config._tmp_path_factory._basetemp = base  # type: ignore[attr-defined]
        while number := os.read(waiting, DIGITS):
            items = files[int(number)]
            for item, following in itertools.zip_longest(items, items[1:], fillvalue=session):
                config.hook.pytest_runtest_protocol(item=item, nextitem=following)  # the session: all but its own ends
        session._setupstate.teardown_exact(None)
        counting = getattr(plugins.getplugin("_cov"), "cov_controller", None)
        if counting is not None:
            counting.cov.stop()
            counting.cov.save()
        teller.tell("done")
    except BaseException:
        with contextlib.suppress(OSError):
            teller.tell("error", traceback.format_exc())
    finally:
        os._exit(0)
