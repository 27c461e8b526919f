"""A short training of what stays on pictures of the source: it makes up for what went.

No photograph is needed: the teacher is the source, its cameras those that were made up and others near them. Noise as
wide as the steps of the file stands in for rounding, so what is learnt outlasts it.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.nn import functional

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, photometric_loss, stream, track
from sw_compress.quality import Pictures, decibels
from sw_compress.rows import select

if TYPE_CHECKING:
    from splatwizard_core.api import Rasterizer
    from sw_compress.coders import Levels, Quantized

RATES = {
    "means": 1.6e-7, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4, "opacity_logits": 0.05, "log_scales": 5e-3, "quats": 1e-3,
}  # fmt: skip
"""Adam learning rates, the last of a 3DGS training; of the means a tenth of it, times the extent."""
FALL = 0.3, 0.03
"""Factor on them at the beginning and at the end: at full rates a short training does harm first."""
NOISE = {"opacity_logits": "opacity", "log_scales": "scale", "quats": "quat", "sh_dc": "dc", "sh_rest": "rest"}
"""Parameter -> attribute whose step it is rounded with."""
SHIFT, TURN = 0.03, 0.0873
"""Largest change of a camera: its centre by a share of its distance, its axes by radians."""
SET_ASIDE = 4
"""Of so many cameras one judges and teaches nothing."""
JUDGEMENTS = 6
"""Judgements, evenly over the time; the best state stays."""


@dataclass(frozen=True)
class Refined:
    """Outcome of a refinement.

    model           the best state, or what it began with
    before, after   dB against the source at cameras that taught nothing, rounded as the file is
    """

    model: GaussianModel
    steps: int
    before: float
    after: float

    def as_dict(self) -> dict[str, float]:
        return {"steps": self.steps, "psnr_before": round(self.before, 3), "psnr_after": round(self.after, 3)}


def refine(
    part: GaussianModel, source: GaussianModel, cameras: Sequence[Camera], rasterizer: Rasterizer, coder: Quantized,
    levels: Levels, *, seconds: float, clock: Callable[[], float] = time.perf_counter,
) -> Refined:  # fmt: skip
    """Train Gaussians for some seconds on pictures of the source.

    part        what stays; left as it is
    cameras     some teach and some judge
    levels      of the file
    clock       seconds that pass

    Never worse than it began, by the cameras that judge.
    """
    began = clock()
    judging = list(cameras[::SET_ASIDE]) or list(cameras)
    teaching = [camera for i, camera in enumerate(cameras) if i % SET_ASIDE] or list(cameras)
    judge = Pictures(source, judging, rasterizer, RasterOptions(alpha=True), label="draw the source to refine by")
    least = first = judge.error(coder.rounded(part, levels))
    best, model = part, select(part, torch.arange(part.num_rows, device=part.device))
    centre = model.means.detach().median(0).values
    extent = max(float((camera.center.to(centre) - centre).norm()) for camera in cameras)
    factors = coder.factors(model)
    draws, noise = stream(0, "refine"), torch.Generator(model.device).manual_seed(0)
    params = {name: getattr(model, name) for name in RATES if getattr(model, name).numel()}
    usual = [RATES[name] * (extent if name == "means" else 1.0) for name in params]
    optimizer = torch.optim.Adam([{"params": [each]} for each in params.values()], eps=1e-15)
    steps, judged, options = 0, 0, RasterOptions()
    with track("refine", total=JUDGEMENTS) as bar:
        while (share := (clock() - began) / seconds) < 1 or not steps:
            for group, rate in zip(optimizer.param_groups, usual, strict=True):
                group["lr"] = rate * FALL[0] * (FALL[1] / FALL[0]) ** min(share, 1.0)
            i = int(torch.randint(len(teaching), (), generator=draws))
            camera = near(teaching[i], centre.cpu(), draws).to(model.device)
            with torch.no_grad():
                truth = rasterizer.render(source.gaussians(camera, rasterizer), camera, options).image.clamp(0, 1)
            model.train().requires_grad_(True)
            with noisy(params, coder.steps(levels), noise, factors):
                found = rasterizer.render(model.gaussians(camera, rasterizer), camera, options).image
                optimizer.zero_grad()
                photometric_loss(found, truth).total.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            steps += 1
            if (clock() - began) / seconds > (judged + 1) / JUDGEMENTS:
                best, least = _better(model, coder, levels, judge, best, least)
                judged += 1
                bar.advance()
        best, least = _better(model, coder, levels, judge, best, least)
    return Refined(best, steps, decibels(first), decibels(least))


@torch.no_grad()
def _better(
    model: GaussianModel, coder: Quantized, levels: Levels, judge: Pictures, best: GaussianModel, least: float
) -> tuple[GaussianModel, float]:
    """The state of now and its error, if that is less."""
    now = select(model, torch.arange(model.num_rows, device=model.device))
    error = judge.error(coder.rounded(now, levels))
    return (now, error) if error < least else (best, least)


@contextlib.contextmanager
def noisy(
    params: Mapping[str, Tensor], steps: Mapping[str, float], generator: torch.Generator, factors: Tensor
) -> Iterator[None]:
    """Add uniform noise as wide as the steps to parameters for the block; gradients go to them as they are.

    factors     [N] of the steps of each Gaussian
    """
    added: dict[str, Tensor] = {}
    with torch.no_grad():
        for name, attribute in NOISE.items():
            if name in params:
                values = params[name]
                uniform = torch.rand(values.shape, generator=generator, device=values.device)
                widths = steps[attribute] * factors.reshape(-1, *[1] * (values.ndim - 1))
                added[name] = (uniform - 0.5) * widths
                if name == "quats":  # the file holds unit quaternions
                    added[name] *= values.norm(dim=-1, keepdim=True)
                values.add_(added[name])
    try:
        yield
    finally:
        with torch.no_grad():
            for name, noise in added.items():
                params[name].sub_(noise)


def near(camera: Camera, centre: Tensor, generator: torch.Generator) -> Camera:
    """Return a camera beside another one, by SHIFT and TURN at most.

    centre  [3] of the scene: the distance to it scales the shift
    """
    shift, turn = (2 * torch.rand(3, generator=generator) - 1 for _ in range(2))
    place = camera.center.cpu()
    place = place + SHIFT * (place - centre).norm() * functional.normalize(shift, dim=0) * shift.abs().max()
    x, y, z = (TURN * turn / 3**0.5).tolist()
    rotation = torch.linalg.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])) @ camera.R.cpu()
    return replace(camera, R=rotation, tau=-rotation @ place)
