"""Imports torchvision also where its wheel was built for CUDA and torch was not.

torchvision 0.28.0 on PyPI is the CUDA build. Beside a torch without CUDA its compiled operators do not load, and the
import ends with "operator torchvision::nms does not exist": the package attaches a fake kernel to two operators (nms
and its quantized form) that nobody has declared. LPIPS needs neither, only the layer lists of the backbones, so it is
enough to declare the two schemas, without an implementation, and to import again.
"""

from __future__ import annotations

import functools
import importlib
import sys
from types import ModuleType

import torch

SCHEMA = "(Tensor dets, Tensor scores, float iou_threshold) -> Tensor"
OPERATORS = ("nms", "qnms")


@functools.cache
def import_torchvision() -> ModuleType:
    """The package torchvision. Raises ImportError if it is not there, or cannot be made to work.

    Where the compiled operators load, nothing is declared: a second schema of one name would be an error.
    """
    try:
        return importlib.import_module("torchvision")
    except RuntimeError as error:
        if "torchvision::" not in str(error):
            raise ImportError(f"torchvision does not work with torch {torch.__version__}: {error}") from error
    # What the failed import has left behind would keep the second one from running.
    for name in [n for n in sys.modules if n.partition(".")[0] == "torchvision"]:
        del sys.modules[name]
    library = _declare()
    try:
        module = importlib.import_module("torchvision")
    except RuntimeError as error:
        raise ImportError(f"torchvision does not work with torch {torch.__version__}: {error}") from error
    # A Library takes its schemas with it when it goes.
    module._splatwizard_schemas = library  # type: ignore[attr-defined]
    return module


def _declare() -> torch.library.Library:
    library = torch.library.Library("torchvision", "DEF")  # type: ignore[no-untyped-call]
    for name in OPERATORS:
        library.define(f"{name}{SCHEMA}")  # type: ignore[no-untyped-call]
    return library
