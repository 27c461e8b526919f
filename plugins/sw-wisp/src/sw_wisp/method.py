"""Wisp as a method: explicit splats, trained with the bits of the file in the loss, in one file of integers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from splatwizard_core.api import BitstreamError, GaussianModel, Method, SceneError
from sw_wisp import file
from sw_wisp.config import WispConfig
from sw_wisp.model import WispModel
from sw_wisp.plain import gaussians_of
from sw_wisp.presets import BY_DATASET, PRESETS, RATES
from sw_wisp.stage import WispStage

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class SplatsOfFile(GaussianModel):
    """Decoded splats. Decoders agree on the integers of their file, not on the last bits of the floats."""

    def __init__(self, *raw: Any, reader: ContainerReader | None = None, **named: Any) -> None:
        super().__init__(*raw, **named)
        self._reader = reader  # None: a copy that somebody makes of some of them

    def parameter_hash(self) -> str:
        return super().parameter_hash() if self._reader is None else file.decode(self._reader).digest()


class Wisp(Method):
    """Explicit splats, each in a cell of an octree, its shape a log covariance, its view dependence twelve latents.

    1. START    from a trained 3DGS scene that has more splats than stay
    2. TRAIN    with noise in place of rounding and the bits of the file in the loss; a splat whose bits cost more than
                what the pictures lose by its removal goes
    3. ENCODE   residuals against what the decoder knows, by integer arithmetic
    4. DECODE   to a plain GaussianModel: no network runs when it is drawn
    """

    name: ClassVar[str] = "wisp"
    version: ClassVar[int] = 1
    Config = WispConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = BY_DATASET
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r3"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Raise SceneError: training starts from a trained scene, and there is no start from points."""
        raise SceneError(f"{self.name} starts from a trained 3dgs scene, not from points", path=scene.path)

    def stages(self) -> Sequence[Stage]:
        stage = WispStage(self.config)
        if self.config.size:
            lead, rate = self.plugins.tasks.load("lead-to-size"), self.config.rate_term
            first, last = (stage.step_of(step) for step in (rate.start + rate.ramp, self.config.phases.freeze))
            least = 13_353 if self.config.context.networks == "large" else 6_701  # bytes of the networks
            lead(self.config.size, self.name, first, last - 1, least=least).lead(stage)
        return [stage]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, WispModel):
            raise TypeError(f"wisp encodes its own splats, not a {type(model).__name__}")
        file.encode(model.coded(), writer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        decoded = file.decode(reader)
        try:
            found = gaussians_of(decoded)
        except ValueError as error:
            raise BitstreamError(f"{reader.name}: {error}", section="networks") from error
        return SplatsOfFile(**dict(found.named_parameters()), reader=reader)
