"""LPIPS in the three forms that published tables use, through the package `lpips` (version 0.1 of the linear heads).

lpips_vgg_3dgs  VGG16, images in 0..1 as they are: what the 3DGS code does and most compression papers copy
lpips_vgg       VGG16, images mapped to -1..1, as the network's input layer expects
lpips_alex      AlexNet, images mapped to -1..1

The first form feeds the network values from a range it was not made for and comes out lower; the three are different
metrics and never share a name. Source: LPIPS (arXiv 1801.03924); specification of the evaluation protocol, LPIPS.
"""

from __future__ import annotations

import importlib.metadata
import re
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from pydantic import BaseModel, Field, field_validator
from torch import Tensor

from splatwizard_core.api import CapabilityError, MetricSetup, PreparedMetric
from sw_metrics.conventions import check_pair
from sw_metrics.lpips_weights import BACKBONES, Weights, check_folder, fetch_command, find_weights, load_weights
from sw_metrics.torchvision_import import import_torchvision

EXTRA = "sw-metrics[lpips]"
"""Extra with `lpips` and torchvision; `install_command` names versions that leave the installed torch as it is."""
SMALLEST = {"vgg": 16, "alex": 31}  # pixels; below, a pooling layer is left with nothing


class LpipsSettings(BaseModel):
    """The settings `metrics.lpips.KEY`, for all three forms."""

    weights: Path | None = Field(None, description="folder with the backbones, searched before torch.hub's cache")

    @field_validator("weights")
    @classmethod
    def _absolute(cls, folder: Path | None) -> Path | None:
        return None if folder is None else folder.resolve()  # another process may work in another folder


@dataclass(frozen=True)
class Lpips:
    """One form of LPIPS, as it is registered.

    net         "vgg" or "alex"
    to_signed   map images from 0..1 to -1..1 first
    """

    net: str
    to_signed: bool

    def prepare(self, setup: MetricSetup) -> PreparedMetric:
        """The metric on the setup's device.

        Raises CapabilityError if the package or the weights are missing, UserInputError for damaged weights.
        """
        version = package_version()
        network, weights = setup.share(f"lpips {self.net}", lambda: _network(self.net, setup))

        def compute(render: Tensor, truth: Tensor) -> float:
            return self._distance(network, render, truth)

        made_with = {"lpips": version, "weights": weights.file_name, "weights_sha256": weights.sha256}
        return PreparedMetric(compute, made_with, weights.published)

    def identity(self, setup: MetricSetup) -> str | None:
        """The package's version and which file would be read; None if one is missing."""
        path = find_weights(self.net, _folder(setup))
        try:
            version = package_version()
        except CapabilityError:
            return None
        if path is None:
            return None
        facts = path.stat()
        return f"lpips {version}, {path.resolve()}, {facts.st_size}, {facts.st_mtime_ns}"

    def unavailable(self, setup: MetricSetup) -> str | None:
        """One line for the user if a form of LPIPS cannot be computed here, else None.

        Raises UserInputError for a folder in the settings without weights, or with damaged ones.
        """
        folder = _folder(setup)
        if folder is not None:
            check_folder(folder)
        return not_available(folder)

    def _distance(self, network: torch.nn.Module, render: Tensor, truth: Tensor) -> float:
        check_pair(render, truth)
        smallest = SMALLEST[self.net]
        if min(render.shape[1:]) < smallest:
            raise CapabilityError(f"too-small: LPIPS ({self.net}) needs pictures of at least {smallest} pixels a side")
        with torch.no_grad():
            return float(network(render.float()[None], truth.float()[None], normalize=self.to_signed))


VGG_3DGS = Lpips("vgg", to_signed=False)
VGG = Lpips("vgg", to_signed=True)
ALEX = Lpips("alex", to_signed=True)


def _folder(setup: MetricSetup) -> Path | None:
    return setup.read(LpipsSettings, "lpips").weights


def fitting_torchvision() -> tuple[str, str] | None:
    """The torch that is here and its torchvision, as pip takes them; None for a build of one's own.

    torch 2.N.P belongs to torchvision 0.(N + 15).P, which requires just that torch: a later one would bring another.
    """
    found = re.fullmatch(r"2\.(\d+)\.(\d+)(\+\w+)?", torch.__version__)
    if found is None:
        return None
    minor, patch = int(found[1]), int(found[2])
    return f"torch==2.{minor}.{patch}", f"torchvision==0.{minor + 15}.{patch}"


def install_command() -> str:
    """The pip command that brings the packages beside the torch that is here, and replaces nothing."""
    pair = fitting_torchvision()
    return f"pip install '{EXTRA}'" if pair is None else f"pip install lpips {' '.join(pair)}"


def package_version() -> str:
    """Version of the installed package `lpips`. Raises CapabilityError that says how to install it."""
    try:
        return importlib.metadata.version("lpips")
    except importlib.metadata.PackageNotFoundError:
        raise CapabilityError(f"package-missing: LPIPS needs: {install_command()}", missing=["lpips"]) from None


def not_available(folder: Path | None) -> str | None:
    """One line for the user if a form of LPIPS cannot be computed here, else None. Reads no weights."""
    try:
        package_version()
    except CapabilityError as error:
        return f"LPIPS is not available ({error}); its values will be null"
    absent = [b.file_name for net, b in BACKBONES.items() if find_weights(net, folder) is None]
    if not absent:
        return None
    beside = BACKBONES["vgg"].address.rpartition("/")[0]
    return (
        f"LPIPS is not available without {' and '.join(absent)}: {fetch_command()}, or from {beside}/ into DIR and "
        "--set metrics.lpips.weights=DIR"
    )


def _network(net: str, setup: MetricSetup) -> tuple[torch.nn.Module, Weights]:
    """The network with the weights of a backbone, on the device, in eval mode."""
    weights = load_weights(net, _folder(setup))
    lpips = _import_lpips()
    # pnet_rand keeps the package from downloading; what it draws instead is replaced below, and no stream is moved.
    with torch.random.fork_rng(devices=[]), warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # torchvision: an argument that lpips uses is deprecated
        network: torch.nn.Module = lpips.LPIPS(net=net, version="0.1", pnet_rand=True, eval_mode=True, verbose=False)
    # Its slices count layers as torchvision's `features` does: slice3.10.weight is features.10.weight.
    own = {key: f"features.{key.partition('.')[2]}" for key in network.net.state_dict()}  # type: ignore[union-attr]
    if set(own.values()) != set(weights.state):
        raise CapabilityError(f"package-missing: lpips {package_version()} has another network than 0.1.4: {EXTRA}")
    network.net.load_state_dict({key: weights.state[name] for key, name in own.items()})  # type: ignore[union-attr]
    return network.to(setup.device).eval().requires_grad_(False), weights


def _import_lpips() -> Any:
    try:
        import_torchvision()
        import lpips
    except ImportError as error:
        raise CapabilityError(f"package-missing: LPIPS cannot be imported: {error}: {install_command()}") from error
    return lpips
