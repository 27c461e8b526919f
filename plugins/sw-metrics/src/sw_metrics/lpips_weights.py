"""The ImageNet backbones of LPIPS: where they are looked for, and how a file is read that may be anything.

The package `lpips` ships its learned linear heads, a few kilobytes, and would download the backbone, half a gigabyte.
No metric downloads; `sw data fetch lpips` does. A file is looked for under the name that torchvision's own download
gives it: in the folder that the user names, in $SPLATWIZARD_DATA/lpips/weights, where that command puts it, then in the
cache of torch.hub. The last eight digits of the name begin the file's SHA-256.
"""

from __future__ import annotations

import os
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from splatwizard_core.api import CapabilityError, UserInputError
from splatwizard_core.tooling import DATA_VARIABLE, file_sha256
from sw_metrics.backbones import BACKBONES, FOLDER, INTO, Backbone

MOST_BYTES = 1 << 30  # the largest published one, VGG16 with its classifier, has 553 MB


@dataclass(frozen=True)
class Weights:
    """A backbone that was read.

    state       key -> tensor, float32, as `Backbone.shapes` names them
    sha256      of the file
    published   the checksum is that of the file that torchvision publishes
    """

    state: dict[str, Tensor]
    file_name: str
    sha256: str
    published: bool


def hub_folder() -> Path:
    """Folder where torch.hub keeps what it has downloaded ($TORCH_HOME moves it)."""
    return Path(torch.hub.get_dir()) / "checkpoints"


def fetch_command() -> str:
    """Command that brings the backbones' files, as it works where it is read: it wants a folder for data."""
    return "`sw data fetch lpips`" if os.environ.get(DATA_VARIABLE) else f"`{DATA_VARIABLE}=DIR sw data fetch lpips`"


def find_weights(net: str, folder: Path | None) -> Path | None:
    """The file of a backbone ("vgg", "alex"): in `folder`, where it was fetched, or in torch.hub's cache; else None."""
    name, data = BACKBONES[net].file_name, os.environ.get(DATA_VARIABLE)
    fetched = [Path(data).expanduser() / FOLDER / INTO] if data else []
    places = ([] if folder is None else [folder]) + [*fetched, hub_folder()]
    return next((place / name for place in places if (place / name).is_file()), None)


def load_weights(net: str, folder: Path | None) -> Weights:
    """The backbone's weights from wherever they are.

    Raises CapabilityError that begins with "weights-missing" if there are none, UserInputError if the file in `folder`
    is not such weights (one in the cache of torch.hub counts as missing, since nobody asked for it).
    """
    path = find_weights(net, folder)
    backbone = BACKBONES[net]
    if path is None:
        raise CapabilityError(
            f"weights-missing: {backbone.file_name} is needed: {fetch_command()}, or get it from "
            f"{backbone.address} and name its folder with --set metrics.lpips.weights=DIR",
            missing=[backbone.file_name],
        )
    try:
        return read_weights(path, backbone)
    except UserInputError as error:
        if folder is not None and path.parent == folder:
            raise
        # It becomes a reason in the record, which names no folder of this machine.
        told = str(error).replace(str(path), f"{path.name} in the cache of torch.hub")
        raise CapabilityError(f"weights-missing: {told}", missing=[backbone.file_name]) from error


def read_weights(path: Path, backbone: Backbone) -> Weights:
    """Read and check one file. Raises UserInputError in one line for anything that is not this backbone's weights."""

    def refuse(reason: str, cause: Exception | None = None) -> UserInputError:
        error = UserInputError(
            f"{path} does not hold the weights of the backbone: {reason}; get it again from {backbone.address}"
        )
        error.__cause__ = cause
        return error

    size = path.stat().st_size
    if size > MOST_BYTES:
        raise refuse(f"it has {size:,} bytes, more than any such file")
    try:
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
            if unpacked > MOST_BYTES:
                raise refuse(f"it unpacks to {unpacked:,} bytes, more than any such file")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what is odd about the file is told below, in one line
            content = torch.load(path, map_location="cpu", weights_only=True)
    except UserInputError:
        raise
    # Bytes from a stranger: whatever the reader stumbles over, it is the file that is wrong.
    except Exception as error:
        text = " ".join(str(error).split()) or "it ends too early"
        raise refuse(f"{type(error).__name__}: {text:.120}", error) from error
    if not isinstance(content, Mapping):
        raise refuse(f"it holds a {type(content).__name__}, not a state dict")
    state: dict[str, Tensor] = {}
    for key, shape in backbone.shapes().items():
        tensor = content.get(key)
        if not isinstance(tensor, Tensor) or tensor.layout is not torch.strided or tensor.dtype != torch.float32:
            raise refuse(f"there is no float32 tensor '{key}' in it")
        if tuple(tensor.shape) != shape:
            raise refuse(f"'{key}' has shape {list(tensor.shape)}, not {list(shape)}")
        if not tensor.isfinite().all():
            raise refuse(f"'{key}' holds values that are not finite")
        state[key] = tensor.detach().contiguous()
    sha256 = file_sha256(path)
    return Weights(state, path.name, sha256, sha256.startswith(backbone.sha256_prefix))


def check_folder(folder: Path) -> None:
    """Refuse a folder for weights before any work. Raises UserInputError if it holds none, or a damaged file."""
    names = [backbone.file_name for backbone in BACKBONES.values()]
    if not folder.is_dir():
        raise UserInputError(
            f"metrics.lpips.weights: {folder}: there is no such folder; it is to hold {' or '.join(names)}"
        )
    found = [backbone for backbone in BACKBONES.values() if (folder / backbone.file_name).is_file()]
    if not found:
        raise UserInputError(f"metrics.lpips.weights: {folder} holds neither {' nor '.join(names)}")
    for backbone in found:
        read_weights(folder / backbone.file_name, backbone)
