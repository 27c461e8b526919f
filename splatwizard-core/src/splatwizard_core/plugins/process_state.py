"""State of the process that a stranger's code may not leave changed: read before, put back after, and told."""

from __future__ import annotations

import contextlib
import logging
import os
import random
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

from splatwizard_core.base.interrupt import ASKED_TO_END

Told = Callable[[str], None]  # takes what was changed, such as "the working folder"
_modes: list[Any] = []  # a mode of torch ends with its object


@contextlib.contextmanager
def kept_state(tell: Told, *, tells_seeds: bool) -> Iterator[None]:
    """Put back what the block changes, and tell of each thing; of random numbers, which it may draw, only if asked.

    One torch that the block itself imports is held against a fresh one.
    """
    had_torch, before = _is_there("torch"), _state()
    variables, filters = dict(os.environ), list(warnings.filters)
    try:
        with _kept_seeds() if had_torch else contextlib.nullcontext():
            yield
    finally:
        if _is_there("torch") and sys.modules["torch"].is_inference_mode_enabled():
            _modes.append(sys.modules["torch"].inference_mode(mode=False))  # nothing of ours computes in that mode
            _modes[-1].__enter__()
            tell("the inference mode of torch")
        for name, (now, write, fresh) in _state().items():
            kept = before[name][0] if name in before else now if had_torch or fresh is None else fresh
            if now != kept:
                with contextlib.suppress(Exception):  # the folder is gone, say
                    write(kept)
                    if tells_seeds or not name.startswith("the random"):
                        tell(name)
        changed = [name for name, value in variables.items() if os.environ.get(name) != value]
        os.environ.update({name: variables[name] for name in changed})
        if "CUDA_VISIBLE_DEVICES" not in variables and os.environ.pop("CUDA_VISIBLE_DEVICES", None) is not None:
            changed.append("CUDA_VISIBLE_DEVICES")  # what else a library sets for itself stays
        if changed:
            tell(f"the environment ({', '.join(sorted(changed)):.200})")
        added = [each for each in warnings.filters if each not in filters]
        if broad := [each for each in added if each[0] in ("ignore", "error") and each[1:] == (None, Warning, None, 0)]:
            warnings.filters[:] = [each for each in warnings.filters if each not in broad]  # type: ignore[index]
            getattr(warnings, "_filters_mutated", lambda: None)()
            tell("the filters of all warnings")


def _is_there(name: str) -> bool:
    """Whether a module is imported to its end."""
    return name in sys.modules and not getattr(sys.modules[name].__spec__, "_initializing", False)


def _state() -> dict[str, tuple[Any, Callable[[Any], Any], Any]]:
    """Return (value, how it is written, value in a fresh process or None) by the words that name it."""
    found: dict[str, tuple[Any, Callable[[Any], Any], Any]] = {
        "how much is logged": (logging.root.manager.disable, logging.disable, None),
        "who writes what is logged": ([*logging.root.handlers], partial(setattr, logging.root, "handlers"), None),
        "the random numbers of Python": (random.getstate(), random.setstate, None),
        "the limit of recursion": (sys.getrecursionlimit(), sys.setrecursionlimit, None),
    }
    with contextlib.suppress(OSError):
        found["the working folder"] = (os.getcwd(), os.chdir, None)
    if not _is_there("torch"):
        return found
    torch: Any = sys.modules["torch"]
    cudnn = torch.backends.cudnn
    switches = {"enabled": True, "benchmark": False, "deterministic": False}
    return found | {
        "gradients (torch.set_grad_enabled)": (torch.is_grad_enabled(), torch.set_grad_enabled, True),
        "the default dtype of torch": (torch.get_default_dtype(), torch.set_default_dtype, torch.float32),
        "the default device of torch": (torch.get_default_device(), _set_device, torch.device("cpu")),
        "deterministic algorithms": (torch.get_deterministic_debug_mode(), torch.set_deterministic_debug_mode, 0),
        "the number of threads of torch": (torch.get_num_threads(), torch.set_num_threads, None),
        **{f"cudnn.{k}": (getattr(cudnn, k), partial(setattr, cudnn, k), fresh) for k, fresh in switches.items()},
    }


def _kept_seeds() -> contextlib.AbstractContextManager[None]:
    from splatwizard_core.base.random_states import preserved_random_states  # which imports torch

    return preserved_random_states()


def _set_device(device: Any) -> None:
    sys.modules["torch"].set_default_device(None if device.type == "cpu" else device)


@contextlib.contextmanager
def kept_endings(tell: Told) -> Iterator[list[int]]:
    """Yield the requests to end that came from outside (Ctrl-C) so far; put back who answers them."""
    came: list[int] = []

    def noting(answer: Callable[..., Any]) -> Callable[..., Any]:
        return lambda number, frame: came.append(number) or answer(number, frame)  # type: ignore[func-returns-value]

    is_main = threading.current_thread() is threading.main_thread()
    answered = {n: answer for n in ASKED_TO_END if is_main and (answer := signal.getsignal(n)) is not None}
    placed = {number: noting(answer) if callable(answer) else answer for number, answer in answered.items()}
    for number, answer in placed.items():
        signal.signal(number, answer)
    try:
        yield came
    finally:
        changed = [signal.Signals(number).name for number in placed if signal.getsignal(number) != placed[number]]
        for number, answer in answered.items():
            signal.signal(number, answer)
        if changed:
            tell(f"who answers {', '.join(changed)}")
