"""Settings of the file between and beyond the rate points of a method that share a training."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import ConfigError, apply_overrides
from splatwizard_core.tooling import dotted

if TYPE_CHECKING:
    from splatwizard_core.api import Method, OptimizationParams

BEYOND = 5.0
"""How far settings go on beyond two rate points, in their distance."""


class RateLadder:
    """Configs from small files to large ones, by place: whole numbers are rate points, the rest lies between two.

    method      as it is configured, without a size
    """

    def __init__(self, method: Method) -> None:
        self.plugins, self.config = method.plugins, method.config
        self.points, self.own = self._sharing(method)

    @property
    def last(self) -> float:
        """The highest place."""
        steady = len(self.points) > 1 and between(self.points[-2], self.points[-1], 0.5) is not None
        return len(self.points) - 1 + (BEYOND if steady else 0.0)

    def at(self, place: float) -> OptimizationParams | None:
        """Return the config at a place, up to `last`, also below 0; None where there is none."""
        below = min(max(int(place), 0), len(self.points) - 1)
        share = place - below
        if not share:
            return self.points[below]
        if below + 1 == len(self.points) or between(self.points[below], self.points[below + 1], 0.5) is None:
            # The points around have nothing in between: on from those before.
            step = BEYOND if below + 1 < len(self.points) else 1.0
            below, share = below - 1, 1 + share * step
        if below < 0:
            return None
        for clamped in (share, min(max(share, 0.0), 1.0)):  # whole numbers may end before others do
            found = between(self.points[below], self.points[below + 1], share, whole=clamped)
            if found is None:
                return None
            with contextlib.suppress(ConfigError):  # out of bounds
                moved: OptimizationParams = apply_overrides(self.config, found, source="settings for a size")
                return moved.completed(self.plugins, {})
        return None

    def graded(self, share: float) -> OptimizationParams | None:
        """Return the config at a share, 0..1, between the first and the last rate point where the present one is not of
        numbers as they are: None in .sog's, a palette by the number of Gaussians. None for any other."""
        present = self.points[self.own]
        if any(between(present, other, 0.5) is not None for other in self.points):
            return None
        found = between(self.points[0], self.points[-1], share)
        if found is None:
            return None
        moved: OptimizationParams = apply_overrides(self.config, found, source="settings for a size")
        return moved.completed(self.plugins, {})

    def _sharing(self, method: Method) -> tuple[list[OptimizationParams], int]:
        """Return configs of the rate points that differ from the present one in what `encode` reads, and its place."""
        values = {name: dict(self.config.spelled(method.RATES[name])) for name in method.RATES}
        read = {key for each in values.values() for key in each if key.partition(".")[0] in self.config.ENCODING}
        usual, points = type(self.config)(), []
        for each in values.values():
            trained = {key: value for key, value in each.items() if key not in read}
            if apply_overrides(self.config, trained, source="rate") != self.config:
                continue
            own = {key: each[key] for key in read if key in each}
            own |= {key: _value(usual, key) for key in read - set(own) if _value(usual, key) is not None}
            points.append(apply_overrides(self.config, own, source="rate").completed(self.plugins, {}))
        if self.config not in points:  # the file's settings are of the user's own
            return [self.config], 0
        return points, points.index(self.config)


def between(
    a: OptimizationParams, b: OptimizationParams, share: float, whole: float | None = None
) -> dict[str, Any] | None:
    """Return values by dotted key of b, moved by a share from a to b; None if they differ in more than numbers.

    whole   that share for whole numbers; None: the same
    """
    found: dict[str, Any] = {}
    first, second = dotted(a.model_dump()), dotted(b.model_dump())
    if first.keys() != second.keys():
        return None
    for key, high in second.items():
        low = first[key]
        if low == high:
            continue
        if not _is_number(low) or not _is_number(high):
            return None
        if isinstance(low, int) and isinstance(high, int):
            found[key] = round(low + (share if whole is None else whole) * (high - low))
        elif min(low, high) > 0:
            found[key] = low * (high / low) ** share
        else:
            found[key] = low + share * (high - low)
    if not found:
        return None
    kept = {key: value for key, value in second.items() if key.partition(".")[0] == next(iter(found)).partition(".")[0]}
    return kept | found


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _value(config: OptimizationParams, key: str) -> Any:
    return dotted(config.model_dump()).get(key)
