"""The .splat format: 32 bytes per Gaussian and no header, colours of SH band 0 alone.

Source: the public description of antimatter15/splat.
"""

from __future__ import annotations

import numpy as np

from splatwizard_core.api import SH_C0, BitstreamError
from sw_interchange.options import Options
from sw_interchange.scene import (
    FLAT,
    GaussianScene,
    Limits,
    ReadReport,
    WriteReport,
    decoded_bytes,
    linear_scales,
    logit_of_byte,
    normalised,
    sigmoid,
)
from sw_interchange.source import Source

ROW = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


class SplatOptions(Options):
    """Options of `.splat`.

    order   "importance": the largest and most opaque first, so that a part of the file shows something; or "given"
    """

    order: str = "importance"
    choices = {"order": ("importance", "given")}


def read_splat(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a file. Raises BitstreamError."""
    data = source.data
    if len(data) == 0 or len(data) % ROW.itemsize:
        raise BitstreamError(f"{source.name}: {len(data):,} bytes are no .splat: that has 32 for each Gaussian")
    count = len(data) // ROW.itemsize
    limits.check(count, decoded_bytes(count, 0), len(data), source.name)
    rows = np.frombuffer(data, ROW)
    scales = rows["scales"]
    bad = ~((scales >= 0) & np.isfinite(scales)).all(1)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scales = np.where(scales > 0, np.log(scales), np.float32(FLAT))
    log_scales[bad] = np.nan
    rgba = rows["rgba"]
    return GaussianScene(
        means=np.ascontiguousarray(rows["means"]),
        log_scales=log_scales,
        quats=(rows["quats"].astype(np.float32) - 128) / 128,
        opacity_logits=logit_of_byte(rgba[:, 3]),
        sh_dc=((rgba[:, :3].astype(np.float32) / 255 - 0.5) / SH_C0).astype(np.float32),
        sh_rest=np.zeros((len(rows), 0, 3), np.float32),
    )


def write_splat(scene: GaussianScene, options: SplatOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene in RDF, rounding to the nearest code."""
    if options.order == "importance":
        size = scene.log_scales.sum(1, dtype=np.float64) + np.log(sigmoid(scene.opacity_logits) + 1e-30)
        scene = scene.select(np.argsort(-size, kind="stable"))
    rows = np.empty(scene.num_gaussians, ROW)
    colours = 0.5 + SH_C0 * scene.sh_dc
    report.count("sh_dc", (colours < 0) | (colours > 1))
    quats = normalised(scene.quats)[0]
    rows["means"] = scene.means
    rows["scales"] = linear_scales(scene.log_scales, report)
    rows["rgba"][:, :3] = np.rint(255 * np.clip(colours, 0, 1))
    rows["rgba"][:, 3] = np.rint(255 * sigmoid(scene.opacity_logits))
    rows["quats"] = np.clip(np.rint(128 * quats + 128), 0, 255)
    return [rows.tobytes()]
