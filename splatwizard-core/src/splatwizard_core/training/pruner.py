"""The contract of pruners, and how a method gets the one that its config names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

from torch import Tensor

from splatwizard_core.errors import ConfigError, PluginError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.rendering.rasterizer import Rasterizer
from splatwizard_core.scene.camera import Camera

if TYPE_CHECKING:
    from splatwizard_core.plugins import PluginManager


class Pruner(Protocol):
    """Scores primitives; how many go is the caller's business.

    What is registered is a class whose settings all have defaults, so that any method can use any pruner:
    `load_pruner(plugins, name)`.

    uses_statistics     the score reads the model's screen-space gradient statistics (`grad_accum`, `denom`): whoever
                        uses this pruner has them collected in the steps before
    """

    uses_statistics: bool

    def score(
        self, model: SplatModel, cameras: Sequence[Camera], rasterizer: Rasterizer, background: Tensor | None = None
    ) -> Tensor:
        """[N] float, one for each row of the model, higher = keep; -inf for what no camera sees.

        background  [3] what the scene is drawn on, 0..1; None: black

        Leaves the model as it is, gradients included. Every camera counts once, whatever the order.
        """
        ...


def load_pruner(
    plugins: PluginManager,
    name: str,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
    *,
    key: str = "prune.pruner",
) -> Pruner:
    """Return the pruner that a method's config names: a method asks in `stages`, before anything is trained.

    settings    name of a pruner -> its settings: a method knows those of its own; any other has its defaults
    key         of the config that names it

    Raises ConfigError if none of that name is installed, PluginError if it cannot be loaded.
    """
    try:
        cls = plugins.pruners.load(name)
    except PluginError as error:
        if error.name is None:  # it is there, but broken or claimed twice
            raise
        raise ConfigError(str(error), key=key) from error
    pruner: Pruner = cls(**(settings or {}).get(name, {}))
    return pruner
