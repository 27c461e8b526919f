"""Checks of coders: the conformance checks of sw-codecs, with something small to code."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from sw_codecs import testing
from sw_kit.checks.targets import make
from sw_kit.finding import NotCheckedError
from sw_kit.samples import some_gaussians

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager
    from splatwizard_core.tooling import Entry

RNG_SEED = 5


def check_coder(entry: Entry, plugins: PluginManager) -> str:
    """Hold a coder to the contract that its field `codes` names. Raises AssertionError that says what does not hold."""
    make(entry, plugins)  # says first if it cannot be used here
    factory, rng = entry.load(), np.random.default_rng(RNG_SEED)
    codes = entry.declared["codes"]
    if codes == "symbols":
        symbols = rng.choice(4, size=300, p=[0.6, 0.25, 0.1, 0.05])
        testing.check_entropy_coder(factory, np.array([60, 25, 10, 5]), symbols)
        return "300 symbols come back"
    if codes == "positions":
        points = rng.integers(0, 1 << 6, size=(80, 3))
        testing.check_position_codec(factory, np.concatenate([points, points[:3]]), 6)
        return "83 points come back, duplicates among them"
    if codes == "vectors":
        testing.check_vector_coder(factory, plugins, rng.normal(size=(64, 12)).astype(np.float32))
        return "64 vectors come back in shape"
    if codes == "arrays":
        array = _array_for(factory, rng)
        testing.check_array_coder(factory, array)
        return f"an array {list(array.shape)} {array.dtype} comes back bit for bit"
    decoded = testing.check_gaussian_codec(factory, plugins, some_gaussians())
    return f"{decoded.num_rows} Gaussians come back, cut sections are refused"


def _array_for(factory: Any, rng: np.random.Generator) -> np.ndarray:
    """Return an array that the coder takes."""
    candidates = (
        rng.normal(size=(40, 3)).astype(np.float32),
        rng.integers(0, 100, size=(40, 2)).astype(np.int32),
        rng.integers(0, 7, size=40).astype(np.uint16),
        rng.integers(0, 7, size=40).astype(np.uint8),
    )
    for array in candidates:
        try:
            factory().encode(array)
        except (ValueError, TypeError):
            continue
        return array
    raise NotCheckedError("it takes no array of float32, int32, uint16 or uint8", "sw_codecs.testing in your own tests")
