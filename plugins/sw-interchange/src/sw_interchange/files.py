"""Reading and writing: the same few steps for every format."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from splatwizard_core.api import BitstreamError, LeftOut, SceneError, UserInputError, replacing
from sw_interchange.frames import axes_of, in_frame
from sw_interchange.known_formats import INDEX, META, Format, detect, format_named, format_of_suffix
from sw_interchange.scene import GaussianScene, Limits, ReadReport, WriteReport, cleaned
from sw_interchange.source import Source

NO_LIMITS = Limits()
FOLDER = "sog-folder"
KEEPS_SURFELS = ("ply", "sog", FOLDER, "usda", "usdc", "usdz")


def read(
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    limits: Limits = NO_LIMITS,
    frame: str | None = "RDF",
    strict: bool = False,
    spz_frame: str = "RUB",
    level: int = 0,
    sh_layout: str = "planar",
    undo_dataparser: str | os.PathLike[str] | None = None,
) -> GaussianScene:
    """Read a file; `scene.report` says what was found and mended.

    format          None: by its content, then by its suffix
    frame           axes of the result; None: as stored
    strict          raise where rows hold what is no number, instead of dropping them
    spz_frame       axes of .spz files that do not say: "RUB" as the format's text has it, "raw" for RDF
    level           of a scene of several levels of detail, 0 the finest
    sh_layout       of a .ply: "planar" as 3DGS has it, "interleaved" where red, green and blue of one coefficient stand
                    together, which nothing in a file tells
    undo_dataparser dataparser_transforms.json of nerfstudio: back to the axes and size of the photographs

    Raises BitstreamError if the file is damaged, SceneError if it cannot be read or holds no Gaussians, UserInputError.
    """
    where = Path(path)
    if where.is_dir():
        where = where / (INDEX if (where / INDEX).exists() else META)
    source = _checked(Source.open(where, spz_frame=spz_frame, level=level, sh_layout=sh_layout))
    scene = _decoded(source, format, limits, frame, strict)
    if undo_dataparser is None:
        return scene
    from sw_interchange.dataparser import undone

    return undone(scene, undo_dataparser)


def decode(
    data: bytes,
    format: str | None = None,
    *,
    name: str = "data",
    limits: Limits = NO_LIMITS,
    frame: str | None = "RDF",
    strict: bool = False,
    spz_frame: str = "RUB",
) -> GaussianScene:
    """Read the bytes of a file, as `read` does.

    name    for messages
    """
    return _decoded(_checked(Source(data, name, None, spz_frame)), format, limits, frame, strict)


def write(
    scene: GaussianScene,
    path: str | os.PathLike[str],
    *,
    format: str | None = None,
    before: Callable[[WriteReport], None] | None = None,
    **options: Any,
) -> WriteReport:
    """Write a file, complete or absent, in the axes of its format; the report says what it could not hold.

    format      None: by the suffix of `path`
    before      gets the report before anything is written
    options     of the format, see docs/formats.md

    Raises UserInputError for unknown formats and options, and for scenes that the format cannot hold at all.
    """
    chosen = format_of_suffix(path) if format is None else format_named(format)
    parts, report = _encoded(scene, chosen, options)
    if before is not None:
        before(report)
    if chosen.name == FOLDER:
        _unpack(parts[0], Path(path))
        return report
    with replacing(path) as temporary, open(temporary, "wb") as file:
        file.writelines(parts)
    return report


def encode(scene: GaussianScene, format: str, **options: Any) -> tuple[bytes, WriteReport]:
    """Encode a scene as `write` does, into bytes."""
    parts, report = _encoded(scene, format_named(format), options)
    return b"".join(parts), report


def _unpack(bundle: bytes, meta: Path) -> None:
    """Write the images of a bundle beside its description, which comes last: it names files that are there.

    The images of a `garden.json` are called `garden_*.webp`: several scenes may lie in one folder.
    """
    from sw_interchange.sog import is_plain

    prefix = "" if meta.name == META else f"{meta.name.removesuffix('.json')}_"
    with zipfile.ZipFile(io.BytesIO(bundle)) as archive:
        files = {prefix + name: archive.read(name) for name in archive.namelist() if name != META}
        if not all(is_plain(name) and name.isprintable() for name in files):
            raise UserInputError(f"{meta}: its images would have names that no .sog may have; write a {META}")
        text = json.loads(archive.read(META))
    for part in text.values():
        if isinstance(part, dict) and "files" in part:
            part["files"] = [prefix + name for name in part["files"]]
    for name, content in files.items():
        with replacing(meta.parent / name) as temporary:
            temporary.write_bytes(content)
    with replacing(meta) as temporary:
        # Not escaped: `bytes_with_named` looks for the names as they are.
        temporary.write_text(json.dumps(text, separators=(",", ":"), ensure_ascii=False), encoding="utf-8")


def _checked(source: Source) -> Source:
    if source.spz_frame != "raw":
        axes_of(source.spz_frame)
    if source.sh_layout not in ("planar", "interleaved"):
        raise UserInputError(f"sh_layout is '{source.sh_layout}'; it may be planar, interleaved")
    return source


def _decoded(source: Source, name: str | None, limits: Limits, frame: str | None, strict: bool) -> GaussianScene:
    if frame is not None:
        axes_of(frame)
    chosen = detect(source) if name is None else format_named(name)
    report = ReadReport(chosen.name, bytes=len(source.data))
    try:
        with np.errstate(all="ignore"):  # numbers of strangers overflow; `cleaned` sees what became of them
            scene = chosen.load("reader")(source, limits, report)
        scene = cleaned(scene, report, strict=strict, name=source.name)
    except MemoryError as error:
        raise BitstreamError(f"{source.name}: there is not enough memory for it") from error
    report.stored_frame = scene.frame
    if scene.num_gaussians == 0 and chosen.name != "ply":
        raise SceneError(f"{source.name}: holds no Gaussian")
    return scene if frame is None else in_frame(scene, frame, in_place=True)


def _encoded(scene: GaussianScene, chosen: Format, values: dict[str, Any]) -> tuple[list[bytes], WriteReport]:
    writer = chosen.load("writer")
    options = chosen.load("options")(**values)
    report = WriteReport(chosen.name, num_gaussians=scene.num_gaussians)
    if chosen.name != "ply":
        scene = _sound(scene, report)
    if scene.num_gaussians == 0 and chosen.name != "ply":
        raise UserInputError(f"a scene without Gaussians cannot be written as {chosen.name}")
    if scene.sh_degree > chosen.max_sh_degree:
        report.lost.append(f"SH degree {scene.sh_degree}: {chosen.max_sh_degree} at most")
        scene = scene.with_degree(chosen.max_sh_degree)
    if scene.antialiased and chosen.name in ("splat", "gltf"):
        report.lost.append("that it was trained with antialiasing")
    if scene.kind == "2dgs" and chosen.name not in KEEPS_SURFELS:
        report.lost.append("that these are surfels: they are flat ellipsoids")
    parts = writer(replace(in_frame(scene, chosen.frame), report=None), options, report)
    report.bytes = sum(len(part) for part in parts)
    return parts, report


def _sound(scene: GaussianScene, report: WriteReport) -> GaussianScene:
    """The scene without rows that are no numbers, which codes of integers cannot hold."""
    found = ReadReport("scene")
    kept = cleaned(scene, found, strict=False, name="the scene")
    if found.dropped:
        report.warnings.append(str(LeftOut(**found.left_out)))
        report.num_gaussians = kept.num_gaussians
    return kept
