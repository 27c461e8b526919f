"""Codec `gaussians-sized`: a trained scene in a file of a size, by its own training views."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import torch
from pydantic import Field
from sw_gaussians.byte_sizes import ByteSize
from sw_gaussians.choices import CodecChoice
from sw_gaussians.render_options import options_of
from sw_gaussians.surfels import refuse_surfels

from splatwizard_core.api import GaussianModel, Params, RasterOptions, parse_size
from splatwizard_core.tooling import NegotiatedRasterizer, say
from sw_compress.coders import PRECISE_FROM, Quantized
from sw_compress.cutting import SizeFilling
from sw_compress.filling import fill
from sw_compress.measuring import Errors
from sw_compress.pruning import Pruning
from sw_compress.quality import Pictures
from sw_compress.reducing import Reduction
from sw_compress.rows import IMPORTANCE
from sw_compress.search import Search, check_in_reach
from sw_compress.stages import Stages
from sw_compress.views import made_up_views, training_views

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, Method, PluginManager, Scene, SplatModel


class SizedSettings(Params):
    """The size."""

    size: ByteSize = Field("", description="bytes of the file, never more: 5MB; empty: as its usual steps come to")


class Sized:
    """Chooses number and precision of the Gaussians so that a file of `gaussians-quantized` fills a size.

    A file of it is one of that codec, and is read by it.
    """

    WRITES: ClassVar[str] = "gaussians-quantized"
    Settings: ClassVar[type[SizedSettings]] = SizedSettings

    def __init__(self, plugins: PluginManager, **settings: Any) -> None:
        """Raise UserInputError for what is no size."""
        self.plugins, self.settings = plugins, SizedSettings(**settings)
        self._size = parse_size(self.settings.size) if self.settings.size else None

    def chosen(
        self, model: GaussianModel, method: str, raster: Mapping[str, Any], scene: Scene | None
    ) -> tuple[GaussianModel, CodecChoice]:
        """Return the Gaussians that stay, and the codec with its steps.

        method      name of the one that the file is of
        raster      what the file asks of a renderer
        scene       that the model was trained on; None: cameras are made up

        Raises UserInputError for a size out of reach, and for surfels.
        """
        if self._size is None:
            return model, CodecChoice(name=self.WRITES)
        refuse_surfels(model, f"a size of {self.settings.size}")
        rasterizer = NegotiatedRasterizer(self.plugins, device=model.device, options=options_of(raster))
        origin, precise = None if scene is None else scene.origin, model.num_rows >= PRECISE_FROM
        coder = Quantized(self.plugins, raster, method, origin, precise)
        # A copy, since the search cuts it; gradients are what the significance of a Gaussian is made of.
        part = GaussianModel(**{name: getattr(model, name).detach() for name in model.RAW},
                             active_sh_degree=model.active_sh_degree).eval()  # fmt: skip
        part.requires_grad_(False)
        check_in_reach(coder, part, None, self._size)
        with torch.no_grad():
            seen = made_up_views(part, rasterizer, None) if scene is None else training_views(part, scene)
            judge = Pictures(part, seen.judge, rasterizer, RasterOptions(alpha=True))
        pruning = Pruning(part, seen.fit, rasterizer, keeps_unseen=scene is None)
        setattr(part, IMPORTANCE, pruning.importance)
        with torch.no_grad():
            errors = Errors(coder, part, judge)
        search = Search(coder, part, Reduction(part, pruning, judge), judge, errors)
        with tempfile.TemporaryDirectory(prefix="sw-compress-") as folder:
            filled = fill(search, self._size, Path(folder) / "scene.swz", Stages(), say)
        return filled.choice.model, coder.choice(filled.choice.allocation.levels)

    def fill(self, method: Method, model: SplatModel, writer: ContainerWriter) -> None:
        """Write a model by a method with a `size`; `sw_gaussians.sized.fill` says how."""
        vars(writer).update(vars(SizeFilling(method, model, writer).found()))

    def encode(self, model: GaussianModel, writer: ContainerWriter) -> None:
        model, codec = self.chosen(model, writer.method, writer.raster, None)
        codec.load(self.plugins).encode(model, writer)

    def decode(self, reader: ContainerReader) -> GaussianModel:
        return self.plugins.gaussian_codecs.load(self.WRITES)(self.plugins).decode(reader)
