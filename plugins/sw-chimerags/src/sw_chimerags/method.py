"""ChimeraGS, the method of the Splatwizard paper: parts of several methods, asked for by name, in one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.older_keys import flattened
from sw_gaussians.quick import LONGER
from sw_gaussians.sized import fill

from splatwizard_core.api import ConfigError, Method, create_method
from sw_chimerags import file
from sw_chimerags.config import ChimeraConfig
from sw_chimerags.model import MaskedGaussians
from sw_chimerags.presets import PRESETS, RATES
from sw_chimerags.stage import MaskedDistillation
from sw_codecs.models.exchangeable import hold_part

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage

OLDER_STOP = 1_900
OLDER_QUICK: Mapping[str, Any] = {
    "prune.start": 500,
    "prune.interval": 500,
    **{f"base.{key}": value for key, value in LONGER.items()},
    "base.lr.max_steps": 2_500,
    "base.density.settings.stop": 1_500,
    "base.density.settings.grad_threshold": 3e-4,
}
"""Student of runs by the quick plan of 2,500 steps, whose removals ended at OLDER_STOP: they named the preset alone."""


class ChimeraGS(Method):
    """Splatwizard: A Benchmark Toolkit for 3D Gaussian Splatting Compression, section on ChimeraGS.

    1. TRAIN    the stages of another method, Speedy-Splat's by default, make a small student
    2. DISTILL  a frozen teacher, with pseudo views; a learned mask takes SH degree 3 from who does not need it
    3. ENCODE   both groups apart: vectors of colour by importance (LightGaussian's coder), all else in halves
    4. RENDER   plain Gaussians of degree 3, by the fastest forward rasterizer that is there
    """

    name: ClassVar[str] = "chimerags"
    version: ClassVar[int] = 1
    Config = ChimeraConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r2"

    def _student(self) -> Method:
        """The configured method of stage 1."""
        config: ChimeraConfig = self.config
        name = config.train.method
        if name == self.name:
            raise ConfigError("train.method is chimerags itself: name the method that makes the student", key="train")
        full = self.plugins.methods.load(name).Config.FULL_ITERATIONS
        values: dict[str, Any] = {"scale_schedule": True} if config.scale_schedule else {}
        if full == config.FULL_ITERATIONS:
            values["iterations"] = config.iterations
        elif config.scale_schedule:
            values["iterations"] = max(1, round(full * config.schedule_scale))
        if name == "speedy-splat":
            values |= {f"prune.{key}": getattr(config.train, key) for key in ("soft", "hard", "stop")}
        values |= config.student
        preset = str(values.pop("preset", "paper"))
        if preset == "quick" and name == "speedy-splat" and config.train.stop == OLDER_STOP:
            values = {**OLDER_QUICK, **flattened(values)}
        return create_method(self.plugins, name, values, preset=preset)

    def borrows(self) -> Sequence[Method]:
        return [self._student()]

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        return self._student().create_model(scene, generator)

    def stages(self) -> Sequence[Stage]:
        # Now, and not when all is trained.
        self.config.codec.provider(self.plugins, "codec.name")
        if self.config.arrays != file.USUAL:
            hold_part(self.plugins.array_coders, self.config.arrays, "arrays", file.codes_halves)
        quantizer = self.plugins.quantizers.load("ste-mask")(self.config.mask.threshold)
        pruner = self.config.score.load(self.plugins, "score.pruner")  # how well the file keeps a Gaussian
        return [*self._student().stages(), MaskedDistillation(self.config, quantizer, pruner)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, MaskedGaussians):
            raise TypeError(f"chimerags encodes what it has distilled, not a {type(model).__name__}")
        if self.config.size:
            fill(self, model, writer)
            return
        codec = self.config.codec
        groups = {"sh2": codec.sh2, "sh3": codec.sh3}
        file.encode(
            model, writer, self.plugins, coder=codec.name, steps=self.config.steps, xyz=self.config.xyz,
            settings={group: {**codec.settings, **own} for group, own in groups.items()}, arrays=self.config.arrays,
        )  # fmt: skip
        if self.config.prefer:
            writer.raster["prefer"] = list(self.config.prefer)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return file.decode(reader, self.plugins)
