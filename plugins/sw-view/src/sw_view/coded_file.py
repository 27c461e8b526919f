"""The encoded file in the page: decoded there by the WebAssembly module of splatwizard-decoder, if it knows the file.

The page then holds the file as it is, and its decoder (about 50 kB of text), in place of Gaussians packed for the GPU.
"""

from __future__ import annotations

import base64
import zlib
from functools import cache
from importlib.resources import files
from pathlib import Path

from splatwizard_core.api import BitstreamError, ContainerReader, GaussianModel, SplatModel
from sw_view.packing import Packed

FOLDER = Path(str(files("sw_view"))) / "splatwizard-decoder"

METHODS = (
    "3dgs", "pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian", "2dgs", "flat-3dgs",
    "trim-3dgs", "trim-2dgs", "trim-2dgs-scratch", "c3dgs", "mesongs",
)  # fmt: skip
"""Methods whose files the decoder knows (source/decode.cpp), where they are in one of CODECS."""
CODECS = (
    "gaussians-exact", "gaussians-quantized", "gaussians-zstd", "gaussians-ply", "vectree", "gaussians-indexed", "raht",
)  # fmt: skip
MODES = ("exact", "quantized")
"""Of `3dgs`, in place of a codec."""
PARTS = {
    "entropy": ("columns",), "positions": ("octree",), "means": ("float-delta",), "arrays": ("byte-planes", "deflate"),
    "vq": ("importance-vq",),
}  # fmt: skip
"""Header value -> what it may name: a file may ask for parts of others, which the decoder lacks."""
VECTORS = ("vq", "sh2/vq/header", "sh3/vq/header")
"""Sections whose first byte is 2 if their parts are those of others."""


def covers(reader: ContainerReader) -> bool:
    """Return whether the WebAssembly decoder knows a file."""
    static = reader.static
    if reader.version != 1 or any(static.get(part, names[0]) not in names for part, names in PARTS.items()):
        return False
    if any(reader.section(name)[:1] != b"\1" for name in VECTORS if name in reader):
        return False
    if reader.method == "chimerags":
        return True
    codec, mode = static.get("codec"), static.get("mode")
    return reader.method in METHODS and (
        codec in CODECS or (codec is None and reader.method == "3dgs" and mode in MODES)
    )


def with_file(model: SplatModel, packed: Packed) -> Packed:
    """Return what a page holds of a model: the file that it was decoded from, if that is smaller; else `packed`."""
    data = _file_of(model)
    if data is None:
        return packed
    text, decoder = base64.b64encode(data).decode("ascii"), _decoder()
    if len(text) + len(decoder) >= len(packed.text):
        return packed
    return Packed(text, {**packed.facts, "reach": packed.reach}, packed.means, packed.reach, decoder)


def _file_of(model: SplatModel) -> bytes | None:
    """Return the .swz that a model was decoded from, if the page can decode it to the same Gaussians."""
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
    same = reader.static.get("num_gaussians") == model.num_rows + sum(origin.get("left_out", {}).values())
    return data if covers(reader) and same and not moved else None


@cache
def _decoder() -> str:
    """Return the elements of the page with the decoder: a script for a worker, and the module, deflated."""
    module = zlib.compress((FOLDER / "decoder.wasm").read_bytes(), 9)
    scripts = [path.read_text("utf-8") for path in (FOLDER / "module.js", FOLDER.parent / "page" / "coded.js")]
    script = "".join(scripts).replace("\nexport ", "\n")
    return (
        f'<script type="text/plain" id="decoder">{script}</script>\n'
        f'<script type="text/plain" id="wasm">{base64.b64encode(module).decode("ascii")}</script>\n'
    )
