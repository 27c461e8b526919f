"""Splat files to a size or a quality, without photographs.

from sw_compress import compress

done = compress("garden.ply", size="8MB", out="garden.swz")
print(done.record["quality"]["psnr"], done.model.num_rows)
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sw_compress.compressing import Compressed as Compressed
    from sw_compress.compressing import compress as compress

__version__ = "0.3.0"
__all__ = ["Compressed", "compress"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from sw_compress import compressing as module

    return getattr(module, name)
