"""Configs with named blocks, such as `codec.name`, and translation of keys of older releases.

`OwnCodec` is a block with one fixed codec; `choices.Choice` is a block whose provider the user may exchange.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from pydantic import BaseModel, model_validator

from splatwizard_core.api import ConfigError, OptimizationParams, Params

if TYPE_CHECKING:
    from splatwizard_core.api import PluginManager

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

    @classmethod
    def settings_fields(cls) -> tuple[str, ...]:
        """Return the fields whose keys the named provider defines; none if all keys are typed."""
        return ()

    def settings_keys(self, plugins: PluginManager, path: str) -> dict[str, str]:
        """Map the dotted keys of the provider's settings to their descriptions; `path` is that of this block."""
        return {}

    def completed(self, plugins: PluginManager, path: str, sources: Mapping[str, str]) -> dict[str, dict[str, Any]]:
        """Return the values of `settings_fields` with every setting of the provider, checked.

        path        key of this block
        sources     dotted key -> where its value comes from

        Raises ConfigError.
        """
        return {}


class OwnCodec(Named):
    """Codec of a method whose file no other codec can write: subclasses fix `name` and type `settings`.

    name        `Literal["their-method"]`: the method's name, or that of its codec where that one is registered
    settings    block of typed fields
    """


class Moved(NamedTuple):
    """New key that replaces a key of an older release.

    keys        one or several; none: it is gone
    default     value that the older release had, or a tuple of those without an effect on results: a key that is
                gone is refused with another one, if this is not None
    provider    whose setting it is, for a key of settings: it is dropped where another is chosen
    """

    keys: tuple[str, ...]
    default: Any = None
    provider: str | tuple[str, ...] = ""

    def checked(self, old: str, value: Any) -> Any:
        """Return a value of the key `old`. Raises ConfigError if it is gone, and did something."""
        harmless = self.default if isinstance(self.default, tuple) else (self.default,)
        if not self.keys and harmless != (None,) and str(value).lower() not in (str(each).lower() for each in harmless):
            raise ConfigError(f"'{old}' is gone since 0.3, with what {value} did: leave it out", key=old)
        return value


SWITCH = (True, False, 1, 0, "yes", "no", "on", "off")
"""Values of a key that is gone and chose between two ways to the same result."""


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
            fields = [f"{path}.{each}" for each in block.settings_fields()]
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
        return {key: told for path, block in _blocks(self) for key, told in block.settings_keys(plugins, path).items()}

    def completed(self: ExchangeableT, plugins: PluginManager, sources: Mapping[str, str]) -> ExchangeableT:
        """Return this with all settings of the providers that it names, checked. Raises ConfigError."""
        content = super().completed(plugins, sources).model_dump()
        for path, block in _blocks(self):
            content[path] |= block.completed(plugins, path, sources)
        return type(self).model_validate(content)


class Choosing(Exchangeable):
    """Base of a method's config, besides or in place of `GaussianTraining`."""


def _blocks(config: BaseModel) -> Iterator[tuple[str, Named]]:
    """Yield key and value of each `Named` block."""
    for name in type(config).model_fields:
        block = getattr(config, name)
        if isinstance(block, Named):
            yield name, block
