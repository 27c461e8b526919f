"""The model of HAC: coded anchors, and the grid and network of their rate model.

Source: HAC (arXiv 2403.14530), section 4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.lattice import TOP
from sw_anchors.rate_model import Context
from torch import Tensor, nn

from splatwizard_core.api import SceneError
from sw_codecs.context.two_layers import two_layers
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.rate_model import HACRateModel

if TYPE_CHECKING:
    from splatwizard_core.api import Scene
    from sw_hac.config import HACParams


class HACAnchors(CodedAnchors):
    """CodedAnchors whose attributes a hash grid and a network predict.

    grid        hash grid over the box of the anchors, signs
    mlp_grid    from its features to the outputs of `AnchorShape`
    units       [W] buffer: factors of these outputs
    """

    grid: MixedHashGrid
    mlp_grid: nn.Sequential
    units: Tensor

    def __init__(
        self,
        *tensors: Tensor,
        grid: MixedHashGrid,
        grid_hidden: int,
        in_steps: bool = False,
        further: int = 0,
        generator: torch.Generator,
        **kwargs: Any,
    ) -> None:
        """As CodedAnchors.

        grid_hidden width of the network behind it
        in_steps    the network gives means and deviations in base steps: scales are some hundredths, which one update
                    of a network that gives them as they are can overturn
        further     outputs of the network that follow those of `AnchorShape`, for a subclass
        """
        super().__init__(*tensors, generator=generator, **kwargs)
        widths = [*self.shape.outputs, further]
        self.grid = grid.to(self.features)
        self._places: tuple[Tensor, Tensor] | None = None
        self.mlp_grid = two_layers(grid.width, grid_hidden, sum(widths), generator).to(self.features)
        units = [step if in_steps else 1.0 for step in self.base_steps for _ in range(2)] + [1.0, 1.0]
        self.register_buffer("units", torch.tensor(units).repeat_interleave(torch.tensor(widths)).to(self.features))

    @classmethod
    def of_scene(cls, scene: Scene, config: HACParams, generator: torch.Generator, **kwargs: Any) -> HACAnchors:
        """Put an anchor into every voxel with a start point of the scene; kwargs as of the constructor.

        Raises SceneError if there is none.
        """
        if scene.points is None or len(scene.points) == 0:
            raise SceneError(
                f"scene '{scene.name}' has no start points: anchors need SfM points or random ones", path=scene.path
            )
        c = config.grid
        grid = MixedHashGrid(
            c.space, c.planes, features=c.features, log2_space=c.log2_space, log2_planes=c.log2_planes,
            generator=generator,
        )  # fmt: skip
        made = cls.from_points(
            scene.points, voxel_size=config.voxel_size, num_offsets=config.num_offsets,
            feature_dim=config.feature_dim, hidden=config.hidden, margin=config.margin,
            sample=config.rate_term.sample, scale_floor=config.rate_term.scale_floor, base_steps=config.steps.triple,
            generator=generator, grid=grid, grid_hidden=c.hidden, in_steps=config.rate_term.units == "steps", **kwargs,
        )  # fmt: skip
        assert isinstance(made, cls)
        return made

    def __getstate__(self) -> dict[str, Any]:
        """A copy works out anew where its anchors lie."""
        return {**self.__dict__, "_places": None}

    def networks(self) -> dict[str, nn.Module]:
        """Networks that the file holds, in its order."""
        return {name: getattr(self, name) for name in (*self.NETWORKS, "mlp_grid")}

    def context_rows(self) -> Context:
        """Places of the anchors in the cube of the grid, [N,3] in 0..1."""
        codes = self.codes()
        if self._places is None or self._places[0] is not codes:
            self._places = codes, codes.to(self.features) / TOP
        return (self._places[1],)

    @property
    def rate_model(self) -> HACRateModel:
        base = self.base_steps_like(self.features)
        return HACRateModel(self.grid, self.mlp_grid, self.shape, self.base_steps, base, self.units, self.floors)

    @torch.no_grad()
    def fold_units(self) -> None:
        """Let the network predict in the units of the values, as it does in the file."""
        _, last = linear_layers(self.mlp_grid)
        last.weight.mul_(self.units[:, None])
        last.bias.mul_(self.units)
        self.units.fill_(1)

    @torch.no_grad()
    def start_from_statistics(self) -> None:
        """Let the network predict mean and deviation of each number over all kept anchors, wherever they are.

        Its last layer keeps a hundredth of its weights, so that the grid has a gradient from the first step on.
        """
        rows = torch.nonzero(self.kept()).squeeze(1)
        if len(rows) < 2:
            return
        _, last = linear_layers(self.mlp_grid)
        last.weight.mul_(0.01)
        found = []
        for values, step in zip(self.raw(rows), self.base_steps, strict=True):
            found += [values.mean(dim=0), values.std(dim=0).clamp(min=step)]
        found.append(last.bias.new_zeros(len(last.bias) - sum(self.shape.outputs[:-1])))
        last.bias.copy_(torch.cat(found) / self.units)
