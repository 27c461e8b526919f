"""Full-reference metrics that model how people see differences, through the packages that define them.

FLIP (flip-evaluator), MS-SSIM, HaarPSI, FSIM, VSI and GMSD (piq), ColorVideoVDP (cvvdp): extras of this package,
computed where they are installed. Studies of splats disagree about which of them goes with opinions, so none is in a
table and nothing is ranked by one. Source: specification of the protocols, perceptual metrics.
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from pydantic import BaseModel, Field
from torch import Tensor

from splatwizard_core.api import CapabilityError, MetricSetup, PreparedMetric, SplatwizardError
from sw_metrics.conventions import check_pair
from sw_metrics.torchvision_import import import_torchvision

SMALLEST_MS_SSIM = 161  # pixels: 11 pixels of a window at the fifth scale
SMALLEST_HAARPSI = 16  # pixels


class FlipSettings(BaseModel):
    """The settings `metrics.flip.KEY`."""

    ppd: float = Field(67.0, gt=0, lt=1e4, description="pixels per degree; 67: 3840 px, 0.7 m wide, from 0.7 m")


class CvvdpSettings(BaseModel):
    """The settings `metrics.cvvdp.KEY`."""

    display: Literal["standard_fhd", "standard_4k", "standard_phone"] = Field(
        "standard_fhd", description="display that is modelled; standard_fhd: 24 inches from 0.6 m"
    )


Compute = Callable[[Tensor, Tensor], float]


@dataclass(frozen=True)
class Packaged:
    """A metric of somebody's package.

    install     command of the extra that brings it
    package     distribution whose version the record keeps
    module      what is imported
    make        (module, setup) -> (what computes, what its values depend on besides)
    """

    install: str
    package: str
    module: str
    make: Callable[[Any, MetricSetup], tuple[Compute, Mapping[str, str]]]

    def prepare(self, setup: MetricSetup) -> PreparedMetric:
        """The metric on the setup's device. Raises CapabilityError that says what to install."""
        with self._imported() as module:
            compute, told = self.make(module, setup)

        def checked(render: Tensor, truth: Tensor) -> float:
            check_pair(render, truth)
            return compute(render.float(), truth.float())

        return PreparedMetric(checked, {self.package: str(self.version()), **told})

    def identity(self, setup: MetricSetup) -> str | None:
        """The package's version and the settings; None without the package."""
        version = self.version()
        settings = {group: dict(values) for group, values in setup.settings.items() if group in ("flip", "cvvdp")}
        return None if version is None else f"{self.package} {version}, {settings}"

    def version(self) -> str | None:
        """Version of the installed package; None without it."""
        try:
            return importlib.metadata.version(self.package)
        except importlib.metadata.PackageNotFoundError:
            return None

    @contextlib.contextmanager
    def _imported(self) -> Iterator[Any]:
        """The package's module. Raises CapabilityError where it, or what it imports inside, is not installed."""
        if self.version() is None:
            raise CapabilityError(self._missing(), missing=[self.package])
        with contextlib.suppress(ImportError):  # whoever needs it says so below
            import_torchvision()  # piq and cvvdp import it
        try:
            yield importlib.import_module(self.module)
        except ImportError as error:
            raise CapabilityError(f"{self._missing()} ({error})", missing=[self.package]) from error

    def _missing(self) -> str:
        return f"package-missing: {self.install}"


def too_small(what: str, side: int, image: Tensor) -> None:
    """Raise CapabilityError for a picture with a shorter side than a metric needs."""
    if min(image.shape[1:]) < side:
        raise CapabilityError(f"too-small: {what} needs pictures of at least {side} pixels a side")


def of_piq(call: Callable[[Any, Tensor, Tensor], Tensor], what: str, side: int = 1) -> Packaged:
    """A metric of piq: `call(piq, x, y)` of [1,3,H,W] pictures in 0..1, at least `side` pixels wide and high."""

    def make(piq: Any, setup: MetricSetup) -> tuple[Compute, Mapping[str, str]]:
        def compute(render: Tensor, truth: Tensor) -> float:
            too_small(what, side, render)
            with torch.no_grad():
                return float(call(piq, render[None], truth[None]))

        return compute, {}

    return Packaged("pip install 'sw-metrics[piq]'", "piq", "piq", make)


