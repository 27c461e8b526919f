"""Pictures are drawn in copies of the process, to the same bits."""

import os
import signal
import threading
from functools import partial

import numpy as np
import pytest
from sw_datasets.demo import beside
from sw_datasets.demo.raycast import draw
from sw_datasets.demo.synthetic import build_world, orbit


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
