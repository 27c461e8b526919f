"""Resolution schedule: training starts with small images and ends at full resolution.

Source: DashGaussian (arXiv 2503.18402); `s` is the factor by which the side of an image is reduced.
"""

from __future__ import annotations

import bisect
import contextlib
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from splatwizard_core.api import CameraSampler, Scene, TrainingState, View

LEVELS = 32
"""Number of resolution levels between the first and the full resolution."""
BISECTION_STEPS = 24
"""Bisection steps of the search for a scale: finer than a pixel of any image."""
FIRST_ENERGY_DIVISOR = 4.0
"""The first images hold 1/FIRST_ENERGY_DIVISOR of the sum of all spectral amplitudes."""

FEW_PIXELS = 1 << 18
"""Pixels of a picture up to which one thread is faster than several: they wait for each other, on shared cores long."""

Rounding = Literal["real", "floor"]


def amplitudes(picture: Tensor) -> Tensor:
    """Amplitudes of the spectrum of [C,H,W], summed over channels, DC in the middle: [H,W] float32."""
    return torch.fft.fftshift(torch.fft.fft2(picture).abs().sum(dim=0))


class Spectrum:
    """Summed-area table of amplitudes [H,W]: sums over centred windows in constant time."""

    def __init__(self, amplitude: Tensor) -> None:
        self.height, self.width = amplitude.shape
        # On the CPU: cumsum on CUDA is not deterministic.
        table = torch.zeros(self.height + 1, self.width + 1, dtype=torch.float64)
        table[1:, 1:] = amplitude.double().cpu().cumsum(0).cumsum(1)
        self._table = table

    def within(self, scale: float) -> float:
        """Sum of the window of floor(H / scale) x floor(W / scale) bins."""
        h, w = max(1, int(self.height / scale)), max(1, int(self.width / scale))
        y, x = self.height // 2 - h // 2, self.width // 2 - w // 2
        t = self._table
        return float(t[y + h, x + w] - t[y, x + w] - t[y + h, x] + t[y, x])

    def scale_of(self, energy: float) -> float:
        """Return the largest scale >= 1 whose window holds at least this sum."""
        low, high = 0.0, 1.0  # of 1 / scale
        for _ in range(BISECTION_STEPS):
            middle = (low + high) / 2
            if middle > 0 and self.within(1 / middle) < energy:
                low = middle
            else:
                high = middle
        return 1 / high


@dataclass(frozen=True)
class ResolutionPlan:
    """Scales over time: at step `times[k]` images are `scales[k]` times smaller, interpolated in between, 1 at the end.

    times   ascending, the first one 0, the last one the step from which pictures are whole
    scales  descending, the last one 1
    """

    times: tuple[int, ...]
    scales: tuple[float, ...]

    def scale(self, step: int) -> float:
        """Return the scale at a step: between two levels the number of pixels, 1 / scale^2, is linear."""
        at = bisect.bisect_right(self.times, step)
        if at >= len(self.times):
            return 1.0
        t0, t1 = self.times[at - 1], self.times[at]
        p0, p1 = self.scales[at - 1] ** -2, self.scales[at] ** -2
        return float((p0 + (step - t0) / (t1 - t0) * (p1 - p0)) ** -0.5)


def first_scale(spectrum: Spectrum) -> float:
    """Return the scale at which one picture holds its first share of the amplitudes."""
    return spectrum.scale_of(spectrum.within(1) / FIRST_ENERGY_DIVISOR)


def resolution_plan(first: float, mean: Spectrum, *, full_at: int) -> ResolutionPlan:
    """Return the resolution plan computed from the spectra of the images.

    first       scale of the first pictures; without detail beyond it, or at 1, pictures are whole from the start
    mean        spectrum of the mean of their amplitudes
    full_at     step from which pictures are whole
    """
    least, total = mean.within(first), mean.within(1)
    if first <= 1 or full_at <= 0 or not 0 < least < total:
        return ResolutionPlan((0,), (1.0,))
    times, scales = [0], [first]
    for k in range(1, LEVELS):
        energy = least + (total - least) * k / (LEVELS - 1)
        time = math.floor(full_at * math.log(energy / least) / math.log(total / least))
        scale = 1.0 if k == LEVELS - 1 else min(scales[-1], mean.scale_of(energy))
        if time > times[-1]:
            times.append(time)
            scales.append(scale)
        else:
            scales[-1] = scale
    times[-1], scales[-1] = full_at, 1.0
    return ResolutionPlan(tuple(times), tuple(scales))


