"""Check of what LPIPS needs besides torch: its package, and the weights of its networks."""

from __future__ import annotations

import importlib
from pathlib import Path

from splatwizard_core.api import CapabilityError, UserInputError
from splatwizard_core.tooling import Check, file_sha256
from sw_metrics.lpips_weights import BACKBONES, find_weights, hub_folder, read_weights
from sw_metrics.packaged_weights import unlike_published
from sw_metrics.perceptual import fitting_torchvision, install_command, package_version
from sw_metrics.torchvision_import import import_torchvision
from sw_metrics.vision_models import METRICS

GROUP = "metrics"


def check_lpips() -> list[Check]:
    """Import the package, and compare the checksums of the weights with those that their names promise.

    A file of another checksum is held against first numbers of the published one: it may be made from a package.
    """
    try:
        version = package_version()
        import_torchvision()
        importlib.import_module("lpips")
    except CapabilityError:
        checks = [Check(GROUP, "LPIPS package", "missing", "lpips is not installed", install_command())]
    except Exception as error:
        _, torchvision = fitting_torchvision() or ("", "torchvision")
        mend = f"pip install --force-reinstall --no-deps lpips {torchvision}"
        checks = [Check(GROUP, "LPIPS package", "broken", f"{type(error).__name__}: {error}", mend)]
    else:
        checks = [Check(GROUP, "LPIPS package", "ok", f"lpips {version}")]
    for net, backbone in BACKBONES.items():
        name = f"LPIPS weights, {net}"
        get = f"curl -L --create-dirs -o {hub_folder() / backbone.file_name} {backbone.address}"
        path = find_weights(net, None)
        if path is None:
            other = "--set metrics.lpips.weights=DIR names another folder"
            detail = f"{backbone.file_name} is not in {hub_folder()} ({other})"
            checks.append(Check(GROUP, name, "missing", detail, get))
        elif file_sha256(path).startswith(backbone.sha256_prefix):
            checks.append(Check(GROUP, name, "ok", str(path)))
        elif _holds_weights(path, net):
            detail = f"{path}: torchvision's weights by their first numbers, in a file of another checksum"
            checks.append(Check(GROUP, name, "ok", detail))
        else:
            checks.append(Check(GROUP, name, "broken", f"{path} is not the published file: its checksum differs", get))
    return checks


def check_vision_models() -> list[Check]:
    """Tell which of the packages that metrics go through are here; none of them is needed."""
    checks = []
    for metric in dict.fromkeys(METRICS.values()):
        names = ", ".join(name for name, each in METRICS.items() if each.package == metric.package)
        version = metric.version()
        if version is None:
            found = Check(GROUP, metric.package, "missing", f"for {names}", metric.install)
        else:
            found = Check(GROUP, metric.package, "ok", f"{metric.package} {version}, for {names}")
        checks.append(found)
    return list({check.name: check for check in checks}.values())


def _holds_weights(path: Path, net: str) -> bool:
    try:
        return unlike_published(read_weights(path, BACKBONES[net]).state, net) is None
    except UserInputError:
        return False
