"""A scene: its views, their split, start points, and the scale that learning rates and thresholds use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatwizard_core.scene.camera import Camera


@dataclass(eq=False)
class View:
    """One photograph: a camera, a name, and a picture that is decoded on first use and kept as uint8.

    camera      geometry, at the resolution of the picture
    name        file name relative to the picture folder, unique in the scene
    load        () -> uint8 array [H,W,3] or [H,W,4] (straight alpha) at the camera's size
    load_mask   () -> bool array [H,W] at the camera's size; None if there is no mask
    """

    camera: Camera
    name: str
    load: Callable[[], np.ndarray] | None = None
    load_mask: Callable[[], np.ndarray] | None = None
    _resident: Tensor | None = field(default=None, init=False, repr=False)

    @cached_property
    def pixels(self) -> Tensor:
        """uint8 [3,H,W] or [4,H,W] (RGBA, straight alpha), host memory, decoded once."""
        return self.decoded()

    def decoded(self) -> Tensor:
        """Return `pixels`, decoded anew; before Python 3.12 a cached property lets one thread at a time in."""
        if self.load is None:
            raise ValueError(f"view '{self.name}' has no picture")
        return torch.from_numpy(np.array(self.load().transpose(2, 0, 1), order="C"))  # a copy: what Pillow has is fixed

    @cached_property
    def mask(self) -> Tensor | None:
        """bool [H,W] or None."""
        return None if self.load_mask is None else torch.from_numpy(self.load_mask()).bool()

    def image(self, background: Tensor | None = None, device: torch.device | str = "cpu") -> Tensor:
        """float32 [3,H,W] in 0..1 on `device`; an RGBA picture is composited on `background` [3] (None: black)."""
        device = torch.device(device)
        kept = self.pixels if self._resident is None or device.type == "cpu" else self._resident
        pixels = kept.to(device)
        if pixels.shape[0] == 3:
            if pixels.is_cuda:  # in one launch; on a CPU two passes are faster
                return torch.div(pixels, 255, out=torch.empty(pixels.shape, device=pixels.device))
            return pixels.float().div_(255)
        color, alpha = torch.split(pixels / 255, 3)
        return color * alpha if background is None else torch.lerp(background.to(device)[:, None, None], color, alpha)

    def keep_on(self, device: torch.device | str) -> None:
        """Keep a copy of `pixels` in a GPU's memory, so that `image` need not send it each time; "cpu" drops it."""
        self._resident = None if torch.device(device).type == "cpu" else self.pixels.to(device)

    @property
    def kept_on(self) -> torch.device:
        """Device that `image` takes the picture from: a GPU after `keep_on`, else the host."""
        return torch.device("cpu") if self._resident is None else self._resident.device


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Start points: xyz [P,3] float32 world units, rgb [P,3] float32 in 0..1 (None: unknown)."""

    xyz: Tensor
    rgb: Tensor | None = None

    def __len__(self) -> int:
        return self.xyz.shape[0]

    def finite(self) -> PointCloud:
        """The points whose position and colour are finite; itself if all are."""
        kept = torch.isfinite(self.xyz).all(dim=1)
        if self.rgb is not None:
            kept &= torch.isfinite(self.rgb).all(dim=1)
        return self if kept.all() else PointCloud(self.xyz[kept], None if self.rgb is None else self.rgb[kept])


@dataclass(frozen=True)
class Protocol:
    """Choices that must be equal for two results to be comparable; the id stands in every record.

    dataset     name of the family, or of a data set of the user's own
    images      picture folder
    resolution  the rule of specs: -1, 1, 2, 4, 8 or a width
    split       "every<n>", "lod:<k>", "file", "all", or "names-<hash>" of lists of names
    points      "train": start points that only held-out views saw are gone, "all": they are not; "": no matter
    background  "black" or "white"
    principal_point "center" or "file" (COLMAP's own)
    quantize8   renders are rounded to 8 bit before metrics
    masked      pictures were cut out by alpha or mask, beyond what the layout always does
    composite8  pictures with alpha were composited in 8 bit with truncation
    turned      pictures were turned by EXIF because the user said so (`exif_turn`), not their size
    name        "survey" or "inria" where the above is that protocol's for a published scene, else "custom"; not in ids
    """

    dataset: str
    images: str = "images"
    resolution: int = -1
    split: str = "every8"
    background: str = "black"
    principal_point: str = "center"
    quantize8: bool = True
    masked: bool = False
    composite8: bool = False
    turned: bool = False
    points: str = ""
    name: str = "custom"

    @property
    def id(self) -> str:
        """One line that names the protocol, stable across machines."""
        parts = [
            self.dataset, self.images, f"r{self.resolution}", self.split, self.background,
            f"pp-{self.principal_point}", "q8" if self.quantize8 else "float",
        ]  # fmt: skip
        more = {n: getattr(self, n) for n in ("masked", "composite8", "turned")} | {f"pts-{self.points}": self.points}
        return "/".join(parts + [name for name, holds in more.items() if holds])


@dataclass(eq=False)
class Scene:
    """A scene, and all that a method may know of it.

    name        last part of its path
    train, test views, disjoint unless the split is "all"
    points      start points (SfM, or random for Blender scenes); None if there are none
    protocol    how pictures were chosen, resized and split
    ground_truth    geometry that the scene brings, by name: "points" [P,3], "normals" [P,3]; "distance": points [n,3]
                    -> [n] to the surface; "depth", "normal_maps": view name -> [1,H,W], [3,H,W] (world); "world_mats"
                    and "scale_mats" [n,4,4] float64, n views by name (their product projects the scene's units to
                    pixels, scale_mats[0] takes them to millimetres); often empty
    warnings    one-line facts the user should see (dropped points, off-centre principal point)
    origin      where the scene's origin lies in the world of its files: cameras and points of a georeferenced scene
                are moved, in double precision, since float32 has steps of half a metre there; 0 for most scenes
    """

    name: str
    train: list[View]
    test: list[View]
    points: PointCloud | None
    protocol: Protocol
    path: str | None = None
    ground_truth: dict[str, Any] = field(default_factory=dict)
    warnings: list[str] = field(default_factory=list)
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def background(self) -> Tensor:
        """[3] float32, the fixed background of evaluation."""
        return torch.ones(3) if self.protocol.background == "white" else torch.zeros(3)

    @cached_property
    def radius(self) -> float:
        """Largest distance of a training camera from their mean; 0.0 where it is but rounding of float32 poses."""
        centers = torch.stack([v.camera.center.double().cpu() for v in self.train])
        radius = (centers - centers.mean(0)).norm(dim=1).max().item()
        return radius if radius > 1e-6 * (1 + centers.norm(dim=1).max().item()) else 0.0

    @cached_property
    def extent(self) -> float:
        """E = 1.1 x `radius`; 1.0 where all training cameras stand at one place."""
        return 1.1 * self.radius or 1.0
