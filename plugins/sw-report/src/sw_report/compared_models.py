"""Two models of any files, drawn from the same cameras: how much what they show differs."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from sw_gaussians.picture_psnr import capped_psnr
from torch import Tensor

from splatwizard_core.api import Camera, GaussianModel, RasterOptions, SplatModel, UserInputError, placed_in, track
from splatwizard_core.tooling import (
    NegotiatedRasterizer,
    ResolvedConfig,
    Session,
    bytes_with_named,
    open_model,
    read_gaussians,
    render_options,
    render_view,
    suggested_rasterizers,
)
from sw_report.compared_metrics import PictureMetrics
from sw_report.path_flicker import PathFlicker
from sw_report.path_video import PathVideo

if TYPE_CHECKING:
    from splatwizard_core.api import Scene, View


@dataclass(frozen=True)
class OpenedFile:
    """A model of a file, and what draws it as the file asks."""

    path: Path
    kind: str
    model: SplatModel
    rasterizer: NegotiatedRasterizer
    options: RasterOptions

    def picture(self, camera: Camera) -> Tensor:
        """[3,H,W] in 0 .. 1."""
        found = render_view(self.model, camera.to(self.model.device), self.rasterizer, self.options)
        if isinstance(self.rasterizer, NegotiatedRasterizer):
            self.rasterizer.look(found)
        return found.image.clamp(0, 1)

    def facts(self) -> dict[str, Any]:
        """Name, format or method, bytes and counts."""
        degree = self.model.active_sh_degree if isinstance(self.model, GaussianModel) else None
        return {
            "file": str(self.path), "kind": self.kind, "bytes": bytes_with_named(self.path),
            "counts": self.model.counts(), "sh_degree": degree,
        }  # fmt: skip


def open_file(path: Path, session: Session, resolved: ResolvedConfig, scene: Scene | None) -> OpenedFile:
    """Open a file of any format or method, or the file of a run directory. Raises UserInputError, BitstreamError.

    scene   about whose origin and on whose background it is drawn; None: as it stands, on black
    """
    if path.is_dir():
        path = path / "scene.swz"
        if not path.is_file():
            raise UserInputError(f"{path.parent} is no finished run directory, it has no scene.swz: name a file")
    plugins = session.plugins
    importer = plugins.importers.of_suffix(path)
    if importer is not None:
        gaussians = read_gaussians(path, plugins)
        model: SplatModel = gaussians.to(session.device).eval().requires_grad_(False)
        kind, raster = importer, dict(gaussians.origin.get("raster", {}))
    else:
        model, reader = open_model(path, plugins, session.device)
        kind, raster = reader.method, reader.raster
    model.check_finite()
    if scene is not None:
        placed_in(model, scene, path.name)
    model.prepare()
    rasterizer = session.rasterizer(resolved, suggested_rasterizers(raster))
    background = torch.zeros(3) if scene is None else scene.background
    return OpenedFile(path, kind, model, rasterizer, render_options(raster, background.to(session.device)))


def compare_pictures(
    a: OpenedFile,
    b: OpenedFile,
    cameras: list[Camera],
    views: list[View] | None,
    *,
    is_path: bool = False,
    video: PathVideo | None = None,
    metrics: PictureMetrics | None = None,
) -> dict[str, Any]:
    """PSNR of B against A, mean and least over the cameras, dB; with `views` also of each against its pictures.

    views   whose cameras they are, with pictures, or None
    is_path the cameras are frames of a path with a fixed step: `path` tells of flicker and popping
    video   measures the path as a video
    metrics takes every pair of pictures besides
    """
    path = PathFlicker()
    between, to_truth = [], ([], [])  # type: tuple[list[float], tuple[list[float], list[float]]]
    with contextlib.ExitStack() as stack:
        bar = stack.enter_context(track("compare", total=len(cameras), unit="views"))
        frames = stack.enter_context(video) if video is not None else None
        for i, camera in enumerate(cameras):
            pictures = a.picture(camera), b.picture(camera)
            between.append(capped_psnr(*pictures))
            if metrics is not None:
                metrics.add(*pictures)
            if is_path:
                path.add(*pictures)
            if frames is not None:
                frames.add(*pictures)
            if views is not None:
                truth = views[i].image(a.options.background, a.model.device)
                for values, picture in zip(to_truth, pictures, strict=True):
                    values.append(capped_psnr(picture, truth))
            bar.advance()
        found: dict[str, Any] = {"views": len(cameras), "mean": _mean(between), "least": min(between)}
        if is_path:
            found["path"] = path.result()
        if frames is not None:
            found["path"]["video"] = frames.result()
    if views is not None:
        found |= {"a_to_pictures": _mean(to_truth[0]), "b_to_pictures": _mean(to_truth[1])}
    return found


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)
