"""The process-wide random generators, which libraries draw from: kept, restored and seeded."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch


def capture_random_states() -> dict[str, Any]:
    """Return the process-wide states: python, numpy, torch CPU, and each CUDA device if CUDA is in use."""
    version, words, gauss = random.getstate()
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    return {
        "python": [version, list(words), gauss],
        "numpy": [kind, np.asarray(keys).tolist(), position, has_gauss, cached],
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else [],  # type: ignore[no-untyped-call]
    }


def restore_random_states(state: dict[str, Any]) -> None:
    """Inverse of `capture_random_states`. CUDA states of devices that are not here are left out."""
    version, words, gauss = state["python"]
    random.setstate((version, tuple(words), gauss))
    kind, keys, position, has_gauss, cached = state["numpy"]
    np.random.set_state((kind, np.asarray(keys, dtype=np.uint32), position, has_gauss, cached))
    torch.set_rng_state(state["torch"].cpu())
    if state["cuda"] and torch.cuda.is_available():
        for device, value in enumerate(state["cuda"][: torch.cuda.device_count()]):
            torch.cuda.set_rng_state(value.cpu(), device)


@contextmanager
def preserved_random_states() -> Iterator[None]:
    """Restore the process-wide generators after the block, whatever it draws."""
    state = capture_random_states()
    try:
        yield
    finally:
        restore_random_states(state)


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed the process-wide generators in the block ; afterwards they are as before."""
    with preserved_random_states():
        digest = hashlib.sha256(f"{seed}/global".encode()).digest()
        random.seed(digest)
        np.random.seed(int.from_bytes(digest[:4], "little"))
        torch.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
        yield
