"""Checks of coders: the conformance checks of sw-codecs, with something small to code."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from splatwizard_core.api import ContainerWriter
from sw_codecs import testing
from sw_kit.checks.prefixes import check_no_cuts, check_prefixes
from sw_kit.checks.targets import make
from sw_kit.finding import NotCheckedError
from sw_kit.samples import some_gaussians

if TYPE_CHECKING:
    from collections.abc import Callable

    from splatwizard_core.api import GaussianCodec, PluginManager
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
    exact = hold_cuts(entry, factory, plugins)
    return f"{decoded.num_rows} Gaussians come back, cut sections are refused{exact and f'; {exact}'}"


def hold_cuts(entry: Entry, factory: Callable[..., GaussianCodec], plugins: PluginManager) -> str:
    """Hold a codec to the cuts that its entry declares, or to none; how many prefixes are exact."""

    def file(**settings: Any) -> bytes:
        writer = ContainerWriter("check", 0)
        factory(plugins, **settings).encode(some_gaussians(), writer)
        return writer.to_bytes()

    check_no_cuts(file(), entry)
    if "prefixes" not in entry.declared:
        return ""
    key, _, value = str(entry.declared["prefixes"]).partition("=")
    data = file(**({key: json.loads(value)} if key else {}))
    return check_prefixes(data, lambda reader: factory(plugins).decode(reader))


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
