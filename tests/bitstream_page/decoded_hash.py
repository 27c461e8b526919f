"""Chapter 7: The hash of a decoded model."""

from __future__ import annotations

import hashlib

import numpy as np

FIRST = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")


def parameter_hash(parameters: dict[str, np.ndarray]) -> str:
    order = [name for name in FIRST if name in parameters] + sorted(set(parameters) - set(FIRST))
    return hashlib.sha256(b"".join(parameters[name].astype("<f4").tobytes() for name in order)).hexdigest()
