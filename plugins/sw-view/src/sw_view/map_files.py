"""Maps of views as files: .npz for programs, 16-bit PNG and EXR for other tools, colours for people."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from splatwizard_core.api import Camera, UserInputError, replacing
from splatwizard_core.tooling import write_json
from sw_view.colors import depth_colors, normal_colors
from sw_view.exr import write_exr
from sw_view.maps import MapRequest, Maps
from sw_view.modes import DEPTHS, NORMALS, RENDERED, SURFACE

LARGEST = 65_535
"""Of a 16-bit PNG."""


@dataclass
class MapFiles:
    """Writes the maps of one view after the other below a folder.

    request     what the maps hold
    png         depth also as 16-bit PNG, with depth.json, written by `finish`
    exr         depth also as EXR
    scale       PNG value of a depth of 1; None: the largest depth of the set becomes 65535

    depth_MODE/NAME.npz (.png, .exr, .jpg), normals/NAME.npz (.png), alpha/NAME.png; `written`: folder -> file names.
    """

    folder: Path
    request: MapRequest
    png: bool = False
    exr: bool = False
    scale: float | None = None
    written: dict[str, list[str]] = field(default_factory=dict, init=False)
    _largest: dict[str, float] = field(default_factory=dict, init=False)

    def add(self, name: str, maps: Maps) -> None:
        """Write the maps of a view under a name without suffix.

        Raises UserInputError for a `scale` that a depth would not fit into 16 bits with.
        """
        alpha = _array(maps.alpha)
        for mode, tensor in maps.depths.items():
            self._add_depth(f"depth_{mode}", name, _array(tensor), alpha, maps.camera)
        if maps.normals is not None:
            normals, rotation = _array(maps.normals), _array(maps.camera.R)
            _save_npz(self._path("normals", f"{name}.npz"), normals=normals, **_camera_arrays(maps.camera))
            colors = normal_colors(normals, rotation, alpha)
            _save_picture(self._path("normals", f"{name}.png"), colors, "PNG")
        if self.request.alpha:
            _save_picture(self._path("alpha", f"{name}.png"), (255 * alpha).round().astype(np.uint8), "PNG")

    def _add_depth(
        self, kind: str, name: str, depth: NDArray[np.float32], alpha: NDArray[np.float32], camera: Camera
    ) -> None:
        _save_npz(self._path(kind, f"{name}.npz"), depth=depth, **_camera_arrays(camera))
        _save_picture(self._path(kind, f"{name}.jpg"), depth_colors(depth, alpha), "JPEG")
        if self.exr:
            write_exr(self._path(kind, f"{name}.exr"), depth)
        largest = float(depth.max(initial=0))
        if self.scale is not None and round(largest * self.scale) > LARGEST:
            raise UserInputError(
                f"--depth-scale {self.scale:g}: a depth of {largest:.4g} ({kind} of {name}) does not fit into 16 bits: "
                f"give at most {LARGEST / largest:.6g}, or leave it out"
            )
        self._largest[kind] = max(largest, self._largest.get(kind, 0.0))

    def finish(self) -> None:
        """Write what depends on all views: the 16-bit PNGs, whose scale is one for the set, and the sidecars."""
        if self.png:
            for kind, largest in self._largest.items():
                self._write_pngs(kind, self.scale or (LARGEST / largest if largest > 0 else 1.0))
        if "normals" in self.written:
            write_json(self.folder / "normals" / "normals.json", self._normals_facts())

    def _write_pngs(self, kind: str, scale: float) -> None:
        folder = self.folder / kind
        for path in [folder / each for each in self.written[kind] if each.endswith(".npz")]:
            with np.load(path) as stored:  # kept there, not in memory, until the scale was known
                depth = stored["depth"].astype(np.float64)
            # A surface so near that it would round to 0 keeps the least value: 0 means none.
            values = np.where(depth > 0, (depth * scale).round().clip(1, LARGEST), 0).astype(np.uint16)
            _save_picture(self._path(kind, f"{path.stem}.png"), values, "PNG")
        mode = kind.removeprefix("depth_")
        facts = {
            "mode": mode,
            "meaning": DEPTHS[mode],
            "encoding": "16-bit grey, value = round(depth * scale); 0: no surface",
            "scale": scale,
            "unit": "1 / scene unit" if mode == "inverse" else "scene unit",
        }
        if mode == SURFACE:
            facts["depth_ratio"] = self.request.depth_ratio
        write_json(folder / "depth.json", facts)

    def _normals_facts(self) -> dict[str, Any]:
        source = self.request.normals
        assert source is not None
        return {
            "source": source,
            "meaning": NORMALS[source],
            **({} if source == RENDERED else {"depth_ratio": self.request.depth_ratio}),
            "npz": "float32 [3,H,W], world frame, unit length; 0: none",
            "png": "8-bit, round(255 (n + 1) / 2), camera frame with x right, y up, z towards the viewer; black: none, "
            "or alpha below 0.5. For people: compute from the .npz",
        }

    def _path(self, kind: str, file: str) -> Path:
        folder = self.folder / kind
        folder.mkdir(parents=True, exist_ok=True)
        self.written.setdefault(kind, []).append(file)
        return folder / file


def _array(tensor: Tensor) -> NDArray[np.float32]:
    found: NDArray[np.float32] = tensor.detach().float().cpu().numpy()
    return found


def _camera_arrays(camera: Camera) -> dict[str, NDArray[np.float32]]:
    """K [3,3] in pixels, R [3,3] and tau [3] from world to camera: with them a depth is a set of points."""
    return {"K": _array(camera.K), "R": _array(camera.R), "tau": _array(camera.tau)}


def _save_npz(path: Path, **arrays: NDArray[np.float32]) -> None:
    with replacing(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stub takes the arrays for its option


def _save_picture(path: Path, pixels: NDArray[Any], form: str) -> None:
    with replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, format=form, **({"quality": 95} if form == "JPEG" else {}))
