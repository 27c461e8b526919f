"""Decodes the pictures of many views at once, and keeps them in memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import torch

from splatwizard_core.base.progress import track
from splatwizard_core.scene.scene import View
from splatwizard_native import available_cores


def decode_all(views: Iterable[View]) -> None:
    """Decode the pictures of all views now, on several threads; afterwards `view.pixels` costs nothing."""
    _each("read pictures", views, lambda view: vars(view).update(pixels=view.decoded()))


def check_pictures(views: Iterable[View]) -> None:
    """Decode the pictures and masks of these views and keep none. Raises SceneError for one that cannot be decoded.

    A picture that is only needed after hours of training should not be found to be damaged then.
    """
    _each("check pictures", views, _decode_once)


def decoded_ahead(views: Iterable[View]) -> Iterator[View]:
    """Yield each view with its picture decoded, a few of them ahead on other threads; none is kept longer.

    A view whose picture is decoded already is yielded itself, for any other a copy of it.
    """
    threads = _threads()
    pending: deque[Future[View]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for view in views:
            pending.append(pool.submit(_decoded, view))
            if len(pending) > threads:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()


def keep_pictures(views: Iterable[View], device: torch.device | str) -> bool:
    """Keep these pictures, 8 bit, in a GPU's memory too if they take at most a quarter of what is free; else in none.

    Returns whether they are there. `View.image` then sends nothing; "cpu" as the device frees the memory.
    """
    device = torch.device(device)
    pictured = [view for view in views if view.load is not None]
    fits = device.type == "cuda" and bool(pictured)
    if fits:
        wanted = sum(view.pixels.numel() for view in pictured if view.kept_on.type != "cuda")
        fits = wanted <= torch.cuda.mem_get_info(device)[0] // 4
    for view in pictured:
        view.keep_on(device if fits else "cpu")
    return fits


def _decoded(view: View) -> View:
    if "pixels" not in vars(view):
        view = replace(view)
        vars(view).update(pixels=view.decoded())
    return view


def _threads() -> int:
    return min(8, available_cores())


def _decode_once(view: View) -> None:
    for load in (view.load, view.load_mask):
        if load is not None:
            load()


def _each(label: str, views: Iterable[View], work: Callable[[View], object]) -> None:
    """Do `work` for every view whose picture is not decoded yet: one thread for each core, at most 8."""
    pending = [view for view in views if view.load is not None and "pixels" not in vars(view)]
    if not pending:
        return
    with track(label, total=len(pending), unit="pictures") as bar, ThreadPoolExecutor(_threads()) as pool:
        for _ in pool.map(work, pending):
            bar.advance()
