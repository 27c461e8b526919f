"""The model of HAC: coded anchors, and the grid and network of their rate model.

Source: HAC (arXiv 2403.14530), section 4.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import torch
from sw_anchors.anchors import linear_layers
from sw_anchors.coded_anchors import CodedAnchors
from sw_anchors.lattice import TOP
from sw_anchors.rate_model import RateInputs
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

    grid        binary hash grid over the box of the anchors
    mlp_grid    from its features to the W outputs of `AnchorShape`: means and deviations, then step logits
    units       [W] buffer: factors of these outputs; 1 where it predicts values as they are
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
        """Take what CodedAnchors takes, and the grid.

        grid_hidden width of the network `mlp_grid`
        in_steps    the network predicts means and deviations as multiples of the base steps: scales are some
                    hundredths, so one update of a network that predicts them as they are can change all of them
        further     number of outputs that follow those of `AnchorShape`, for a subclass
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
        """Put an anchor into every voxel with a start point of the scene; `kwargs` go to the constructor.

        Raises SceneError if the scene has no start points.
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
        """Leave the places out: a copy computes its own."""
        return {**self.__dict__, "_places": None}

    def networks(self) -> dict[str, nn.Module]:
        """Return the networks that the file holds, by name, in its order."""
        return {name: getattr(self, name) for name in (*self.NETWORKS, "mlp_grid")}

    def context_rows(self) -> RateInputs:
        """Return the places [N,3] of the anchors in the cube of the grid, 0..1, as their 16-bit codes give them."""
        codes = self.codes()
        if self._places is None or self._places[0] is not codes:
            self._places = codes, codes.to(self.features) / TOP
        return (self._places[1],)

    @property
    def rate_model(self) -> HACRateModel:
        """Grid and network as they are now; a subclass with another context model or rate returns its own."""
        base = self.base_steps_like(self.features)
        return HACRateModel(self.grid, self.mlp_grid, self.shape, self.base_steps, base, self.units, self.floors)

    @torch.no_grad()
    def fold_units(self) -> None:
        """Move `units` into the last layer: the network then predicts in the units of the values, as in the file."""
        _, last = linear_layers(self.mlp_grid)
        last.weight.mul_(self.units[:, None])
        last.bias.mul_(self.units)
        self.units.fill_(1)

    @torch.no_grad()
    def start_from_statistics(self) -> None:
        """Let the network predict mean and deviation of each number over all kept anchors, wherever they are.

        Numbers further from the median than ten times the middle half of them count as that far: one scale of 1,000
        among 25,000 scales of 0.01 would raise the deviation to 6, which no later step brings down again. The last
        layer keeps a hundredth of its weights, so that the grid has a gradient from the first step on.
        """
        rows = torch.nonzero(self.kept()).squeeze(1)
        if len(rows) < 2:
            return
        _, last = linear_layers(self.mlp_grid)
        last.weight.mul_(0.01)
        found = []
        for values, step in zip(self.raw(rows), self.base_steps, strict=True):
            ordered = values.sort(dim=0).values
            low, middle, high = (ordered[len(rows) * quarter // 4] for quarter in (1, 2, 3))
            reach = 10 * (high - low).clamp(min=step)
            near = values.clamp(middle - reach, middle + reach)
            found += [near.mean(dim=0), near.std(dim=0).clamp(min=step)]
        found.append(last.bias.new_zeros(len(last.bias) - sum(self.shape.outputs[:-1])))
        last.bias.copy_(torch.cat(found) / self.units)
