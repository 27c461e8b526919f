"""Writing OpenUSD: one prim ParticleField3DGaussianSplat, as text here, as .usdc and .usdz through usd-core.

Source: the schema of OpenUSD 26.03 (UsdVol).
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from splatwizard_core.api import UserInputError
from sw_interchange.bands import Array
from sw_interchange.options import Options
from sw_interchange.scene import GaussianScene, WriteReport, linear_scales, sigmoid
from sw_interchange.usd import check_usd_core

PRIM = "Splats"
MAX_TEXT = 200_000
"""Gaussians of a .usda: at degree 3 some 130 MB of text."""
_ROWS_AT_ONCE = 1 << 12


class UsdOptions(Options):
    """Options of OpenUSD.

    up_axis     of the stage: "Y", or "Z"
    """

    up_axis: str = "Y"
    choices = {"up_axis": ("Y", "Z")}


def write_usda(scene: GaussianScene, options: UsdOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene as text. Raises UserInputError for more than 200,000 Gaussians."""
    if scene.num_gaussians > MAX_TEXT:
        raise UserInputError(
            f"{scene.num_gaussians:,} Gaussians are too many for the text of a .usda, {MAX_TEXT:,} at most: write a "
            ".usdc"
        )
    low, high, columns = _columns(scene, options, report)
    marks = [f"        bool {key} = 1\n" for key, value in _marks(scene).items() if value]
    about = f" (\n    customData = {{\n{''.join(marks)}    }}\n)" if marks else ""
    parts = [
        f'#usda 1.0\n(\n    defaultPrim = "{PRIM}"\n    metersPerUnit = 1\n    upAxis = "{options.up_axis}"\n)\n\n'
        f'def ParticleField3DGaussianSplat "{PRIM}"{about}\n{{\n'
        f"    float3[] extent = [{_row(low)}, {_row(high)}]\n"
        f"    uniform int radiance:sphericalHarmonicsDegree = {scene.sh_degree}\n"
    ]
    for (kind, name), values in columns.items():
        more = f" (\n        elementSize = {(scene.sh_degree + 1) ** 2}\n    )" if name.startswith("radiance") else ""
        parts += [f"    {kind}[] {name} = [", *_rows(values), f"]{more}\n"]
    return [part.encode() for part in [*parts, "}\n"]]


def write_usdc(scene: GaussianScene, options: UsdOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene as crate. Raises CapabilityError without usd-core."""
    return _by_usd_core(scene, options, report, ".usdc")


def write_usdz(scene: GaussianScene, options: UsdOptions, report: WriteReport) -> list[bytes]:
    """Encode a scene as archive of a crate. Raises CapabilityError without usd-core."""
    return _by_usd_core(scene, options, report, ".usdz")


def _columns(
    scene: GaussianScene, options: UsdOptions, report: WriteReport
) -> tuple[Array, Array, dict[tuple[str, str], Array]]:
    """Lowest and highest corner [3], and (type, attribute) -> values, in the axes of the stage."""
    if options.up_axis == "Z":
        scene = scene.in_frame("RFU")
    scales = linear_scales(scene.log_scales, report)
    low, high = _extent(scene.means, scales, scene.quats)
    sh = np.concatenate([scene.sh_dc[:, None], scene.sh_rest], axis=1)
    return low, high, {
        ("point3f", "positions"): scene.means,
        ("quatf", "orientations"): scene.quats,
        ("float3", "scales"): scales,
        ("float", "opacities"): sigmoid(scene.opacity_logits)[:, None],
        ("float3", "radiance:sphericalHarmonicsCoefficients"): sh.reshape(-1, 3),
    }  # fmt: skip


def _marks(scene: GaussianScene) -> dict[str, bool]:
    return {"antialiased": scene.antialiased, "surfels": scene.kind == "2dgs"}


def _extent(means: Array, scales: Array, quats: Array) -> tuple[Array, Array]:
    """Corners [3] of the box around all ellipsoids of three standard deviations."""
    w, x, y, z = quats.T
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    half = np.stack([np.sqrt(sum((each * scales[:, i]) ** 2 for i, each in enumerate(row))) for row in rows], axis=1)
    return (means - 3 * half).min(0).astype(np.float32), (means + 3 * half).max(0).astype(np.float32)


def _row(values: Array) -> str:
    return "(" + ", ".join(f"{each:.9g}" for each in values.tolist()) + ")"


def _rows(values: Array) -> list[str]:
    """The text of [N,width] float32, every bit of it, in pieces."""
    width = values.shape[1]
    one = "%.9g" if width == 1 else "(" + ", ".join(["%.9g"] * width) + ")"
    found = []
    for at in range(0, len(values), _ROWS_AT_ONCE):
        block = values[at : at + _ROWS_AT_ONCE]
        found.append((", " if at else "") + ", ".join([one] * len(block)) % tuple(block.ravel().tolist()))
    return found


def _by_usd_core(scene: GaussianScene, options: UsdOptions, report: WriteReport, suffix: str) -> list[bytes]:
    check_usd_core()
    from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt

    low, high, columns = _columns(scene, options, report)
    with tempfile.TemporaryDirectory() as folder:
        crate = os.path.join(folder, "scene.usdc")
        stage = Usd.Stage.CreateNew(crate)
        UsdGeom.SetStageUpAxis(stage, options.up_axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1)
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, f"/{PRIM}")
        prim = splats.GetPrim()
        stage.SetDefaultPrim(prim)
        for key, value in _marks(scene).items():
            if value:
                prim.SetCustomDataByKey(key, True)
        prim.GetAttribute("extent").Set(Vt.Vec3fArray.FromNumpy(np.stack([low, high])))
        prim.GetAttribute("radiance:sphericalHarmonicsDegree").Set(scene.sh_degree)
        arrays: dict[str, Any] = {
            "point3f": Vt.Vec3fArray, "float3": Vt.Vec3fArray, "float": Vt.FloatArray, "quatf": Vt.QuatfArray,
        }  # fmt: skip
        for (kind, name), values in columns.items():
            values = values[:, [1, 2, 3, 0]] if kind == "quatf" else values[:, 0] if kind == "float" else values
            prim.GetAttribute(name).Set(arrays[kind].FromNumpy(np.ascontiguousarray(values)))
        prim.GetAttribute("radiance:sphericalHarmonicsCoefficients").SetMetadata(
            "elementSize", (scene.sh_degree + 1) ** 2
        )
        stage.GetRootLayer().Save()
        del splats, prim, stage
        if suffix == ".usdc":
            return [Path(crate).read_bytes()]
        archive = os.path.join(folder, "scene.usdz")
        with Sdf.ZipFileWriter.CreateNew(archive) as writer:
            writer.AddFile(crate, "scene.usdc")
        return [Path(archive).read_bytes()]
