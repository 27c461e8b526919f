"""The encoded file in the page: decoded there by the WebAssembly module of splatwizard-decoder, if it knows the file.

The page then holds the file as it is, and its decoder (about 100 kB of text, with exact tables 220), in place of
Gaussians packed for the GPU. Gaussians that depend on the eye are computed in the page for each place that it rests at.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from splatwizard_core.api import BitstreamError, Camera, ContainerReader, GaussianInputs, GaussianModel, SplatModel
from sw_view.packing import Packed, ranges_of

FOLDER = Path(str(files("sw_view"))) / "splatwizard-decoder"

METHODS = (
    "3dgs", "pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian", "2dgs", "flat-3dgs",
    "trim-3dgs", "trim-2dgs", "trim-2dgs-scratch", "c3dgs", "mesongs", "gsc-quant",
)  # fmt: skip
"""Methods whose files the decoder knows (source/decode.cpp), where they are in one of CODECS."""
CODECS_OF_CODEBOOKS = ("vectree", "gaussians-indexed", "raht", "gsc-quant")
"""Codecs that codebooks.wasm knows."""
CODECS = (
    "gaussians-exact", "gaussians-quantized", "gaussians-tiles", "gaussians-zstd", "gaussians-ply",
    *CODECS_OF_CODEBOOKS,
)  # fmt: skip
OF_ANCHORS = ("hac", "hac-plus", "cat-3dgs")
"""Methods whose files anchors.wasm knows, in mode `exact`."""
WITH_TABLES = ("wisp", *OF_ANCHORS)
"""Methods whose files are decoded by the exact tables (module.js)."""
FIELD = "compact3dgs"
"""The method whose colours a field has."""
LIVE = (FIELD, *OF_ANCHORS)
"""Methods whose Gaussians depend on where they are seen from: a page computes them wherever the eye rests."""
MODES = ("exact", "quantized")
"""Of `3dgs`, in place of a codec."""
PARTS = {
    "entropy": ("columns",), "positions": ("octree",), "means": ("float-delta",), "arrays": ("byte-planes", "deflate"),
    "vq": ("importance-vq",), "coder": ("huffman", "range", "rans"),
}  # fmt: skip
"""Header value -> what it may name: a file may ask for parts of others, which the decoder lacks."""
MOST_PLACES = 8
"""Cameras that the Gaussians of anchors are computed for while a page is written."""
BRIGHTEST = 2.0
"""Of the colours of a field, which end at no 1."""
VECTORS = ("vq", "sh2/vq/header", "sh3/vq/header")
"""Sections whose first byte is 2 if their parts are those of others."""


def covers(reader: ContainerReader) -> bool:
    """Return whether the WebAssembly decoder knows a file."""
    static = reader.static
    if reader.version != 1 or any(static.get(part, names[0]) not in names for part, names in PARTS.items()):
        return False
    if any(reader.section(name)[:1] != b"\1" for name in VECTORS if name in reader):
        return False
    if reader.method in OF_ANCHORS:
        return static.get("mode") == "exact"
    if reader.method in ("chimerags", FIELD, "wisp"):
        return True
    codec, mode = static.get("codec"), static.get("mode")
    return reader.method in METHODS and (
        codec in CODECS or (codec is None and reader.method == "3dgs" and mode in MODES)
    )


def module_of(reader: ContainerReader) -> str:
    """Return the name of the WebAssembly module that knows a file."""
    if reader.method in OF_ANCHORS:
        return "anchors.wasm"
    of_codebooks = reader.method in ("chimerags", FIELD) or reader.static.get("codec") in CODECS_OF_CODEBOOKS
    return "codebooks.wasm" if of_codebooks else "decoder.wasm"


def with_file(model: SplatModel, packed: Packed) -> Packed:
    """Return what a page holds of a model: the file that it was decoded from, if that is smaller; else `packed`."""
    found = _file_of(model)
    if found is None:
        return packed
    data, reader = found
    text, decoder = base64.b64encode(data).decode("ascii"), _decoder(reader)
    if len(text) + len(decoder) >= len(packed.text):
        return packed
    return Packed(text, {**packed.facts, "reach": packed.reach}, packed.means, packed.reach, decoder)


def with_live(model: SplatModel, path: Path, cameras: Sequence[Camera]) -> Packed | None:
    """Return what a page holds of Gaussians that depend on the eye: their file, of which it computes them at each rest.

    path        of the file that the model was decoded from
    cameras     places from which the ranges of the numbers of anchors are taken

    None for other models and for files that the decoder does not know. Raises SceneError if no camera sees any.
    """
    if isinstance(model, GaussianModel) or path.suffix != ".swz":
        return None
    reader = ContainerReader.open(path)
    if reader.method not in LIVE or not covers(reader):
        return None
    positions = getattr(model, model.ROWS[0]).detach()
    facts, reach = ranges_of(_seen(model, positions, cameras))
    facts |= {"count": int(reader.static["num_gaussians"]), "live": 1, "reach": reach}
    if reader.method in OF_ANCHORS:
        facts["anchors"] = len(positions)
    else:
        facts["colors"] = [0.0, BRIGHTEST / 2047]
    text = base64.b64encode(path.read_bytes()).decode("ascii")
    return Packed(text, facts, positions.float().cpu().numpy(), reach, _decoder(reader))


@torch.no_grad()
def _seen(model: Any, positions: Tensor, cameras: Sequence[Camera]) -> list[GaussianInputs]:
    """Return what some cameras see of anchors; other Gaussians change nothing but their colours."""
    spawn = getattr(model, "decode", None)
    if spawn is None:
        return [GaussianInputs(positions, model.opacities, scales=model.scales, quats=model.quats, colors=positions)]
    rows = torch.arange(len(positions), device=positions.device)
    return [spawn(camera.to(positions.device), rows) for camera in _some(cameras)]


def _some(cameras: Sequence[Camera]) -> list[Camera]:
    """Return the first cameras of a list and others, evenly spread."""
    step = -(-len(cameras) // MOST_PLACES)
    return list(cameras[::step])


def _file_of(model: SplatModel) -> tuple[bytes, ContainerReader] | None:
    """Return the .swz that a model was decoded from and its header, if the page can decode it to the same Gaussians."""
    origin = model.origin if isinstance(model, GaussianModel) else {}
    path = Path(str(origin.get("file", "")))
    if path.suffix != ".swz":
        return None
    try:
        reader = ContainerReader.open(path)
        data = path.read_bytes()
    except (BitstreamError, OSError):
        return None  # it went away since; the model is still here
    # A model that was moved to the place of a scene is not that of the file any more.
    moved = origin.get("world_origin") != reader.world_origin
    if not covers(reader):
        return None
    same = _count(reader) == model.num_rows + sum(origin.get("left_out", {}).values())
    return (data, reader) if same and not moved else None


def _count(reader: ContainerReader) -> Any:
    """Return how many Gaussians a file says that it has."""
    if reader.method == "wisp":
        return sum(rows for _, kind, rows in reader.static["order"] if kind == "base")
    return reader.static.get("num_gaussians")


def _decoder(reader: ContainerReader) -> str:
    """Return the elements of the page with the decoder of a file."""
    return _elements(module_of(reader), has_tables=reader.method in WITH_TABLES)


@cache
def _elements(module: str, *, has_tables: bool) -> str:
    """Return a script for a worker, a module, and tables, deflated."""
    parts = {"wasm": zlib.compress((FOLDER / module).read_bytes(), 9)}
    if has_tables:
        parts["tables"] = (FOLDER / "exact_tables.zlib").read_bytes()
    scripts = [path.read_text("utf-8") for path in (FOLDER / "module.js", FOLDER.parent / "page" / "coded.js")]
    texts = {"decoder": "".join(scripts).replace("\nexport ", "\n")}
    texts |= {name: base64.b64encode(part).decode("ascii") for name, part in parts.items()}
    return "".join(f'<script type="text/plain" id="{name}">{text}</script>\n' for name, text in texts.items())
