"""The process-wide random generators, which libraries draw from: kept, restored and seeded."""

from __future__ import annotations

import hashlib
import os
import random
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from typing import Any

import numpy as np
import torch

from splatwizard_native import ForeseenError

WORKSPACES = ":4096:8", ":16:8"
"""Values of CUBLAS_WORKSPACE_CONFIG with which equal products on a GPU have equal bits."""


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
def one_order_of_sums() -> Iterator[None]:
    """Let torch, and the kernels that ask it, add in an order that no timing decides; afterwards as before.

    An operation that has no such order raises RuntimeError and names itself. Raises ForeseenError where the
    environment lets the products of a GPU have none.
    """
    workspace = os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", WORKSPACES[0])  # read at the first product on a GPU
    if workspace not in WORKSPACES:
        raise ForeseenError(
            f"deterministic=true: CUBLAS_WORKSPACE_CONFIG is '{workspace}', with which the products of a GPU have no "
            f"fixed order; unset it, or set it to {' or '.join(WORKSPACES)}"
        )
    settings: Any = torch.utils.deterministic
    asked, only_warned = (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )
    filled = settings.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    settings.fill_uninitialized_memory = False  # no kernel here reads what it has not written
    try:
        yield
    finally:
        settings.fill_uninitialized_memory = filled
        torch.use_deterministic_algorithms(asked, warn_only=only_warned)


@contextmanager
def seeded(seed: int, *, deterministic: bool = False) -> Iterator[None]:
    """Seed the process-wide generators in the block; afterwards they are as before.

    deterministic   also `torch.use_deterministic_algorithms` in the block: equal draws then give equal bits on a GPU
    """
    with preserved_random_states(), one_order_of_sums() if deterministic else nullcontext():
        digest = hashlib.sha256(f"{seed}/global".encode()).digest()
        random.seed(digest)
        np.random.seed(int.from_bytes(digest[:4], "little"))
        torch.manual_seed(int.from_bytes(digest[:8], "little") >> 1)
        yield
