"""The pruner that the config of a method names."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from splatwizard_core.api import ConfigError, PluginError

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager, Pruner


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
