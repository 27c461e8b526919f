"""The threads that native modules share: how loops are cut, several callers, forked processes."""

import ctypes
import os
import threading

import pytest
import torch
from native_package import needs_compiler

from splatwizard_native.face_operations import POOL, pool_runner

pytestmark = needs_compiler

BODY = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)


def ranges(threads: int, count: int, grain: int) -> list[tuple[int, int]]:
    """The ranges of a loop, in order."""
    assert pool_runner() is not None
    found: list[tuple[int, int]] = []
    body = BODY(lambda _, begin, end: found.append((begin, end)))
    POOL.library.splatwizard_pool_run(threads, ctypes.c_int64(count), ctypes.c_int64(grain), body, None)
    return sorted(found)


@pytest.mark.parametrize(
    ("threads", "count", "grain", "expected"),
    [
        (4, 100, 10, [(0, 25), (25, 50), (50, 75), (75, 100)]),
        (4, 100, 40, [(0, 34), (34, 68), (68, 100)]),
        (4, 100, 100, [(0, 100)]),
        (1, 100, 1, [(0, 100)]),
        (3, 2, 1, [(0, 1), (1, 2)]),
        (3, 0, 1, []),
    ],
)
def test_ranges_are_cut_as_torch_cuts_its_own(threads, count, grain, expected):
    assert ranges(threads, count, grain) == expected


def test_a_loop_in_a_loop_runs_in_its_thread():
    inner: list[tuple[int, int]] = []
    innermost = BODY(lambda _, begin, end: inner.append((begin, end)))

    def body(_, begin, end):
        POOL.library.splatwizard_pool_run(4, ctypes.c_int64(10), ctypes.c_int64(1), innermost, None)

    POOL.library.splatwizard_pool_run(2, ctypes.c_int64(2), ctypes.c_int64(1), BODY(body), None)
    assert inner == [(0, 10), (0, 10)]


def test_callers_on_several_threads_do_not_wait_for_each_other_for_ever():
    found: list[list[tuple[int, int]]] = []
    callers = [threading.Thread(target=lambda: found.append(ranges(3, 300, 1))) for _ in range(8)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join(60)
    assert found == [[(0, 100), (100, 200), (200, 300)]] * 8


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_has_threads_of_its_own():
    torch.set_num_threads(max(torch.get_num_threads(), 1))
    assert ranges(2, 2, 1) == [(0, 1), (1, 2)]  # threads are there, and do not come along
    for _ in range(2):  # also after a fork of a fork
        child = os.fork()
        if child == 0:
            together = threading.Barrier(2, timeout=60)  # both ranges at once, or never
            body = BODY(lambda *_, together=together: together.wait())
            POOL.library.splatwizard_pool_run(2, ctypes.c_int64(2), ctypes.c_int64(1), body, None)
            os._exit(1 if together.broken else 0)
        _, status = os.waitpid(child, 0)
        assert os.waitstatus_to_exitcode(status) == 0
