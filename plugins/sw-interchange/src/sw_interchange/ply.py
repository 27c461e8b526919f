"""The .ply of 3DGS, through the one reader that this project has."""

from __future__ import annotations

import numpy as np
from sw_gaussians.ply_gaussians import MIP_COMMENT, file_parts, parse_gaussians

from sw_interchange.options import Options
from sw_interchange.scene import FLAT, GaussianScene, Limits, ReadReport, WriteReport
from sw_interchange.source import Source


def read_ply(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a plain .ply of any dialect. Raises BitstreamError, SceneError."""
    found = parse_gaussians(source.data, str(source.path or source.name), max_gaussians=limits.max_gaussians)
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


def write_ply(scene: GaussianScene, options: Options, report: WriteReport) -> list[bytes]:
    """Encode a scene: every bit, and the comment that says how it was trained."""
    scales = scene.log_scales[:, :2] if scene.kind == "2dgs" else scene.log_scales
    comments = [MIP_COMMENT] if scene.antialiased else []
    values = (scene.means, scene.sh_dc, scene.sh_rest, scene.opacity_logits, scales, scene.quats)
    return [bytes(part) for part in file_parts(*values, comments=comments)]
