"""The 22 numbers of a splat beside its cell: what they mean, in which order they are coded, and their base steps.

    opacity     logit u
    shape       d [5], orthonormal coordinates of the deviator of L, the logarithm of the square root of the covariance
    size        m = (trace of L) / 3 - ln(edge of the splat's cell)
    colour      y, c1, c2: orthonormal luma and chroma of the colour 0.5 + C0 sh_dc
    latents     a [12], which the appearance network turns into SH bands 1 to 3 once, when the file is decoded

A file holds integers k: value = (mu + k m) Q0 / 4096, with the predicted mean mu and the step multiplier m.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Group:
    """Numbers that are coded together.

    columns     where they stand among the 22
    steps       base step Q0 of each column, in its own unit
    limit       values are kept within -limit..limit
    """

    name: str
    columns: slice
    steps: tuple[float, ...]
    limit: float

    @property
    def width(self) -> int:
        """Number of columns."""
        return len(self.steps)


OPACITY = Group("opacity", slice(0, 1), (0.75,), 6.0)
SHAPE = Group("shape", slice(1, 6), (0.4,) * 5, 8.0)
SIZE = Group("size", slice(6, 7), (0.25,), 6.0)
COLOUR = Group("colour", slice(7, 10), (0.05, 0.07, 0.07), 4.0)
LATENTS = Group("latents", slice(10, 22), (0.15,) * 12, 3.0)
GROUPS = (OPACITY, SHAPE, SIZE, COLOUR, LATENTS)
"""In coding order."""

NUMBERS = sum(group.width for group in GROUPS)
BASE_STEPS = tuple(step for group in GROUPS for step in group.steps)
LIMITS = tuple(group.limit for group in GROUPS for _ in group.steps)

LOWEST_LEVEL, HIGHEST_LEVEL = 3, 18
"""Levels of the octree at which splats may sit; a cell of level l has edge root edge / 2^l."""

BLOCKS = (OPACITY.columns, slice(SHAPE.columns.start, SIZE.columns.stop), COLOUR.columns, LATENTS.columns)
"""Columns that are predicted at once: opacity; shape and size; colour; latents."""
PARTS = (
    (OPACITY.columns,),
    (slice(1, 4), slice(4, 7)),
    (slice(7, 8), slice(8, 9), slice(9, 10)),
    (slice(10, 14), slice(14, 18), slice(18, 22)),
)
"""Columns of each block that are coded at once, and that later parts of it follow (`ties`)."""
