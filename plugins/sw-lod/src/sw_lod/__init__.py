"""Levels of detail: a scene in pieces, coarse first.

from sw_lod import write_lod

done = write_lod("garden.ply", "garden/lod-meta.json")
print(done["counts"], done["units"])
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sw_lod.writing import write_lod as write_lod

__version__ = "0.3.0"
__all__ = ["write_lod"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sw_lod import writing as module

    return getattr(module, name)
