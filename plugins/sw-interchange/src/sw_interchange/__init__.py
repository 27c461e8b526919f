"""Files of other programs: read into a neutral scene of Gaussians, and written from one.

from sw_interchange import read, write

scene = read("garden.spz")
write(scene, "garden.sog")
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sw_interchange.bridge import from_gaussians as from_gaussians
    from sw_interchange.bridge import to_gaussians as to_gaussians
    from sw_interchange.files import decode as decode
    from sw_interchange.files import encode as encode
    from sw_interchange.files import read as read
    from sw_interchange.files import write as write
    from sw_interchange.known_formats import Format as Format
    from sw_interchange.known_formats import formats as formats
    from sw_interchange.scene import GaussianScene as GaussianScene
    from sw_interchange.scene import Limits as Limits
    from sw_interchange.scene import ReadReport as ReadReport
    from sw_interchange.scene import WriteReport as WriteReport

_PLACES = {
    "from_gaussians": "bridge", "to_gaussians": "bridge", "decode": "files", "encode": "files", "read": "files",
    "write": "files", "Format": "known_formats", "formats": "known_formats", "GaussianScene": "scene",
    "Limits": "scene", "ReadReport": "scene", "WriteReport": "scene",
}  # fmt: skip
__all__ = list(_PLACES)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"sw_interchange.{_PLACES[name]}"), name)
