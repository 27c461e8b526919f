"""Waiting of OpenMP's threads beside neighbours: what is seen, what is decided, and that it takes effect."""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from splatwizard_native import core_time, waiting
from splatwizard_native.core_time import CoreTime, Lap
from splatwizard_native.waiting import Judge, Watch

ALONE, CROWDED = Lap(0.25, 0.5, 0.005), Lap(0.25, 0.3, 0.2)
LIBRARY = next(iter(Path(pytest.importorskip("torch").__file__).parent.glob("lib/libgomp*")), None)
gnu_openmp = pytest.mark.skipif(
    LIBRARY is None or not hasattr(os, "sched_getaffinity") or len(os.sched_getaffinity(0)) < 2,
    reason="needs GNU OpenMP and two cores",
)


def tell(tasks: Path, times: dict[str, tuple[int, int]]) -> None:
    for thread, (ran, waited) in times.items():
        (tasks / thread).mkdir(parents=True, exist_ok=True)
        (tasks / thread / "schedstat").write_text(f"{ran} {waited} 7\n")


def test_a_lap_counts_all_threads_since_the_last_one(tmp_path, monkeypatch):
    monkeypatch.setattr(core_time, "TASKS", str(tmp_path))
    tell(tmp_path, {"1": (10**9, 0), "2": (5, 10**9)})
    clock = CoreTime()
    tell(tmp_path, {"1": (3 * 10**9, 10**9), "2": (5, 10**9), "3": (10**9, 0)})  # 3 began meanwhile
    lap = clock.lap()
    assert (lap.ran, lap.waited) == (3.0, 1.0)
    assert lap.share == 0.75
    assert clock.lap()[1:] == (0.0, 0.0)


def test_a_shortage_is_told_as_the_share_that_was_had(tmp_path, monkeypatch):
    monkeypatch.setattr(core_time, "TASKS", str(tmp_path))
    tell(tmp_path, {"1": (0, 0)})
    clock = CoreTime()
    tell(tmp_path, {"1": (10**12, 10**12)})
    assert clock.shortage() == 0.5
    tell(tmp_path, {"1": (2 * 10**12, 10**12)})  # had all that it wanted
    assert clock.shortage() is None


def test_where_the_system_tells_nothing_nothing_is_claimed(tmp_path, monkeypatch):
    monkeypatch.setattr(core_time, "TASKS", str(tmp_path / "none"))
    clock = CoreTime()
    assert clock.lap()[1:] == (0.0, 0.0)
    assert clock.shortage() is None


def test_they_sleep_at_the_first_crowded_look_and_spin_after_several_quiet_ones():
    judge = Judge()
    assert not judge.look(ALONE)
    assert judge.look(CROWDED)
    looks = [judge.look(ALONE) for _ in range(Judge.SHORTEST)]
    assert looks == [True] * (Judge.SHORTEST - 1) + [False]


def test_a_crowded_look_between_quiet_ones_begins_the_count_anew():
    judge = Judge()
    judge.look(CROWDED)
    for _ in range(3):
        assert all(judge.look(lap) for lap in [ALONE] * (Judge.SHORTEST - 1) + [CROWDED])


def quiet_looks_until_they_spin(judge: Judge) -> int:
    assert judge.look(CROWDED)
    return next(count for count in range(1, 10_000) if not judge.look(ALONE))


def test_a_neighbour_who_is_back_at_once_makes_them_wait_longer_up_to_a_limit():
    judge = Judge()
    looks = [quiet_looks_until_they_spin(judge) for _ in range(8)]
    assert looks == [4, 8, 16, 32, 64, 128, 128, 128]
    for _ in range(Judge.SOON):
        judge.look(ALONE)
    assert quiet_looks_until_they_spin(judge) == Judge.SHORTEST


# Threads of a process with a team as large as there are cores: before, while, and after the sleepers are there. Both
# changes are awaited; they may be a moment late.
COUNT = """
import ctypes, os, time
from splatwizard_native.waiting import Sleepers
openmp = ctypes.CDLL({library!r})
nothing = ctypes.cast(ctypes.CDLL(None).getpid, ctypes.c_void_p)
cores = openmp.omp_get_num_procs()
openmp.GOMP_parallel(nothing, None, cores, 0)

def threads():
    return len(os.listdir("/proc/self/task"))

def until(number):
    while threads() != number:
        time.sleep(0.01)
    return threads()

sleepers, before = Sleepers(), threads()
sleepers.come(cores)
there = until(before + 2)
time.sleep(0.1)
assert threads() == there
sleepers.go()
print(cores, before, there, until(before))
"""


