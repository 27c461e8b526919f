"""A method: a name, a typed config, its stages, and one file that a fresh process decodes alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from splatwizard_core.errors import BitstreamError, ConfigError
from splatwizard_core.gaussians.splat_model import SplatModel
from splatwizard_core.training.keys import dotted, is_beside_method
from splatwizard_core.training.overrides import apply_overrides
from splatwizard_core.training.params import OptimizationParams

if TYPE_CHECKING:
    import torch

    from splatwizard_core.coding.container import ContainerReader, ContainerWriter
    from splatwizard_core.plugins import PluginManager
    from splatwizard_core.scene.scene import Scene
    from splatwizard_core.training.stage import Stage


class Method:
    """Base of every method. A subclass reads top to bottom like its paper's method section.

    name            how it is asked for; written into its files
    version         of its file layout: a decoder refuses other versions than it knows
    Config          its hyper-parameters
    PRESETS         preset name -> values by dotted key; "paper" (the defaults) and "quick" always exist
    BY_DATASET      family of data sets -> values that preset "paper" has for its scenes, keys of the scene included
    RATES           rate point name -> values by dotted key, r1 the smallest file
    DEFAULT_RATE    the rate point that `--rate default` means
    """

    name: ClassVar[str]
    version: ClassVar[int] = 1
    Config: ClassVar[type[OptimizationParams]] = OptimizationParams
    PRESETS: ClassVar[Mapping[str, Mapping[str, Any]]] = {"paper": {}, "quick": {}}
    BY_DATASET: ClassVar[Mapping[str, Mapping[str, Any]]] = {}
    RATES: ClassVar[Mapping[str, Mapping[str, Any]]] = {"r1": {}}
    DEFAULT_RATE: ClassVar[str] = "r1"

    def __init__(self, plugins: PluginManager, config: OptimizationParams | None) -> None:
        """config is None when decoding: the file is all there is."""
        self.plugins = plugins
        self.scene: Scene | None = None  # that a model was trained on, while it is encoded
        self._config = config

    @property
    def config(self) -> Any:
        """Return the resolved hyper-parameters. Raises RuntimeError inside `decode`, which may not look at any."""
        if self._config is None:
            raise RuntimeError(f"{self.name}: decode() must not read the configuration; put it into the file")
        return self._config

    def create_model(self, scene: Scene, generator: torch.Generator) -> SplatModel:
        """Return the model before its first step."""
        raise NotImplementedError

    def stages(self) -> Sequence[Stage]:
        """Return the training stages in order."""
        raise NotImplementedError

    def borrows(self) -> Sequence[Method]:
        """Return the configured methods that the stages are built on: their values tell trainings apart too."""
        return []

    def encode(self, model: SplatModel, writer: ContainerWriter) -> None:
        """Write everything that `decode` needs; must leave `model` as it is."""
        raise NotImplementedError

    def decode(self, reader: ContainerReader) -> SplatModel:
        """Rebuild the model from the file alone."""
        raise NotImplementedError

    def check_version(self, reader: ContainerReader) -> None:
        """Raise BitstreamError for another layout version than the method's own: for a `decode` that reads no other."""
        if reader.version != self.version:
            known = self.plugins.methods
            package = known.entry(self.name).distribution if self.name in known else f"the package of {self.name}"
            advice = f"newer: upgrade {package}" if reader.version > self.version else f"older: get an older {package}"
            raise BitstreamError(
                f"{reader.name}: {self.name} layout version {reader.version} is unknown, this installation reads "
                f"{self.version}; the file is {advice}"
            )


def create_method(
    plugins: PluginManager, name: str, config: Mapping[str, Any] | None = None, *, preset: str = "paper"
) -> Method:
    """Return another method by name, with values for its config: how one method borrows from another.

    config  values by dotted key, or nested as in a TOML file
    preset  values that it sets beyond the method's config (of the run or the scene, such as clamp_render) are left to
            the run: they are the user's, and one run has one of each

    Raises PluginError if it is not installed, ConfigError for an unknown preset, key or value.
    """
    cls: type[Method] = plugins.methods.load(name)
    if preset not in cls.PRESETS:
        raise ConfigError(f"'{name}' has no preset '{preset}'; it has {', '.join(cls.PRESETS)}", key="preset")
    borrowed = {k: v for k, v in cls.PRESETS[preset].items() if not is_beside_method(cls.Config, k)}
    values = {**borrowed, **dotted(config or {})}
    usual, source = cls.Config(), f"config of '{name}'"
    asked = apply_overrides(usual, values, source=source, known=usual.settings_keys(plugins))
    return cls(plugins, asked.completed(plugins, dict.fromkeys(values, source)))