@torch.no_grad()
def plan_of_views(
    views: Sequence[View], *, full_at: int, most: float = 4.0, background: Tensor | None = None
) -> ResolutionPlan:
    """Return the plan of these training views; pictures of other sizes count at the size of the median."""
    sizes = sorted((view.camera.height * view.camera.width, view.camera.height, view.camera.width) for view in views)
    _, height, width = sizes[len(sizes) // 2]
    first, total = most, torch.zeros(height, width)
    with one_thread() if height * width <= FEW_PIXELS else contextlib.nullcontext():
        for view in views:
            device = view.kept_on
            picture = shrunk(view.image(background, device), height, width)
            amplitude = amplitudes(picture)
            first = min(first, first_scale(Spectrum(amplitude)))
            total = total.to(device) + amplitude
    return resolution_plan(first, Spectrum(total / len(views)), full_at=full_at)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute on one thread inside the block."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def shrunk(image: Tensor, height: int, width: int) -> Tensor:
    """[C,H,W] at another size, bilinear with antialiasing; itself where it has that size."""
    if image.shape[-2:] == (height, width):
        return image
    return torch.nn.functional.interpolate(
        image[None], (height, width), mode="bilinear", antialias=True, align_corners=False
    )[0]


class SmallerView(View):
    """A view at a lower resolution; the field of view is unchanged."""

    def __init__(self, view: View, width: int, height: int) -> None:
        super().__init__(view.camera.resized(width, height), view.name)
        self.whole = view

    def image(self, background: Tensor | None = None, device: torch.device | str = "cpu") -> Tensor:
        """Return float32 [3,h,w] in 0..1 on `device`, downsampled from the full image per call."""
        return shrunk(self.whole.image(background, device), self.camera.height, self.camera.width)


class ResolutionSampler(CameraSampler):
    """Draws views as the sampler inside does, and hands them out at the resolution of the step.

    inner       draws
    make_plan   () -> ResolutionPlan, asked at the first step: it reads all pictures, which is training time
    rounds      steps, ascending, after each of which the scale is read anew: those at which statistics start again, so
                that all in between are of one resolution; None: at every step
    rounding    "real": any scale; "floor": whole ones, as published
    """

    def __init__(
        self,
        inner: CameraSampler,
        make_plan: Callable[[], ResolutionPlan],
        *,
        rounds: Sequence[int] | None,
        rounding: Rounding = "real",
    ) -> None:
        self.inner, self.rounds, self.rounding = inner, rounds, rounding
        self.views, self.generator = inner.views, inner.generator
        self._make_plan = make_plan
        self._plan: ResolutionPlan | None = None
        self._scale = 1.0
        self._smaller: dict[View, SmallerView] = {}

    @property
    def plan(self) -> ResolutionPlan:
        """The scales over time."""
        if self._plan is None:
            self._plan = self._make_plan()
        return self._plan

    def scale(self, step: int) -> float:
        """Return how many times smaller the pictures of a step are."""
        read_at = step
        if self.rounds is not None:
            past = bisect.bisect_left(self.rounds, step)  # a round at step k is past from step k + 1 on
            read_at = self.rounds[past - 1] if past else 0
        scale = 1.0 if step > self.plan.times[-1] else self.plan.scale(read_at)
        return float(math.floor(scale)) if self.rounding == "floor" else scale

    def next(self, step: int) -> View:
        """Return the view of this step at the resolution of this step."""
        view, scale = self.inner.next(step), self.scale(step)
        if scale <= 1:
            self._smaller.clear()
            return view
        if scale != self._scale:
            self._scale = scale
            self._smaller.clear()
        if view not in self._smaller:
            camera = view.camera
            width, height = max(1, int(camera.width / scale)), max(1, int(camera.height / scale))
            self._smaller[view] = SmallerView(view, width, height)
        return self._smaller[view]

    def state_dict(self) -> dict[str, Any]:
        return self.inner.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.inner.load_state_dict(state)


class SmallPictures:
    """Schedule task "dash": a training draws its views by the resolution schedule of its scene, from small to whole.

    As a task it runs before rendering, from the first step to `full_at`. Checkpoints hold the same with it as without.

    full_at     step from which pictures are whole
    rounds      steps, ascending, after which sizes may change: those that densify; None: all
    most        times that the first pictures are smaller, at most
    rounding    "real": any scale; "floor": whole ones, as published
    """

    def __init__(
        self, *, full_at: int, rounds: list[int] | None = None, most: float = 4.0, rounding: Rounding = "real"
    ) -> None:
        self.full_at, self.rounds, self.most, self.rounding = full_at, rounds, most, rounding

    def __call__(self, state: TrainingState) -> None:
        if not isinstance(state.sampler, ResolutionSampler):
            state.sampler = self.sampler(state.sampler, state.scene)

    def sampler(self, inner: CameraSampler, scene: Scene) -> ResolutionSampler:
        """Return a sampler that hands out what `inner` draws in the sizes of the schedule."""

        def plan() -> ResolutionPlan:
            return plan_of_views(scene.train, full_at=self.full_at, most=self.most, background=scene.background)

        return ResolutionSampler(inner, plan, rounds=self.rounds, rounding=self.rounding)
