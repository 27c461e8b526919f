"""A video file, written frame by frame, where a library that encodes is installed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import UserInputError, replacing

FORMS: Mapping[str, tuple[str, str, dict[str, str]]] = {
    ".mp4": ("mp4", "libx264", {"crf": "18", "preset": "medium"}),
    ".mkv": ("matroska", "libx264", {"crf": "18", "preset": "medium"}),
    ".mov": ("mov", "libx264", {"crf": "18", "preset": "medium"}),
    ".webm": ("webm", "libvpx-vp9", {"crf": "24", "b": "0"}),
}
"""Suffix -> container, encoder, and its options: of constant quality that shows no loss at first sight."""

BT709 = 1
"""Number of its matrix, primaries and transfer in H.273; as a range it is the limited one."""


def video_library() -> ModuleType:
    """Return the library. Raises UserInputError that names the extra which brings it."""
    try:
        import av
    except ImportError as error:
        raise UserInputError(
            "--video needs the package av: pip install 'sw-view[video]' (without --video the frames are PNG files)"
        ) from error
    library: ModuleType = av
    return library


def check_video(path: Path) -> None:
    """Raise UserInputError unless a video can be written under such a name here."""
    if path.suffix.lower() not in FORMS:
        raise UserInputError(f"--video {path}: the name must end in one of {', '.join(FORMS)}")
    video_library()


class VideoWriter:
    """Encodes frames of one size as they come, 8-bit sRGB in BT.709 with half the colour resolution."""

    def __init__(self, container: Any, stream: Any) -> None:
        self._container, self._stream = container, stream

    def add(self, pixels: NDArray[np.uint8]) -> None:
        """Encode the next frame, [H,W,3]."""
        frame = video_library().VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
        # Unasked, it would be converted by BT.601, and players take a large picture to be BT.709.
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
        self._container.mux(self._stream.encode(frame))


@contextmanager
def video_file(path: Path, size: tuple[int, int], fps: float) -> Iterator[VideoWriter]:
    """Write a video; it takes the place of `path` when the block ends, and is gone if the block raises.

    size    width, height of each frame, even numbers of pixels
    fps     frames per second
    """
    library = video_library()
    form, encoder, options = FORMS[path.suffix.lower()]
    with replacing(path) as temporary, library.open(str(temporary), "w", format=form) as container:
        stream = container.add_stream(encoder, rate=Fraction(fps).limit_denominator(1001), options=options)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        for name in ("colorspace", "color_primaries", "color_trc", "color_range"):
            setattr(stream.codec_context, name, BT709)
        yield VideoWriter(container, stream)
        container.mux(stream.encode(None))
