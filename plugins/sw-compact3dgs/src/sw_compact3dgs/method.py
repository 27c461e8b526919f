"""Compact3DGS as a method: its model of a scene, its training stage, its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from sw_gaussians.sized import fill, hold_size
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.api import ConfigError, Method, SceneError
from sw_compact3dgs import file
from sw_compact3dgs.colors import ColorField
from sw_compact3dgs.config import Compact3DGSConfig
from sw_compact3dgs.model import CompactGaussians
from sw_compact3dgs.presets import BY_DATASET, PRESETS, RATES
from sw_compact3dgs.stage import Compact3DGSStage

if TYPE_CHECKING:
    import torch

    from splatwizard_core.api import ContainerReader, ContainerWriter, Scene, SplatModel, Stage


class Compact3DGS(Method):
    """Lee, Rho, Sun, Ko, Park: Compact 3D Gaussian Representation for Radiance Field, CVPR 2024 (arXiv 2311.13681).

    1. Gaussians are trained as in 3DGS, each with a learned mask on its volume and opacity, which takes it out
    2. Colours come of a hash grid and a network that sees the view direction
    3. In the last steps scales and rotations are sums of codebook entries, whose indices the file has
    4. Post-processing: 8 bits for opacity and grid, Huffman codes
    """

    name: ClassVar[str] = "compact3dgs"
    version: ClassVar[int] = 1
    Config = Compact3DGSConfig
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = PRESETS
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = BY_DATASET
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = RATES
    DEFAULT_RATE: ClassVar[str] = "r5"

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Make a Gaussian for each start point of the scene, and a colour field at random."""
        if scene.points is None or len(scene.points) == 0:
            raise SceneError(
                f"scene '{scene.name}' has no start points: Compact3DGS needs SfM points or random ones",
                path=scene.path,
            )
        c: Compact3DGSConfig = self.config
        values = c.density.load(self.plugins).start_values()
        start = gaussians_from_points(scene.points, max_sh_degree=0, **values)
        try:
            color = ColorField(
                **c.grid.sizes, hidden=c.network.hidden, generator=generator,
            )  # fmt: skip
        except ValueError as error:
            raise ConfigError(f"grid: {error}: lower grid.growth or grid.levels", key="grid.growth") from error
        tensors = (start.means, start.sh_dc, start.sh_rest, start.opacity_logits, start.log_scales, start.quats)
        return CompactGaussians(
            *tensors, color=color, quantizer=self.plugins.quantizers.load("ste-mask")(c.mask.threshold),
            init=c.mask.init, size=c.rvq.size, stages=c.rvq.stages,
        )  # fmt: skip

    def stages(self) -> Sequence[Stage]:
        """Raise ConfigError for an entropy coder that is not there: now, and not when all is trained."""
        coder, known = self.config.codec.settings.coder, self.plugins.entropy_coders.names
        if coder not in known:
            raise ConfigError(
                f"no entropy coder is called '{coder}'; installed: {', '.join(known)}", key="codec.settings.coder"
            )
        config: Compact3DGSConfig = self.config
        grid = ColorField.numbers(**config.grid.sizes)
        hold_size(config.size, grid // 8, f"the {grid:,} numbers of its grid (grid.log2_size, grid.halvings)")
        control, pictures = config.density.load(self.plugins), config.pictures.load(self.plugins)
        return [Compact3DGSStage(config, control, pictures=pictures)]

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        if not isinstance(model, CompactGaussians):
            raise TypeError(f"compact3dgs encodes its own Gaussians, not a {type(model).__name__}")
        if self.config.size:
            fill(self, model, writer)
            return
        file.encode(model, writer, self.plugins, self.config.codec.settings)

    def decode(self, reader: ContainerReader) -> SplatModel:
        self.check_version(reader)
        return file.decode(reader, self.plugins)
