"""Validated reading of header values that anchor methods share."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from splatwizard_core.api import BitstreamError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader


def read_integers(
    reader: ContainerReader, key: str, *, low: int, high: int, longest: int, shortest: int = 1
) -> tuple[int, ...]:
    """Read a list of `shortest` to `longest` integers in low..high. Raises BitstreamError."""
    values: Any = reader.static.get(key)
    fits = isinstance(values, list) and shortest <= len(values) <= longest
    if not fits or any(type(v) is not int or not low <= v <= high for v in values):
        count = f"{shortest}..{longest}" if shortest < longest else str(longest)
        raise BitstreamError(
            f"{reader.name}: header value '{key}' must be a list of {count} integers in {low}..{high}", section="header"
        )
    return tuple(values)


def read_base_steps(reader: ContainerReader, *, low: float, high: float) -> tuple[float, float, float]:
    """Read `base_steps`: one quantiser step in low..high per group. Raises BitstreamError."""
    steps: Any = reader.static.get("base_steps")
    fits = isinstance(steps, list) and len(steps) == 3
    if not fits or any(type(q) not in (int, float) or not low <= q <= high for q in steps):
        raise BitstreamError(
            f"{reader.name}: header value 'base_steps' must be three numbers in {low:g}..{high:g}", section="header"
        )
    features, scales, offsets = map(float, steps)
    return features, scales, offsets
