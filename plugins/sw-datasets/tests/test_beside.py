"""Pictures are drawn in copies of the process, to the same bits."""

import os
import signal
import subprocess
import sys
import threading
from functools import partial

import numpy as np
import pytest
from sw_datasets.demo import beside
from sw_datasets.demo.raycast import draw
from sw_datasets.demo.synthetic import build_world, orbit

KILLED = """
import multiprocessing, os, signal, threading, time
import numpy as np
from sw_datasets.demo import beside

def draw():
    while os.getppid() == parent:
        time.sleep(0.01)
    return np.zeros(1 << 20, np.uint8)

parent, beside.available_cores = os.getpid(), lambda: 2
for _ in "two":
    threading.Thread(target=beside.drawn_beside, args=(draw, beside.FEWEST_RAYS)).start()
while len(multiprocessing.active_children()) < 3:
    time.sleep(0.01)
os.kill(parent, signal.SIGKILL)
"""


def here() -> np.ndarray:
    return np.array([os.getpid()], np.int64)


@pytest.fixture
def cores(monkeypatch):
    monkeypatch.setattr(beside, "available_cores", lambda: 2)
    monkeypatch.setattr(beside.sys, "platform", "linux")


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a process cannot be copied here")
class TestCopies:
    def test_they_draw_the_same(self, cores):
        world, camera = build_world(), orbit(3, 40, 30)[1]
        drawing = partial(draw, world, camera, samples=1, background=0.0)
        assert np.array_equal(beside.drawn_beside(drawing, beside.FEWEST_RAYS), drawing())

    def test_many_rays_are_followed_beside_and_few_here(self, cores):
        assert beside.drawn_beside(here, beside.FEWEST_RAYS) != os.getpid()
        assert beside.drawn_beside(here, beside.FEWEST_RAYS - 1) == os.getpid()

    def test_what_a_copy_does_not_finish_is_drawn_here(self, cores):
        parent = os.getpid()

        def killed() -> np.ndarray:
            if os.getpid() != parent:
                os.kill(os.getpid(), signal.SIGKILL)
            return here()

        assert beside.drawn_beside(killed, beside.FEWEST_RAYS) == parent

    def test_what_fails_beside_fails_here_and_is_told_once(self, cores, capfd):
        def fails() -> np.ndarray:
            raise MemoryError(os.getpid())

        with pytest.raises(MemoryError, match=str(os.getpid())):
            beside.drawn_beside(fails, beside.FEWEST_RAYS)
        assert capfd.readouterr() == ("", "")

    def test_where_no_copy_can_be_made_it_is_drawn_here(self, cores, monkeypatch):
        def full() -> int:
            raise BlockingIOError

        monkeypatch.setattr(os, "fork", full)
        assert beside.drawn_beside(here, beside.FEWEST_RAYS) == os.getpid()

    def test_a_copy_goes_on_where_the_process_is_asked_to_end(self, cores, capfd):
        before = signal.signal(signal.SIGTERM, signal.default_int_handler)  # as `sw` has it

        def asked() -> np.ndarray:
            os.kill(os.getpid(), signal.SIGTERM)
            return here()

        try:
            assert beside.drawn_beside(asked, beside.FEWEST_RAYS) != os.getpid()
        finally:
            signal.signal(signal.SIGTERM, before)
        assert capfd.readouterr() == ("", "")

    @pytest.mark.skipif(sys.platform != "linux", reason="drawn in one process there")
    def test_copies_end_with_a_process_that_was_killed(self):
        """They hold its output: it ends when the last of them does."""
        ended = subprocess.run([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, timeout=60)
        assert ended.returncode == -signal.SIGKILL

    def test_threads_draw_at_once(self, cores):
        found = []
        threads = [
            threading.Thread(target=lambda: found.append(int(beside.drawn_beside(here, 10**6)[0]))) for _ in "four"
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len({*found, os.getpid()}) == 5
