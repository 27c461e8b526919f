"""Formats: their names, suffixes and abilities, and which of them a file is."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sw_gaussians.ply_tables import BOM

from splatwizard_core.api import BitstreamError, UserInputError
from sw_interchange.source import Source
from sw_interchange.spz_packing import inflate

META = "meta.json"
INDEX = "lod-meta.json"
"""Name of the index of a streamed SOG."""
MAX_META = 1 << 20
"""Bytes of a meta.json."""


@dataclass(frozen=True)
class Format:
    """One format of files.

    suffix          of its files
    max_sh_degree   that it holds
    frame           axes that its writer takes
    reader, writer  "module:function" within this package; None: it is not read, or not written
    options         "module:class" of the writer's options
    """

    name: str
    suffix: str
    summary: str
    max_sh_degree: int = 3
    frame: str = "RDF"
    reader: str | None = None
    writer: str | None = None
    options: str = "options:Options"

    @property
    def writes(self) -> bool:
        """Whether such files are written."""
        return self.writer is not None

    def load(self, what: str) -> Callable[..., Any]:
        """The reader, the writer, or the class of options. Raises UserInputError where there is none."""
        target = getattr(self, what)
        if target is None:
            others = ", ".join(each.suffix for each in formats() if getattr(each, what))
            raise UserInputError(f"'{self.name}' ({self.suffix}) has no {what} here; there is one for {others}")
        module, _, attribute = target.partition(":")
        return getattr(importlib.import_module(f"sw_interchange.{module}"), attribute)  # type: ignore[no-any-return]


_FORMATS = (
    Format("ply", ".ply", "3DGS .ply in all its dialects, float32", 4, reader="ply:read_ply", writer="ply:write_ply"),
    Format("zipped-ply", ".zip", "a .ply in a ZIP archive, as Luma gives it", 4, reader="ply:read_zipped_ply"),
    Format("splat", ".splat", "32 bytes per Gaussian, no SH", 0, reader="splat:read_splat", writer="splat:write_splat",
           options="splat:SplatOptions"),
    Format("spz", ".spz", "quantised and compressed, SH included (Niantic)", 4, reader="spz:read_spz",
           writer="spz:write_spz", options="spz:SpzOptions"),
    Format("compressed-ply", ".compressed.ply", "quantised in chunks of 256 (PlayCanvas)", 3,
           reader="compressed_ply:read_compressed_ply", writer="compressed_ply:write_compressed_ply"),
    Format("sog", ".sog", "ZIP of lossless WebP images, the smallest here (PlayCanvas)", 3, reader="sog:read_sog",
           writer="sog_writer:write_sog", options="sog_writer:SogOptions"),
    Format("sog-folder", ".json", "the same images in a folder, beside their meta.json", 3, reader="sog:read_sog",
           writer="sog_writer:write_sog", options="sog_writer:SogOptions"),
    Format("streamed-sog", INDEX, "levels of detail in SOG folders, read by level (PlayCanvas)", 3,
           reader="streamed_sog:read_streamed_sog"),
    Format("lcc", ".lcc", "rows by cell and level, 32 bytes and 64 of SH each (XGRIDS)", 3, reader="lcc:read_lcc"),
    Format("rad", ".rad", "a tree of Gaussians in chunks, the coarsest first (Spark)", 3, reader="rad:read_rad"),
    Format("ksplat", ".ksplat", "buckets of quantised Gaussians (mkkellogg)", 2, reader="ksplat:read_ksplat"),
    Format("gltf", ".glb", "binary glTF with KHR_gaussian_splatting, float32", 3, frame="LUF",
           reader="gltf:read_gltf", writer="gltf_writer:write_gltf", options="gltf_writer:GltfOptions"),
    Format("usda", ".usda", "OpenUSD as text: a prim ParticleField3DGaussianSplat", 4, frame="RUB",
           reader="usd:read_usd", writer="usd_writer:write_usda", options="usd_writer:UsdOptions"),
    Format("usdc", ".usdc", "OpenUSD as crate, float32", 4, frame="RUB", reader="usd:read_usd",
           writer="usd_writer:write_usdc", options="usd_writer:UsdOptions"),
    Format("usdz", ".usdz", "OpenUSD as archive of a crate", 4, frame="RUB", reader="usd:read_usd",
           writer="usd_writer:write_usdz", options="usd_writer:UsdOptions"),
    Format("checkpoint", ".pt", "PyTorch checkpoints of gsplat, nerfstudio and 3DGS", 4,
           reader="checkpoint:read_checkpoint"),
)  # fmt: skip


def formats() -> list[Format]:
    """All formats."""
    return list(_FORMATS)


def format_named(name: str) -> Format:
    """The format of a name. Raises UserInputError."""
    for each in _FORMATS:
        if each.name == name:
            return each
    raise UserInputError(f"no format '{name}'; there are: {', '.join(each.name for each in _FORMATS)}")


def format_of_suffix(path: str | Path, what: str = "writer") -> Format:
    """The format with a reader or writer whose suffix a path has, the longest first. Raises UserInputError."""
    able = sorted((each for each in _FORMATS if getattr(each, what)), key=lambda each: -len(each.suffix))
    for each in able:
        if Path(path).name.lower().endswith(each.suffix):
            return each
    raise UserInputError(f"{path}: no format has this suffix; there are: {', '.join(e.suffix for e in able)}")


def detect(source: Source) -> Format:
    """The format of a file, by its content; where that says nothing, by its suffix. Raises BitstreamError."""
    head, name = source.head(1 << 12), source.name.lower()
    if name.endswith(".splat") and not len(source.data) % 32 and not _is_something_else(source):
        return format_named("splat")
    if head.removeprefix(BOM)[:4] in (b"ply\n", b"ply\r"):
        return format_named("compressed-ply" if b"packed_position" in head else "ply")
    if head[:4] == b"NGSP" or head[:2] == b"\x1f\x8b":
        return format_named("spz")
    if head[:4] == b"PK\x03\x04":
        return format_named(_kind_of_archive(source))
    if head[:4] == b"glTF":
        return format_named("gltf")
    if head[:7] == b"#usda 1" or head[:8] == b"PXR-USDC":
        return format_named("usda" if head[:1] == b"#" else "usdc")
    if head[:4] == b"RAD0":
        return format_named("rad")
    if name.endswith(".lcc"):
        return format_named("lcc")
    if head.lstrip()[:1] == b"{":
        if name.endswith(INDEX) or b'"lodLevels"' in head or b'"filenames"' in head:
            return format_named("streamed-sog")
        return format_named("gltf" if b'"asset"' in head and b'"means"' not in head else "sog")
    for suffix, found in ((".splat", "splat"), (".ksplat", "ksplat"), (".usda", "usda"), (".usdc", "usdc"),
                          (".usdz", "usdz")):  # fmt: skip
        if name.endswith(suffix):
            return format_named(found)
    raise BitstreamError(f"{source.name}: neither its first bytes nor its suffix is that of a format with Gaussians")


def _is_something_else(source: Source) -> bool:
    """Whether a file called .splat is another one. The coordinate it begins with may look like a brace or like gzip."""
    head = source.head(1 << 12)
    if head[:2] == b"\x1f\x8b":
        try:
            return inflate(head, 4, source.name) == b"NGSP"
        except BitstreamError:
            return False
    if head.lstrip()[:1] != b"{":
        return head[:4] in (b"ply\n", b"ply\r", b"NGSP", b"PK\x03\x04", b"glTF")
    try:
        json.loads(source.head(MAX_META + 1))
    except (ValueError, RecursionError):
        return False
    return True


def _kind_of_archive(source: Source) -> str:
    """SOG bundle, torch checkpoint, usdz or a .ply: all are ZIP archives."""
    from sw_interchange.archive import entries_of, is_one_ply

    names = [entry.filename for entry in entries_of(source)]
    if any(name.endswith("/data.pkl") for name in names):
        return "checkpoint"
    if any(name.lower().endswith((".usd", ".usda", ".usdc")) for name in names):
        return "usdz"
    if is_one_ply(names):
        return "zipped-ply"
    return "sog"
