"""Chapter 6: The files of each method."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from bitstream_page.anchor_files import cat, hac, hac_plus
from bitstream_page.container import container
from bitstream_page.entropy_models import ExactTables
from bitstream_page.fields import check
from bitstream_page.gaussian_files import (
    chimera,
    compact,
    exact_mode,
    gsc_quant,
    indexed,
    packed,
    ply,
    quantized,
    raht,
    tiles,
    vectree,
)
from bitstream_page.splat_files import wisp


def decode(data: bytes, unzstd: Callable[[bytes], bytes], tables: ExactTables) -> dict[str, np.ndarray]:
    """The parameters of the model in a file, f32."""
    header, sections = container(data)
    check(header["method_version"] == 1, "layout version")
    static = header["static"]
    if header["method"] == "hac":
        return hac(static, sections, tables)
    if header["method"] == "hac-plus":
        return hac_plus(static, sections, tables)
    if header["method"] == "cat-3dgs":
        return cat(static, sections, tables)
    if header["method"] == "wisp":
        return wisp(static, sections, tables)
    if header["method"] == "3dgs":
        if static.get("codec") == "gaussians-tiles":
            return tiles(static, sections)
        check(static["mode"] in ("exact", "quantized"), "mode")
        return exact_mode(static, sections) if static["mode"] == "exact" else quantized(static, sections)
    if header["method"] == "chimerags":
        return chimera(static, sections, unzstd)
    if header["method"] == "compact3dgs":
        return compact(static, sections, unzstd)
    known = (
        "pruned-3dgs", "trimming-the-fat", "pup-3dgs", "speedy-splat", "lightgaussian", "c3dgs", "mesongs",
        "2dgs", "flat-3dgs", "trim-3dgs", "trim-2dgs", "trim-2dgs-scratch", "gsc-quant",
    )  # fmt: skip
    check(header["method"] in known, "method")
    if static["codec"] == "gaussians-indexed":
        return indexed(static, sections, unzstd)
    if static["codec"] == "raht":
        return raht(static, sections, unzstd)
    if static["codec"] == "gsc-quant":
        return gsc_quant(static, sections)
    if static["codec"] == "vectree":
        return vectree(static, sections, unzstd)
    if static["codec"] == "gaussians-ply":
        return ply(static, sections["ply"])
    if static["codec"] == "gaussians-zstd":
        return packed(static, sections, unzstd)
    check(static["codec"] in ("gaussians-exact", "gaussians-quantized"), "codec")
    return exact_mode(static, sections) if static["codec"] == "gaussians-exact" else quantized(static, sections)
