"""Identity of a training: the configuration values that differ from the defaults.

A new key whose default changes nothing is in no identity, so it leaves finished trainings and cached scenes as they
are. A changed default is in none either: the block that states it counts the change in `DEFAULTS`, which is.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from splatwizard_core.training.keys import block_of, marked, remove_at
from splatwizard_core.training.params import Params, SameResult

DEFAULTS = "$defaults"
"""Key of the counters of changed defaults per block; absent if no default has changed."""


def given_values(block: BaseModel, plugins: Any = None) -> dict[str, Any]:
    """Return the values of a block that differ from its defaults, plain and nested: equal ones make equal models.

    plugins     the PluginManager, for blocks with settings of something that is registered
    """
    normal = block.normal(plugins) if isinstance(block, Params) else block
    content = normal.model_dump(mode="json", exclude_defaults=True)
    changes = dict(_changed_defaults(type(block)))
    return {**content, DEFAULTS: changes} if changes else content


def all_values(block: BaseModel) -> dict[str, Any]:
    """Return all values of a block, plain and nested, but those that are marked `SameResult`."""
    content = block.model_dump(mode="json")
    for key in marked(type(block), SameResult):
        remove_at(content, key)
    return content


def _changed_defaults(cls: type[BaseModel], path: str = "") -> Iterator[tuple[str, int]]:
    """Yield the dotted key of each block with changed defaults ("" for `cls` itself), and how many there were."""
    count = sum(vars(base).get("DEFAULTS", 0) for base in cls.__mro__)
    if count:
        yield path.rstrip("."), count
    for name, field in cls.model_fields.items():
        inner = block_of(field.annotation)
        if inner is not None:
            yield from _changed_defaults(inner, f"{path}{name}.")