def in_a_process(script: str) -> list[float]:
    """Numbers that a script prints in a process where OpenMP is left as it is."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("OMP_", "GOMP_"))}
    done = subprocess.run(
        [sys.executable, "-c", script.format(library=str(LIBRARY))],
        capture_output=True, text=True, env=environment, check=True, timeout=300,
    )  # fmt: skip
    return list(map(float, done.stdout.split()))


@gnu_openmp
def test_sleepers_make_one_openmp_thread_more_than_there_are_cores_while_they_are_there():
    cores, before, there, after = in_a_process(COUNT)
    assert before == cores
    assert there == cores + 2  # and the thread that holds it
    assert after == before


# CPU time that the threads of 20 parallel regions spin between them: before, while, and after the sleepers are there.
SPIN = """
import ctypes, time
from splatwizard_native.waiting import Sleepers
openmp = ctypes.CDLL({library!r})
nothing = ctypes.cast(ctypes.CDLL(None).getpid, ctypes.c_void_p)
threads = openmp.omp_get_num_procs()

def spun():
    began = time.process_time()
    for _ in range(20):
        openmp.GOMP_parallel(nothing, None, threads, 0)
        time.sleep(0.03)
    return time.process_time() - began

sleepers = Sleepers()
spun()
before = spun()
sleepers.come(threads)
time.sleep(0.2)
while_there = spun()
sleepers.go()
print(before, while_there, spun())
"""


@pytest.mark.slow
@gnu_openmp
def test_more_threads_than_cores_end_the_spinning_and_their_end_brings_it_back():
    before, there, after = in_a_process(SPIN)
    assert there < before / 4
    assert there < after / 4


@gnu_openmp
def test_the_copy_of_openmp_that_is_loaded_is_found():
    ctypes.CDLL(str(LIBRARY))
    assert str(LIBRARY.resolve()) in [str(Path(path).resolve()) for path in waiting.openmp_libraries()]


@pytest.mark.parametrize(
    ("name", "value"), [("SPLATWIZARD_SHARE_CORES", "0"), ("OMP_WAIT_POLICY", "active"), ("GOMP_SPINCOUNT", "1000")]
)
def test_the_environment_can_forbid_it(monkeypatch, name, value):
    for each in (*waiting.SETTINGS, "SPLATWIZARD_SHARE_CORES"):
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setattr(waiting, "_watch", None)
    monkeypatch.setattr(waiting, "openmp_libraries", lambda: ["libgomp.so.1"])
    with monkeypatch.context() as forbidding:
        forbidding.setenv(name, value)
        waiting.watch_cores()
        assert waiting._watch is None
    if Path("/proc/self/schedstat").exists():
        waiting.watch_cores()
        assert isinstance(waiting._watch, Watch)
        waiting._watch.end()


def test_a_watch_that_ends_lets_them_spin_and_another_can_begin(monkeypatch):
    came, told = threading.Event(), []

    class Sleepers:
        def come(self, working: int) -> None:
            told.append(working)
            came.set()

        def go(self) -> None:
            told.append(None)

    monkeypatch.setattr(waiting, "Sleepers", Sleepers)
    monkeypatch.setattr(waiting, "INTERVAL", 0.001)
    monkeypatch.setattr(CoreTime, "lap", lambda self: CROWDED)
    monkeypatch.setattr("torch.get_num_threads", lambda: 2)
    for _ in range(2):
        came.clear()
        watch = Watch()
        assert came.wait(60)
        assert told[-1] == 2
        watch.end()
        assert told[-1] is None
        assert not watch._thread.is_alive()  # the process may have a watch of its own


def test_where_no_thread_can_begin_there_is_no_watch(monkeypatch):
    def refuse(self: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    for each in (*waiting.SETTINGS, "SPLATWIZARD_SHARE_CORES"):
        monkeypatch.delenv(each, raising=False)
    monkeypatch.setattr(waiting, "_watch", None)
    monkeypatch.setattr(waiting, "openmp_libraries", lambda: ["libgomp.so.1"])
    monkeypatch.setattr(threading.Thread, "start", refuse)
    waiting.watch_cores()
    assert waiting._watch is None
