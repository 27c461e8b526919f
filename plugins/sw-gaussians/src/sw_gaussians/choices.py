"""Exchangeable parts of a method: a codec or a pruner chosen by name, with the settings of its package.

A config asks for one with a block, `codec: CodecChoice` or one of its own that extends `PrunerChoice`, and is itself a
`Choosing`. Then `--set codec=NAME` and `--set codec.settings.KEY=VALUE` work, also for third-party codecs. Keys,
types and bounds come from `Settings`, the pydantic model of the class registered under that name.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

from pydantic import BaseModel, Field, ValidationError, create_model

from splatwizard_core.api import ConfigError, Params, PluginError, apply_overrides, given_values
from sw_gaussians.named_blocks import Choosing as Choosing
from sw_gaussians.named_blocks import Exchangeable as Exchangeable
from sw_gaussians.named_blocks import Moved as Moved
from sw_gaussians.named_blocks import Named
from sw_gaussians.named_blocks import OwnCodec as OwnCodec

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianCodec, PluginManager, Pruner

ChoiceT = TypeVar("ChoiceT", bound="Choice")


class Choice(Named):
    """Base of blocks that choose a registered class: a field for its name, and `settings`, a dict.

    REGISTRY    attribute of the plugin manager that knows the names
    PARTS       further fields with settings, each for a part of the work alone; they win over `settings`
    """

    REGISTRY: ClassVar[str]
    PARTS: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def settings_fields(cls) -> tuple[str, ...]:
        return "settings", *cls.PARTS

    def provider(self, plugins: PluginManager, key: str) -> Callable[..., Any]:
        """Return the class that is registered under the name.

        key     of the config where the name stands

        Raises ConfigError if there is none, PluginError if it is broken or claimed twice.
        """
        try:
            provider: Callable[..., Any] = getattr(plugins, self.REGISTRY).entry(self.chosen).load()
        except PluginError as error:
            if error.name is None:  # it is there, but broken or claimed twice
                raise
            raise ConfigError(str(error), key=key) from error
        return provider

    def _model(self, plugins: PluginManager, key: str) -> type[BaseModel] | None:
        """Return the `Settings` of the provider; None if it has none. Raises PluginError for what is no such model."""
        found: type[BaseModel] | None = getattr(self.provider(plugins, key), "Settings", None)
        if found is not None:
            try:
                found.model_validate({})
            except (AttributeError, TypeError, ValidationError) as error:
                raise PluginError(
                    f"'{self.chosen}' ({key}) cannot be set up: its Settings must be a pydantic model whose fields "
                    f"have defaults ({type(error).__name__})"
                ) from error
        return found

    def completed(self, plugins: PluginManager, path: str, sources: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """Return `settings` with every setting of the provider, and PARTS with those given, parsed by its types.

        path        key of this block
        sources     dotted key -> where its value comes from

        Raises ConfigError for a name that is not installed, a setting that the provider does not have, a bad value.
        """
        key = f"{path}.{self.NAME}"
        model = self._model(plugins, key)
        found: dict[str, dict[str, Any]] = {}
        for field in self.settings_fields():
            given = {f"{path}.{field}.{name}": value for name, value in getattr(self, field).items()}
            if model is None and given:
                first = next(iter(given))
                raise ConfigError(
                    f"'{first}' in {sources.get(first, 'the configuration')}: '{self.chosen}' ({key}) has no settings: "
                    "leave it out, or name another one",
                    key=first,
                )
            try:
                checked = _checked(model, f"{path}.{field}", given, sources) if model is not None else {}
            except ConfigError as error:
                wrong = (error.key or "").removeprefix(f"{path}.{field}.").partition(".")[0]
                if model is None or wrong in model.model_fields:
                    raise
                raise ConfigError(
                    f"{error}\nThese are the settings of '{self.chosen}' ({key}): `--set {path}=NAME` chooses another.",
                    key=error.key,
                ) from None
            found[field] = {k: v for k, v in checked.items() if field == "settings" or k in getattr(self, field)}
        return found

    def settings_keys(self, plugins: PluginManager, path: str) -> dict[str, str]:
        model = self._model(plugins, path)
        fields = {} if model is None else model.model_fields
        return {f"{path}.settings.{name}": field.description or "" for name, field in fields.items()}

    def normal(self: ChoiceT, plugins: PluginManager) -> ChoiceT:
        """Return this with only the settings that differ from the provider's defaults."""
        model = self._model(plugins, self.NAME)
        settings = {} if model is None else given_values(model.model_validate(self.model_dump()["settings"]), plugins)
        return super().normal(plugins).model_copy(update={"settings": settings})


class CodecChoice(Choice):
    """Codec of whole Gaussian models; each method sets the default of `name`."""

    REGISTRY: ClassVar[str] = "gaussian_codecs"

    name: str = Field(description="codec of the file: any registered one of Gaussians")
    settings: dict[str, object] = Field({}, description="settings of the chosen one, by its own keys")

    def load(self, plugins: PluginManager) -> GaussianCodec:
        """Return the codec with its settings. Raises PluginError."""
        codec: GaussianCodec = plugins.gaussian_codecs.load(self.name)(plugins, **self.settings)
        return codec


class PrunerChoice(Choice):
    """Pruner; a method's subclass adds when and how much it removes."""

    REGISTRY: ClassVar[str] = "pruners"
    NAME: ClassVar[str] = "pruner"

    pruner: str = Field(description="whose scores decide: any registered pruner")
    settings: dict[str, object] = Field({}, description="settings of the chosen one, by its own keys")

    def load(self, plugins: PluginManager, key: str = "prune.pruner") -> Pruner:
        """Return the pruner with its settings: a method asks in `stages`, before anything is trained.

        key     of the config where the name stands

        Raises ConfigError if none of that name is installed, PluginError if it cannot be loaded.
        """
        self.provider(plugins, key)
        pruner: Pruner = plugins.pruners.load(self.pruner)(**self.settings)
        return pruner


def _checked(model: type[BaseModel], path: str, given: Mapping[str, Any], sources: Mapping[str, str]) -> dict[str, Any]:
    """Return all settings of a provider with the values `given` by full key. Raises ConfigError with that key."""
    outer = _nested(model, path)()
    try:
        found: Any = apply_overrides(outer, given, source="the configuration")
    except ConfigError as error:
        found = apply_overrides(outer, given, source=sources.get(error.key or "", "the configuration"))
    for name in path.split("."):
        found = getattr(found, name)
    settings: dict[str, Any] = found.model_dump(mode="json")
    return settings


@functools.cache
def _nested(model: type[BaseModel], path: str) -> type[BaseModel]:
    """Return a model with the settings at the dotted `path`, so that messages have their full keys."""
    for name in reversed(path.split(".")):
        fields: dict[str, Any] = {name: (model, Field(default_factory=model))}
        model = create_model(name, __base__=Params, **fields)
    return model
