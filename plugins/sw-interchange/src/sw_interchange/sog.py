"""The SOG format of PlayCanvas: columns of bytes in lossless WebP images, described by a meta.json.

A bundle (.sog) is a ZIP archive of them; unbundled they lie in a folder. Source: the public specification of the
PlayCanvas engine. Versions 1 (read only) and 2.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import numpy.typing as npt

from splatwizard_core.api import BitstreamError
from sw_interchange.archive import read_archive
from sw_interchange.bands import Array
from sw_interchange.known_formats import MAX_META
from sw_interchange.quats import ROOT_2, from_smallest_three
from sw_interchange.scene import LARGEST_LOGIT, GaussianScene, Limits, ReadReport, decoded_bytes, logit_of_byte
from sw_interchange.source import Source, json_reason
from sw_interchange.webp import LARGEST_SIDE, Pixels, decode_image, image_size

MAX_PALETTE = 1 << 16
PALETTE_COLUMNS = 64
"""Entries of the SH palette side by side in its image."""
BANDS = {1: 3, 2: 8, 3: 15}
"""SH degree -> coefficients per channel."""
LARGEST_LOGARITHM = 80
"""Of ln(1 + |x|) of a coordinate."""


class _Bundle:
    """The files of a scene, and its description."""

    def __init__(self, source: Source, limits: Limits) -> None:
        self.name = source.name
        self.largest = limits.max_output_bytes
        self.size = len(source.data)  # bytes that the scene is made of
        self.file: Callable[[str], bytes]
        if source.head(2) == b"PK":
            files = read_archive(source, min(limits.max_output_bytes, 64 * len(source.data) + (1 << 24)))
            places = sorted((name for name in files if PurePosixPath(name).name == "meta.json"), key=len)
            if not places or places[0].count("/") > 1:
                raise BitstreamError(f"{self.name}: there is no meta.json in the archive")
            folder = places[0].removesuffix("meta.json")
            self.file = lambda name: self._member(files, folder + name)
            text = files[places[0]]
        else:
            self.file = lambda name: self._beside(source, name)
            text = bytes(source.data[: MAX_META + 1])
        self.meta = self._parsed(text)

    def _member(self, files: dict[str, bytes], name: str) -> bytes:
        if name not in files:
            raise BitstreamError(f"{self.name}: the archive lacks '{name}', which its meta.json names")
        return files[name]

    def _beside(self, source: Source, name: str) -> bytes:
        content = source.beside(name)
        if len(content) > self.largest:
            raise BitstreamError(
                f"{self.name}: '{name}', which it names, has {len(content):,} bytes; {self.largest:,} are the most"
            )
        self.size += len(content)
        return bytes(content)

    def _parsed(self, text: bytes) -> dict[str, Any]:
        def refuse(word: str) -> float:
            raise ValueError(f"{word} is no number")

        if len(text) > MAX_META:
            raise BitstreamError(f"{self.name}: a meta.json of more than {MAX_META:,} bytes")
        try:
            found = json.loads(text, parse_constant=refuse)
        except (ValueError, RecursionError) as error:
            raise BitstreamError(f"{self.name}: a damaged meta.json: {json_reason(error)}") from error
        if not isinstance(found, dict):
            raise BitstreamError(f"{self.name}: its meta.json is no description of a scene")
        if "lodLevels" in found:
            raise BitstreamError(f"{self.name}: an index of several levels: read it as 'streamed-sog'")
        return found

    # Values of the description, each held to its kind.

    def part(self, name: str) -> dict[str, Any]:
        found = self.meta.get(name)
        if not isinstance(found, dict):
            raise BitstreamError(f"{self.name}: meta.json says nothing of '{name}'")
        return found

    def numbers(self, part: str, key: str, count: int) -> npt.NDArray[np.float64]:
        found = self.part(part).get(key)
        found = found if isinstance(found, list) else [found]
        good = len(found) == count and all(type(x) in (int, float) and abs(x) < 1e30 for x in found)
        if not good:
            raise BitstreamError(f"{self.name}: '{key}' of '{part}' in meta.json is no list of {count} numbers")
        return np.array(found, np.float64)

    def codebook(self, part: str) -> Array:
        found = self.part(part).get("codebook")
        if isinstance(found, list) and len(found) == 256 and found[0] is None and found[1:].count(None) == 0:
            # Some old writers lost the first entry. The ends are as far apart as the neighbours are.
            found = [found[1] + (found[1] - found[255]) / 255 if _is_number(found[1], found[255]) else None, *found[1:]]
        if not isinstance(found, list) or not 1 <= len(found) <= 256 or not _is_number(*found):
            raise BitstreamError(f"{self.name}: the codebook of '{part}' is no list of up to 256 numbers")
        return np.array(found, np.float32)

    def count(self, part: dict[str, Any], key: str, most: int) -> int:
        found = part.get(key)
        if type(found) is not int or not 1 <= found <= most:
            raise BitstreamError(f"{self.name}: '{key}' in meta.json is {found!r:.40}; 1 to {most:,} are possible")
        return found

    def images(self, part: str, count: int) -> list[tuple[str, bytes]]:
        names = self.part(part).get("files")
        good = isinstance(names, list) and len(names) == count
        if not good or not all(isinstance(n, str) and is_plain(n) for n in names or []):
            raise BitstreamError(f"{self.name}: 'files' of '{part}' is no list of {count} plain file names")
        assert isinstance(names, list)  # for mypy
        return [(f"{self.name}/{each}", self.file(each)) for each in names]


def _is_number(*values: Any) -> bool:
    return all(type(x) in (int, float) and abs(x) < 1e30 for x in values)


def is_plain(name: str) -> bool:
    """Whether a name is that of a file beside its meta.json, on any system."""
    return 0 < len(name) <= 128 and not set(name) & set('/\\:*?"<>|\0') and name.strip(".") != ""


def read_sog(source: Source, limits: Limits, report: ReadReport) -> GaussianScene:
    """Decode a bundle, or a meta.json with its images beside it. Raises BitstreamError."""
    bundle = _Bundle(source, limits)
    version = bundle.meta.get("version", 1)
    if version not in (1, 2):
        raise BitstreamError(f"{bundle.name}: version {version!r:.20} of SOG; 1 and 2 are read")
    report.version = str(version)
    count = _count(bundle, version)
    # An image has 4 bytes a texel and at most two texels a Gaussian; that of the SH palette has 2^22 bytes.
    bundle.largest = min(limits.max_output_bytes, 8 * count + (1 << 23))
    images = _checked_images(bundle, count)
    limits.check(count, decoded_bytes(count, 0), bundle.size, bundle.name)
    shared = {name: _texels(data, name, count) for name, data in images}
    low, high, scales, quats, sh0 = shared.values()
    return GaussianScene(
        means=_means(bundle, low, high),
        log_scales=_values(bundle, "scales", scales[:, :3], version),
        quats=_quats(quats, report),
        opacity_logits=_logits(bundle, sh0, version),
        sh_dc=_values(bundle, "sh0", sh0[:, :3], version),
        sh_rest=_sh_rest(bundle, count, version, images[0][1], limits, report),
        antialiased=bundle.meta.get("model") == "antialiased" or bundle.meta.get("antialias") is True,
        kind="2dgs" if bundle.meta.get("model") == "2dgs" else "default",
    )


def _count(bundle: _Bundle, version: int) -> int:
    most = LARGEST_SIDE**2
    if version == 2:
        return bundle.count(bundle.meta, "count", most)
    shape = bundle.part("means").get("shape")
    return bundle.count({"count": shape[0] if isinstance(shape, list) and shape else None}, "count", most)


def _checked_images(bundle: _Bundle, count: int) -> list[tuple[str, bytes]]:
    """The five images that have a texel for each Gaussian: of one size, and none larger than need be."""
    parts = {"means": 2, "scales": 1, "quats": 1, "sh0": 1}
    images = [each for part, number in parts.items() for each in bundle.images(part, number)]
    if len({name for name, _ in images}) < len(images):
        raise BitstreamError(f"{bundle.name}: meta.json names an image twice")
    sizes = {image_size(data, name) for name, data in images}
    if len(sizes) > 1:
        raise BitstreamError(f"{bundle.name}: its images have different sizes")
    _check_size(bundle.name, *sizes.pop(), count)
    return images


def _check_size(name: str, width: int, height: int, count: int) -> None:
    if not count <= width * height <= 2 * count + (1 << 16):
        raise BitstreamError(f"{name}: images of {width}x{height} do not fit {count:,} values")


def _texels(data: bytes, name: str, count: int) -> Pixels:
    return decode_image(data, name).reshape(-1, 4)[:count]


def _means(bundle: _Bundle, low: Pixels, high: Pixels) -> Array:
    """Undo the logarithm of both signs: y = sign(x) ln(1 + |x|)."""
    least, most = bundle.numbers("means", "mins", 3), bundle.numbers("means", "maxs", 3)
    if (most < least).any() or max(abs(least).max(), abs(most).max()) > LARGEST_LOGARITHM:
        raise BitstreamError(f"{bundle.name}: the bounds of 'means' make no sense")
    steps = (high[:, :3].astype(np.uint16) << 8 | low[:, :3]).astype(np.float64) / 65535
    y = least + (most - least) * steps
    return (np.sign(y) * np.expm1(np.abs(y))).astype(np.float32)


def _values(bundle: _Bundle, part: str, codes: Pixels, version: int) -> Array:
    if version == 2:
        return _looked_up(bundle.codebook(part), codes, bundle.name)
    channels = 4 if part == "sh0" else 3
    least, most = bundle.numbers(part, "mins", channels)[:3], bundle.numbers(part, "maxs", channels)[:3]
    return (least + (most - least) * (codes / 255.0)).astype(np.float32)


def _looked_up(codebook: Array, codes: Pixels, name: str) -> Array:
    if len(codebook) < 256 and codes.size and codes.max() >= len(codebook):
        raise BitstreamError(f"{name}: an image points beyond the {len(codebook)} entries of its codebook")
    return codebook[codes]


def _quats(texels: Pixels, report: ReadReport) -> Array:
    others = (texels[:, :3].astype(np.float32) / np.float32(127.5) - 1) / ROOT_2
    tags = texels[:, 3]
    quats = from_smallest_three(tags & 3, others)  # 252 is a multiple of 4
    wrong = tags < 252
    report.repaired("quats", int(wrong.sum()))
    quats[wrong] = (1, 0, 0, 0)
    return quats


def _logits(bundle: _Bundle, sh0: Pixels, version: int) -> Array:
    if version == 2:
        return logit_of_byte(sh0[:, 3])
    least, most = bundle.numbers("sh0", "mins", 4)[3], bundle.numbers("sh0", "maxs", 4)[3]
    logits = least + (most - least) * (sh0[:, 3] / 255.0)
    return np.clip(logits, -LARGEST_LOGIT, LARGEST_LOGIT).astype(np.float32)


def _sh_rest(bundle: _Bundle, count: int, version: int, first: bytes, limits: Limits, report: ReadReport) -> Array:
    if bundle.meta.get("shN") is None:
        return np.zeros((count, 0, 3), np.float32)
    (name, palette), (labels_name, labels_image) = bundle.images("shN", 2)
    width, height = image_size(palette, name)
    part = bundle.part("shN")
    if version == 2:
        k = BANDS[bundle.count(part, "bands", 3)]
        entries = bundle.count(part, "count", MAX_PALETTE)
    else:
        k = next((k for k in BANDS.values() if width == PALETTE_COLUMNS * k), 0)
        entries = min(PALETTE_COLUMNS * height, MAX_PALETTE)
    rows = math.ceil(entries / PALETTE_COLUMNS)
    if k == 0 or width != PALETTE_COLUMNS * k or not rows <= height <= 2 * rows + 8 or width > LARGEST_SIDE:
        raise BitstreamError(f"{name}: a palette of {width}x{height} does not hold {entries:,} entries")
    if image_size(labels_image, labels_name) != image_size(first, name):
        raise BitstreamError(f"{bundle.name}: its images have different sizes")
    limits.check(count, decoded_bytes(count, k), bundle.size, bundle.name)
    texels = decode_image(palette, name)[:rows, :, :3].reshape(-1, k, 3)[:entries]
    if version == 2:
        centroids = _looked_up(bundle.codebook("shN"), texels, bundle.name)
    else:
        least, most = bundle.numbers("shN", "mins", 1)[0], bundle.numbers("shN", "maxs", 1)[0]
        centroids = (least + (most - least) * (texels / 255.0)).astype(np.float32)
    codes = _texels(labels_image, labels_name, count)
    labels = codes[:, 0].astype(np.intp) | codes[:, 1].astype(np.intp) << 8
    beyond = labels >= len(centroids)
    if beyond.any():
        report.warnings.append(f"{int(beyond.sum()):,} Gaussians name no entry of the SH palette: theirs are zero")
        centroids = np.concatenate([centroids, np.zeros((1, k, 3), np.float32)])
        labels = np.where(beyond, len(centroids) - 1, labels)
    return centroids[labels]
