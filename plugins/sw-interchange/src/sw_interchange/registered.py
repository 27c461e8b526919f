"""Importers and exporters as the registry wants them: (path) -> model, and (model, path)."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from sw_gaussians.render_options import lost_options

from splatwizard_core.api import GaussianModel, LeftOut, SceneError, SplatModel
from sw_interchange.bridge import from_gaussians, to_gaussians
from sw_interchange.files import read, write
from sw_interchange.scene import ReadReport, WriteReport

log = logging.getLogger(__name__)

Path = str | os.PathLike[str]


def _importer(name: str | None) -> Callable[[Path], GaussianModel]:
    def load(path: Path) -> GaussianModel:
        scene = read(path, format=name)
        if scene.sh_degree > 3:
            log.warning("%s: its SH degree is 4: the bands of degree 4 are left out", os.path.basename(path))
        model = to_gaussians(scene)
        assert scene.report is not None  # of whatever was read
        for line in notices(scene.report):
            log.warning("%s: %s", os.path.basename(path), line)
        told = {key: value for key, value in scene.report.as_dict().items() if key not in ("bytes", "num_gaussians")}
        left = {"left_out": told.pop("left_out")} if scene.report.dropped else {}
        told.pop("left_out", None)
        model.origin = {**told, "antialiased": scene.antialiased, **left, **model.origin}
        return model

    return load


def _exporter(name: str, **options: Any) -> Callable[[SplatModel, Path], None]:
    def save(model: SplatModel, path: Path) -> None:
        if not isinstance(model, GaussianModel):
            raise SceneError(
                f"this model cannot be written as {name}: its Gaussians depend on the camera", path=str(path)
            )
        found, told = from_gaussians(model), os.path.basename(path)
        origin, shift = model.world_origin, model.world_shift
        if shift is not None:
            found = replace(found, means=(found.means.astype(np.float64) + np.array(shift)).astype(np.float32))
            step = np.spacing(np.float32(np.abs(shift).max()))
            log.warning("%s: coordinates of the world have steps of %.2g in float32; a .ply holds doubles", told, step)
        elif origin is not None and any(origin):
            log.warning("%s: not kept: where its origin lies in the world (%s)", told, ", ".join(map(str, origin)))

        def tell(report: WriteReport) -> None:
            lost = [f"not kept: {what}" for what in [*report.lost, *lost_options(model)]]
            for line in [*lost, *report.notices()]:
                log.warning("%s: %s", told, line)

        write(found, path, format=name, before=tell, **options)

    return save


def notices(report: ReadReport) -> list[str]:
    """Lines that a user should see of what a reader found."""
    found = list(report.warnings)
    if report.dropped:
        found.append(str(LeftOut(**report.left_out)))
    return found


import_zipped_ply = _importer("zipped-ply")
import_splat, export_splat = _importer("splat"), _exporter("splat")
import_spz, export_spz, export_spz4 = _importer("spz"), _exporter("spz"), _exporter("spz", version=4)
import_sog, export_sog = _importer("sog"), _exporter("sog")
import_sog_folder, export_sog_folder = _importer("sog"), _exporter("sog-folder")
import_compressed_ply, export_compressed_ply = _importer("compressed-ply"), _exporter("compressed-ply")
import_streamed_sog = _importer("streamed-sog")
import_lcc = _importer("lcc")
import_rad = _importer("rad")
import_ksplat = _importer("ksplat")
import_gltf, export_gltf = _importer("gltf"), _exporter("gltf")
import_usd = _importer(None)
export_usda, export_usdc, export_usdz = _exporter("usda"), _exporter("usdc"), _exporter("usdz")
import_checkpoint = _importer("checkpoint")
