"""Photographs of test views for the page: small JPEGs as data: URIs."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence

from PIL import Image
from torch import Tensor

from sw_view.shown_cameras import NamedCamera

SIDE = 800
"""Largest side in pixels; smaller photographs keep their size."""
QUALITY = 85


def photographs_of(cameras: Sequence[NamedCamera], most: int, background: Tensor | None = None) -> dict[int, str]:
    """Return the photographs of at most `most` test cameras, spread evenly, by the place of the camera.

    background  [3] behind pictures with alpha; None: black
    """
    places = [i for i, each in enumerate(cameras) if each.view is not None and each.view.load is not None]
    if len(places) > most:
        places = [places[round(i * (len(places) - 1) / max(most - 1, 1))] for i in range(most)]
    return {i: _encoded(view.image(background)) for i in places if (view := cameras[i].view) is not None}


def _encoded(image: Tensor) -> str:
    """Return a picture [3,H,W] in 0..1 as a data: URI."""
    picture = Image.fromarray((image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy())
    picture.thumbnail((SIDE, SIDE), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    picture.save(buffer, format="JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"
