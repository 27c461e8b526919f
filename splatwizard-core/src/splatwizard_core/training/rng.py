"""Random states of a run: the named streams of a stage, and the process-wide generators that libraries draw from."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from splatwizard_core.streams import stream


class Streams:
    """Independent generators by name, each made on first use; their states are part of a checkpoint.

    prefix  keeps the streams of a later stage apart from those of the first, which has ""
    """

    def __init__(self, seed: int, prefix: str = "") -> None:
        self.seed, self.prefix = seed, prefix
        self._made: dict[str, torch.Generator] = {}

    def __call__(self, name: str) -> torch.Generator:
        """Return the generator of this stream; the same object each time."""
        if name not in self._made:
            self._made[name] = stream(self.seed, self.prefix + name)
        return self._made[name]

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Stream name -> uint8 state."""
        return {name: generator.get_state() for name, generator in self._made.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Inverse of `state_dict`; generators that were handed out already are set in place."""
        for name, value in state.items():
            self(name).set_state(value)


def capture() -> dict[str, Any]:
    """Return the process-wide states: python, numpy, torch CPU, and each CUDA device if CUDA is in use."""
    version, words, gauss = random.getstate()
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    return {
        "python": [version, list(words), gauss],
        "numpy": [kind, np.asarray(keys).tolist(), position, has_gauss, cached],
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],  # type: ignore[no-untyped-call]
    }


def restore(state: dict[str, Any]) -> None:
    """Inverse of `capture`. CUDA states of devices that are not here are left out."""
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    kind, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((kind, np.asarray(keys, dtype=np.uint32), position, has_gauss, cached))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.is_available():
        for device, value in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(value.cpu(), device)


@contextmanager
def preserved() -> Iterator[None]:
    """Restore the process-wide generators after the block, whatever it draws."""
    state = capture()
    try:
        yield
    finally:
        restore(state)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the process-wide generators in the block (from the stream "global"); afterwards they are as before."""
    with preserved():
        digest = hashlib.sha256(f"{seed}/global".encode()).digest()
        random.seed(digest)
        np.random.seed(int.from_bytes(digest[:4], "little"))
        torch.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
        yield
