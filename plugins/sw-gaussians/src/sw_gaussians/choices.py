"""Exchangeable parts of a method: a codec or a pruner chosen by name, with the settings of its package.

A config asks for one with a block, `codec: CodecChoice` or one of its own that extends `PrunerChoice`, and is itself a
`Choosing`. Then `--set codec=NAME` and `--set codec.settings.KEY=VALUE` work, also for third-party codecs. Keys,
types and bounds come from `Settings`, the pydantic model of the class registered under that name.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from pydantic import BaseModel, Field, ValidationError, create_model, model_validator

from splatwizard_core.api import ConfigError, OptimizationParams, Params, PluginError, apply_overrides, given_values

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianCodec, PluginManager, Pruner

ChoiceT = TypeVar("ChoiceT", bound="Choice")
ExchangeableT = TypeVar("ExchangeableT", bound="Exchangeable")


class Named(Params):
    """Configuration block with a name: `codec = "NAME"` is short for `codec.name = "NAME"`.

    NAME    field that holds the name
    """

    NAME: ClassVar[str] = "name"

    @model_validator(mode="before")
    @classmethod
    def _of_name(cls, value: Any) -> Any:
        return {cls.NAME: value} if isinstance(value, str) else value

    @property
    def chosen(self) -> str:
        """Name of the chosen class."""
        found: str = getattr(self, self.NAME)
        return found


class OwnCodec(Named):
    """Codec of a method whose file no other codec can write: subclasses fix `name` and type `settings`.

    name        `Literal["their-method"]`: the method's name, or that of its codec where that one is registered
    settings    block of typed fields
    """


class Choice(Named):
    """Base of blocks that choose a registered class: a field for its name, and `settings`, a dict.

    REGISTRY    attribute of the plugin manager that knows the names
    PARTS       further fields with settings, each for a part of the work alone; they win over `settings`
    """

    REGISTRY: ClassVar[str]
    PARTS: ClassVar[tuple[str, ...]] = ()

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
        for field in ("settings", *self.PARTS):
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
        """Map the dotted keys of the provider's settings to their descriptions; `path` is that of this block."""
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


class Moved(NamedTuple):
    """New key that replaces a key of an older release.

    keys        one or several; none: it is gone
    default     value that the older release had; a key that is gone is refused with another one, if this is not None
    provider    whose setting it is, for a key of settings: it is dropped where another is chosen
    """

    keys: tuple[str, ...]
    default: Any = None
    provider: str | tuple[str, ...] = ""

    def checked(self, old: str, value: Any) -> Any:
        """Return a value of the key `old`. Raises ConfigError if it is gone, and did something."""
        if not self.keys and self.default is not None and str(value).lower() != str(self.default).lower():
            raise ConfigError(f"'{old}' is gone since 0.3, with what {value} did: leave it out", key=old)
        return value


class Exchangeable(OptimizationParams):
    """Base of configs with exchangeable parts.

    OLDER       key of an older release -> where it stands now: config files, run directories and checkpoints with it
                are read as before. "codec" stands there for a codec that was a name alone
    """

    OLDER: ClassVar[Mapping[str, Moved]] = {}

    def spelled(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return values by dotted key, with older keys replaced by current ones.

        A name alone, `codec=NAME`, stands for the key of the name. Settings of another provider than the one named so
        far are gone. Keys of `OLDER` become those of today.
        """
        named = dict(_blocks(self))
        found = dict(values)
        all_older = self._all_older()
        for name in sorted({*named, *(old.partition(".")[0] for old in all_older)}):
            if isinstance(found.get(name), Mapping):
                found |= {f"{name}.{key}": value for key, value in found.pop(name).items()}
        for path, block in named.items():
            if isinstance(found.get(path), str):
                found[f"{path}.{block.NAME}"] = found.pop(path)
        found = self.translated(found)
        older = {old: all_older[old].checked(old, found.pop(old)) for old in list(found) if old in all_older}
        for old in [old for old in older if not all_older[old].provider]:
            found |= dict.fromkeys(all_older[old].keys, older.pop(old))
        chosen = {path: found.get(f"{path}.{block.NAME}", block.chosen) for path, block in named.items()}
        for old, value in older.items():
            moved = all_older[old]
            whose = (moved.provider,) if isinstance(moved.provider, str) else moved.provider
            found |= {key: value for key in moved.keys if chosen[key.partition(".")[0]] in whose}
        anew: dict[str, Any] = {}
        for path, block in named.items():
            fields = [f"{path}.{each}" for each in ("settings", *block.PARTS)] if isinstance(block, Choice) else []
            for key in fields:
                if isinstance(found.get(key), Mapping):
                    found |= {f"{key}.{name}": value for name, value in found.pop(key).items()}
            if chosen[path] != block.chosen:
                anew |= {f"{path}.{block.NAME}": chosen[path], **{key: {} for key in fields}}
        return {**anew, **found}

    @classmethod
    def _all_older(cls) -> dict[str, Moved]:
        """Return `OLDER` of this class and its bases."""
        return {old: moved for base in reversed(cls.__mro__) for old, moved in vars(base).get("OLDER", {}).items()}

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        """Return values by dotted key where more than a key has changed since an older release: a value, say."""
        return values

    def settings_keys(self, plugins: PluginManager) -> dict[str, str]:
        """Map dotted keys of settings of the providers that it names to their descriptions."""
        blocks = ((path, block) for path, block in _blocks(self) if isinstance(block, Choice))
        return {key: told for path, block in blocks for key, told in block.settings_keys(plugins, path).items()}

    def completed(self: ExchangeableT, plugins: PluginManager, sources: Mapping[str, str]) -> ExchangeableT:
        """Return this with all settings of the providers that it names, checked. Raises ConfigError."""
        content = super().completed(plugins, sources).model_dump()
        for path, block in _blocks(self):
            if isinstance(block, Choice):
                content[path] |= block.completed(plugins, path, sources)
        return type(self).model_validate(content)


class Choosing(Exchangeable):
    """Base of configs of a method: besides or in place of `GaussianTraining`."""


def _blocks(config: BaseModel) -> Iterator[tuple[str, Named]]:
    """Yield key and value of each `Named` block."""
    for name in type(config).model_fields:
        block = getattr(config, name)
        if isinstance(block, Named):
            yield name, block


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
