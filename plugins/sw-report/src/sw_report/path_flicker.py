"""Flicker and popping along a camera path: how a model's errors change from frame to frame.

Errors that stay put, or drift evenly, do not flicker. Both models are seen from the same cameras, so motion cancels to
first order: no optical flow, no warping. Frames are rounded to 8 bit; values are in levels. They hold for one step of
the path alone. Source: specification of the protocols, temporal flicker along a path (our own definition).
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import dataclass, field

import torch
from torch import Tensor

PEAK = 255.0


@dataclass
class PathFlicker:
    """Measures a path while its frames come: `add` each, then `result`."""

    _errors: deque[Tensor] = field(default_factory=lambda: deque(maxlen=3))
    _frames: tuple[deque[Tensor], deque[Tensor]] = field(default_factory=lambda: (deque(maxlen=3), deque(maxlen=3)))
    _first: list[float] = field(default_factory=list)
    _second: list[float] = field(default_factory=list)
    _squares: list[float] = field(default_factory=list)
    _jumps: tuple[list[float], list[float]] = field(default_factory=lambda: ([], []))

    def add(self, reference: Tensor, render: Tensor) -> None:
        """Take the next frame of the reference and of the model, [3,H,W] in 0..1."""
        pair = [torch.round(frame.clamp(0, 1) * PEAK).double() for frame in (reference, render)]
        self._errors.append(pair[1] - pair[0])
        self._squares.append(self._errors[-1].square().mean().item())
        if len(self._errors) > 1:
            self._first.append((self._errors[-1] - self._errors[-2]).square().mean().item())
        if len(self._errors) > 2:
            self._second.append(_second(self._errors).square().mean().item())
        for frames, jumps, frame in zip(self._frames, self._jumps, pair, strict=True):
            frames.append(frame)
            if len(frames) > 2:
                jumps.append(_second(frames).abs().mean().item())

    def result(self) -> dict[str, float | str | None]:
        """Return the values of the frames so far; None where there are too few, or nothing to divide by.

        frames      how many
        flicker     root mean square of e[t+1] - 2 e[t] + e[t-1], e = render - reference, levels; needs 3 frames
        flicker1    the same of e[t+1] - e[t]; needs 2
        psnr        of the error of all frames together, dB
        popping_a, popping_b    largest over the frames of the mean of |x[t+1] - 2 x[t] + x[t-1]|, over its median, of
                    reference and model each by itself
        """
        mean = sum(self._squares) / len(self._squares) if self._squares else 0.0
        return {
            "frames": len(self._squares),
            "flicker": _root_mean(self._second),
            "flicker1": _root_mean(self._first),
            "psnr": 10 * math.log10(PEAK**2 / mean) if mean > 0 else None,
            "popping_a": _popping(self._jumps[0]),
            "popping_b": _popping(self._jumps[1]),
        }


def _second(frames: deque[Tensor]) -> Tensor:
    """The second difference of three frames."""
    return frames[2] - 2 * frames[1] + frames[0]


def _root_mean(values: list[float]) -> float | None:
    return math.sqrt(sum(values) / len(values)) if values else None


def _popping(jumps: list[float]) -> float | None:
    middle = statistics.median(jumps) if jumps else 0.0
    return max(jumps) / middle if middle else None
