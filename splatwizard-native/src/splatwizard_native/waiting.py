"""Let OpenMP's threads sleep while they wait, as long as other processes want the same cores.

At the end of a parallel loop the threads of GNU OpenMP spin until the next one. On cores of one's own that is fastest;
on shared ones it takes from the neighbours, and from its own threads, the time in which the work could be done. The
environment can say how to wait (OMP_WAIT_POLICY, GOMP_SPINCOUNT), once and before the start, and no value suits both.
But the library spins 300 times less as long as a process has more OpenMP threads than there are cores: so a few more,
asleep, switch its waiting over while the program runs, and their end switches it back. No result depends on them: who
computes what stays the same. Measured by benchmarks/shared_cores.py.

A thread watches whether the threads of this process get their cores, from the first native module on, on Linux. Off
with SPLATWIZARD_SHARE_CORES=0, and where the environment says how to wait.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import threading

from splatwizard_native.core_time import CoreTime, Lap

INTERVAL = 0.25  # s between two looks
SETTINGS = ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT")


class Sleepers:
    """OpenMP threads beyond the number of cores, while they are there."""

    def __init__(self) -> None:
        self._leave = threading.Event()
        self._owner: threading.Thread | None = None

    def come(self, working: int) -> None:
        """Shorten the waiting of all OpenMP threads of this process.

        working     how many it has besides these
        """
        if self._owner is None:
            self._leave.clear()
            self._owner = threading.Thread(target=self._hold, args=(working,), name="openmp-sleepers", daemon=True)
            self._owner.start()

    def go(self) -> None:
        """Let them spin as ever; a team ends with the thread that began it."""
        if self._owner is not None:
            self._leave.set()
            self._owner.join()
            self._owner = None

    def _hold(self, working: int) -> None:
        # A parallel region in which each thread calls getpid: no Python, no lock, no effect.
        nothing = ctypes.cast(ctypes.CDLL(None).getpid, ctypes.c_void_p)
        for library in map(ctypes.CDLL, openmp_libraries()):
            missing = library.omp_get_num_procs() + 1 - working
            library.GOMP_parallel(nothing, None, max(missing, 1) + 1, 0)  # with this thread, which does not count
        self._leave.wait()


class Judge:
    """Decides look by look whether threads should sleep while they wait.

    A neighbour that takes little shows only while they spin: if it is back soon after they began to, they wait longer
    before they try that again.
    """

    CROWDED, QUIET = 0.3, 0.1  # threads that wait for a core, on average
    SHORTEST, LONGEST = 4, 128  # quiet looks before they spin again
    SOON = 40  # looks

    def __init__(self) -> None:
        self.sleep = False
        self._patience, self._quiet, self._since = self.SHORTEST, 0, self.SOON

    def look(self, lap: Lap) -> bool:
        """Return whether they should sleep from now on."""
        if self.sleep:
            self._quiet = self._quiet + 1 if lap.waiting < self.QUIET else 0
            if self._quiet >= self._patience:
                self.sleep, self._since = False, 0
        else:
            self._since += 1
            if lap.waiting > self.CROWDED:
                soon = self._since < self.SOON
                self._patience = min(2 * self._patience, self.LONGEST) if soon else self.SHORTEST
                self.sleep, self._quiet = True, 0
        return self.sleep


def openmp_libraries() -> list[str]:
    """List the copies of GNU OpenMP that this process has loaded; usually one, torch's."""
    with open("/proc/self/maps") as maps:
        paths = (line.split(maxsplit=5)[-1].strip() for line in maps if "/libgomp" in line)
        return sorted(set(paths))


class Watch:
    """A thread that looks again and again whether this process gets its cores, and has OpenMP wait accordingly."""

    def __init__(self) -> None:
        self._leave = threading.Event()
        self._thread = threading.Thread(target=self._run, name="core-watch", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Let OpenMP's threads spin as ever, and end."""
        self._leave.set()
        self._thread.join()

    def _run(self) -> None:
        import torch

        clock, judge, sleepers = CoreTime(), Judge(), Sleepers()
        while not self._leave.wait(INTERVAL):
            if not judge.look(clock.lap()):
                sleepers.go()
            elif (threads := torch.get_num_threads()) > 1:  # one alone waits for nobody
                sleepers.come(threads)
        sleepers.go()


def watch_cores() -> None:
    """Begin to watch, once in a process, if there is something to watch and nobody has forbidden it."""
    global _watch
    forbidden = os.environ.get("SPLATWIZARD_SHARE_CORES", "1").strip().lower() in ("0", "off", "no", "false")
    if _watch is not None or forbidden or any(os.environ.get(name) for name in SETTINGS):
        return
    if os.path.exists("/proc/self/schedstat") and openmp_libraries():
        with contextlib.suppress(RuntimeError):  # no more threads are allowed here: the work goes on without a watch
            _watch = Watch()


_watch: Watch | None = None