def _flip(module: Any, setup: MetricSetup) -> tuple[Compute, Mapping[str, str]]:
    ppd = setup.read(FlipSettings, "flip").ppd

    def compute(render: Tensor, truth: Tensor) -> float:
        pictures = [image.permute(1, 2, 0).contiguous().cpu().numpy() for image in (truth, render)]
        if not all(math.isfinite(float(each.sum())) for each in pictures):
            raise SplatwizardError("FLIP: a picture has values that are not finite")
        try:
            found = module.evaluate(*pictures, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=True,
                                    parameters={"ppd": ppd})  # fmt: skip
        except SystemExit as error:  # the library ends the process on parameters that it does not like
            raise SplatwizardError(f"FLIP: flip-evaluator gave up with status {error.code}") from error
        return float(found[1])

    return compute, {"ppd": f"{ppd:g}"}


def _cvvdp(module: Any, setup: MetricSetup) -> tuple[Compute, Mapping[str, str]]:
    display = setup.read(CvvdpSettings, "cvvdp").display
    metric = setup.share(f"cvvdp {display}", lambda: module.cvvdp(display_name=display, heatmap=None))

    def compute(render: Tensor, truth: Tensor) -> float:
        test, reference = (image.permute(1, 2, 0) for image in (render, truth))
        found, _ = metric.predict(test, reference, dim_order="HWC", frames_per_second=0)
        return float(found)

    return compute, {"display": display}


class OfVideos(Packaged):
    """ColorVideoVDP, which also takes videos."""

    def of_video(
        self, setup: MetricSetup, render: Tensor, truth: Tensor, *, fps: float
    ) -> tuple[float, Mapping[str, str]]:
        """JOD of a video [3,F,H,W] in 0..1 against another, and what it depends on.

        Raises CapabilityError that says what to install.
        """
        display = setup.read(CvvdpSettings, "cvvdp").display
        with self._imported() as module:
            metric = module.cvvdp(display_name=display, heatmap=None, temp_padding="replicate")
            found, _ = metric.predict(render[None], truth[None], dim_order="BCFHW", frames_per_second=fps)
        return float(found), {self.package: str(self.version()), "display": display, "fps": f"{fps:g}"}


FLIP = Packaged("pip install 'sw-metrics[flip]'", "flip-evaluator", "flip_evaluator", _flip)
CVVDP = OfVideos("pip install 'sw-metrics[cvvdp]'", "cvvdp", "pycvvdp", _cvvdp)
MS_SSIM = of_piq(
    lambda piq, x, y: piq.multi_scale_ssim(x, y, kernel_size=11, kernel_sigma=1.5, data_range=1.0, k1=0.01, k2=0.03),
    "MS-SSIM",
    SMALLEST_MS_SSIM,
)
HAARPSI = of_piq(
    lambda piq, x, y: piq.haarpsi(x, y, data_range=1.0, scales=3, subsample=True, c=30.0, alpha=4.2),
    "HaarPSI",
    SMALLEST_HAARPSI,
)
FSIM = of_piq(lambda piq, x, y: piq.fsim(x, y, data_range=1.0, chromatic=True), "FSIM")
VSI = of_piq(lambda piq, x, y: piq.vsi(x, y, data_range=1.0), "VSI")
GMSD = of_piq(lambda piq, x, y: piq.gmsd(x, y, data_range=1.0), "GMSD")

METRICS: Mapping[str, Packaged] = {
    "flip": FLIP, "ms_ssim": MS_SSIM, "haarpsi": HAARPSI, "fsim": FSIM, "vsi": VSI, "gmsd": GMSD, "cvvdp": CVVDP,
}  # fmt: skip
