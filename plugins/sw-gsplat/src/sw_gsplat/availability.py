"""Whether gsplat can run here; compiles nothing and does not import it."""

from __future__ import annotations

import importlib.util


def unavailable() -> str | None:
    """The reason why gsplat cannot draw here, or None."""
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed (pip install 'sw-gsplat[gsplat]')"
    import torch

    if not torch.cuda.is_available():
        return "gsplat needs a CUDA GPU that torch can see"
    return None
