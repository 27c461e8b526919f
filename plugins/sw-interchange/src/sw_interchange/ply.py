"""The .ply of 3DGS, through the one reader that this project has."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from sw_gaussians.ply_gaussians import MIP_COMMENT, file_parts, parse_gaussians

from splatwizard_core.api import BitstreamError, beyond_limit
from sw_interchange.archive import entries_of, read_entry
from sw_interchange.options import Options
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, WriteReport
from sw_interchange.source import Source


def read_ply(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a plain .ply of any dialect. Raises BitstreamError, SceneError."""
    found = parse_gaussians(
        source.data, str(source.path or source.name), max_gaussians=limits.max_gaussians,
        interleaved=source.sh_layout == "interleaved",
    )  # fmt: skip
    n, flat = len(found.means), found.log_scales.shape[1] == 2
    report.ignored += list(found.ignored)
    report.warnings += list(found.notes)
    log_scales = found.log_scales
    if flat:
        log_scales = np.concatenate([log_scales, np.full((n, 1), FLAT, np.float32)], axis=1)
    return GaussianScene(
        found.means,
        log_scales,
        found.quats,
        found.opacity_logits,
        found.sh_dc,
        found.sh_rest,
        antialiased=found.antialiased,
        kind="2dgs" if flat else "default",
        meta={"comments": found.comments},
    )


def read_zipped_ply(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode the one .ply of an archive. Raises BitstreamError, SceneError."""
    (info,) = (each for each in entries_of(source) if each.filename.lower().endswith(".ply"))
    if info.flag_bits & 1:
        raise BitstreamError(f"{source.name}: '{info.filename}' in it is encrypted")
    reason = beyond_limit(info.file_size, len(source.data))
    if info.file_size > limits.max_output_bytes or reason is not None:
        raise BitstreamError(f"{source.name}: '{info.filename}' unpacks to {info.file_size:,} bytes: too many")
    inner = replace(source, data=read_entry(source, info), path=None, name=f"{source.name}/{info.filename}")
    if b"packed_position" in inner.head(1 << 12):
        from sw_interchange.compressed_ply import read_compressed_ply

        return read_compressed_ply(inner, limits, report)
    return read_ply(inner, limits, report)


def write_ply(scene: GaussianScene, options: Options, report: WriteReport) -> list[bytes]:
    """Encode a scene: every bit, and the comment that says how it was trained."""
    scales = scene.log_scales[:, :2] if scene.kind == "2dgs" else scene.log_scales
    comments = [MIP_COMMENT] if scene.antialiased else []
    values = (scene.means, scene.sh_dc, scene.sh_rest, scene.opacity_logits, scales, scene.quats)
    return [bytes(part) for part in file_parts(*values, comments=comments)]
