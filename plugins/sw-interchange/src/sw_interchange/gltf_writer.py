"""Writing binary glTF with KHR_gaussian_splatting (ratified in June 2026), float32 throughout.

Source: the text of the extension in KhronosGroup/glTF, and of the proposal KHR_gaussian_splatting_compression_spz_2.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from splatwizard_core.api import SH_C0, UserInputError
from sw_interchange.bands import Array
from sw_interchange.options import Options
from sw_interchange.scene import GaussianScene, Limits, ReadReport, WriteReport, linear_scales, sigmoid
from sw_interchange.source import Source
from sw_interchange.spz import SpzOptions, read_spz, write_spz

EXTENSION = "KHR_gaussian_splatting"
SPZ = "KHR_gaussian_splatting_compression_spz_2"
"""A proposal of 2025, read by Cesium and Babylon.js: all values of a primitive are one .spz of version 2."""
FLOAT, UBYTE = 5126, 5121
MAX_FILE = (1 << 32) - 1


class GltfOptions(Options):
    """Options of `.glb`.

    color_0     with colours for viewers that know no splats and draw points
    compression "spz_2": as .spz of version 2, an experiment, since the extension for it is a proposal
    """

    color_0: bool = True
    compression: str | None = None
    choices = {"color_0": (True, False), "compression": (None, "spz_2")}


def write_gltf(scene: GaussianScene, options: GltfOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene in LUF as .glb. Raises UserInputError for one of 4 GiB and more."""
    if options.compression is not None:
        return _with_spz(scene, report)
    columns = _columns(scene, linear_scales(scene.log_scales, report), color_0=options.color_0)
    accessors, views, attributes, blob = [], [], {}, []
    at = 0
    for name, values in columns.items():
        attributes[name] = len(accessors)
        raw = values.tobytes()
        is_bytes = values.dtype == np.uint8
        accessor: dict[str, Any] = {
            "bufferView": len(views), "componentType": UBYTE if is_bytes else FLOAT, "count": scene.num_gaussians,
            "type": "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}",
        }  # fmt: skip
        if is_bytes:
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": values.min(0).tolist(), "max": values.max(0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(raw)})
        at += len(raw)  # all rows are multiples of four bytes
        blob.append(raw)
    return _file(_document(accessors, views, attributes, at), blob)


def _file(document: dict[str, Any], blob: list[bytes]) -> list[bytes]:
    at = sum(map(len, blob))
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    size = 12 + 8 + len(text) + 8 + at
    if size > MAX_FILE:
        raise UserInputError(f"these Gaussians make a .glb of {size:,} bytes: it holds less than 4 GiB")
    head = struct.pack("<4sII", b"glTF", 2, size) + struct.pack("<I4s", len(text), b"JSON") + text
    return [head + struct.pack("<I4s", at, b"BIN\0"), *blob]


def _with_spz(scene: GaussianScene, report: WriteReport) -> list[bytes]:
    """A file whose accessors tell types and numbers, and whose values are one .spz."""
    options = SpzOptions(version=2)
    packed = b"".join(write_spz(scene.in_frame("RDF"), options, report))
    places = ReadReport("spz")
    kept = read_spz(Source(packed, "spz"), Limits(), places).in_frame("LUF").means  # bounds are of what is decoded
    accessors: list[dict[str, Any]] = []
    attributes: dict[str, int] = {}
    for name, values in _columns(scene.select(slice(0, 1)), np.zeros((1, 3), np.float32), color_0=False).items():
        attributes[name] = len(accessors)
        kind = "SCALAR" if values.ndim == 1 else f"VEC{values.shape[1]}"
        accessors.append({"componentType": FLOAT, "count": scene.num_gaussians, "type": kind})
    accessors[attributes["POSITION"]] |= {"min": kept.min(0).tolist(), "max": kept.max(0).tolist()}
    padded = packed + bytes(-len(packed) % 4)
    document = _document(accessors, [{"buffer": 0, "byteLength": len(packed)}], attributes, len(padded))
    document["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = {SPZ: {"bufferView": 0}}
    document["extensionsUsed"] = document["extensionsRequired"] = [EXTENSION, SPZ]
    return _file(document, [padded])


def _columns(scene: GaussianScene, scales: Array, *, color_0: bool) -> dict[str, Any]:
    alphas = sigmoid(scene.opacity_logits)
    found: dict[str, Any] = {
        "POSITION": scene.means,
        f"{EXTENSION}:ROTATION": np.ascontiguousarray(scene.quats[:, [1, 2, 3, 0]]),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": alphas,
        f"{EXTENSION}:SH_DEGREE_0_COEF_0": scene.sh_dc,
    }
    at = 0
    for degree in range(1, scene.sh_degree + 1):
        for i in range(2 * degree + 1):
            found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = np.ascontiguousarray(scene.sh_rest[:, at])
            at += 1
    if color_0:
        colours = np.concatenate([_linear(np.clip(0.5 + SH_C0 * scene.sh_dc, 0, 1)), alphas[:, None]], axis=1)
        found["COLOR_0"] = np.rint(255 * colours).astype(np.uint8)
    return found


def _linear(colours: Array) -> Array:
    """Light of sRGB values 0..1: COLOR_0 is linear in glTF, whatever the splats are."""
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def _document(accessors: list[Any], views: list[Any], attributes: dict[str, int], size: int) -> dict[str, Any]:
    extension = {
        "kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }  # fmt: skip
    primitive = {"attributes": attributes, "mode": 0, "extensions": {EXTENSION: extension}}
    return {
        "asset": {"version": "2.0", "generator": "Splatwizard"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
