"""COLMAP sparse models, binary and text, read and written: cameras, images, points3D.

Little-endian; the layout stands beside each reader. The files come from strangers: every count is held against the
bytes that are there before anything is allocated, and damage is a SceneError that names file and offset or line.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from splatwizard_core.api import SceneError

MODELS = {
    0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 7: ("FOV", 5), 8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5), 10: ("THIN_PRISM_FISHEYE", 12), 11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4), 13: ("DIVISION", 5), 14: ("SIMPLE_FISHEYE", 3), 15: ("FISHEYE", 4), 16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}  # fmt: skip
"""Model id -> (name, number of parameters), of COLMAP 4."""

FEWEST_PARAMETERS = min(count for _, count in MODELS.values())

MODEL_IDS = {name: (model_id, count) for model_id, (name, count) in MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """Intrinsics as COLMAP keeps them: model name, size in pixels, the model's parameters in its own order."""

    id: int
    model: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image: x_camera = R(qvec) x + tvec.

    qvec        w, x, y, z
    name        as in the file, relative to the picture folder
    xys         [n,2] float64 keypoints, pixels
    point_ids   [n] int64 id of the 3D point each belongs to, -1 for none
    """

    id: int
    qvec: tuple[float, float, float, float]
    tvec: tuple[float, float, float]
    camera_id: int
    name: str
    xys: NDArray[np.float64]
    point_ids: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """Triangulated points.

    ids [P] int64 · xyz [P,3] float64 · rgb [P,3] uint8 · error [P] float64 px (mean reprojection error)
    track_start [P+1] int64, and track [T,2] int32 (image id, keypoint index): point i has rows start[i]:start[i+1]
    """

    ids: NDArray[np.int64]
    xyz: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    error: NDArray[np.float64]
    track_start: NDArray[np.int64]
    track: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model: cameras and images by id, in the order of the file, and the points."""

    cameras: dict[int, ColmapCamera]
    images: dict[int, ColmapImage]
    points: ColmapPoints


class _Bytes:
    """A file read front to back, with checks."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.data = path.read_bytes()
        except OSError as error:
            raise SceneError(f"{path} cannot be read: {error.strerror or error}", path=str(path)) from error
        self.at = 0

    def fail(self, what: str) -> NoReturn:
        raise SceneError(f"{self.path}: {what}", path=str(self.path))

    def need(self, size: int, what: str) -> int:
        """Offset of the next `size` bytes; moves past them."""
        start = self.at
        if size > len(self.data) - start:
            self.fail(f"truncated at byte {start} of {len(self.data)}: {what} needs {size} bytes")
        self.at = start + size
        return start

    def unpack(self, layout: str, what: str) -> tuple[int | float, ...]:
        return struct.unpack_from(layout, self.data, self.need(struct.calcsize(layout), what))

    def count(self, what: str, smallest: int) -> int:
        """A u64 count of records, each of at least `smallest` bytes."""
        start = self.need(8, f"the number of {what}")
        n: int = struct.unpack_from("<Q", self.data, start)[0]
        if n * smallest > len(self.data) - self.at:
            self.fail(
                f"truncated: {n} {what} at byte {start} need at least {n * smallest} bytes, "
                f"{len(self.data) - self.at} are left"
            )
        return n

    def end(self) -> None:
        if self.at != len(self.data):
            self.fail(f"{len(self.data) - self.at} bytes too many after the last record at byte {self.at}")


def read_model(folder: Path) -> ColmapModel:
    """The model in `folder`: the .bin files if there are any, else .txt. Without points3D it has no points.

    Raises SceneError naming the missing file, or the damaged one with offset or line.
    """
    paths: dict[str, Path | None] = {}
    for part in ("cameras", "images", "points3D"):
        found = [path for suffix in (".bin", ".txt") if (path := folder / (part + suffix)).is_file()]
        if not found and part != "points3D":
            raise SceneError(f"{folder}: {part}.bin (or .txt) is missing", path=str(folder))
        paths[part] = found[0] if found else None
    cameras, images = paths["cameras"], paths["images"]
    assert cameras is not None
    assert images is not None
    points = no_points() if paths["points3D"] is None else read_points(paths["points3D"])
    return ColmapModel(read_cameras(cameras), read_images(images), points)


def no_points() -> ColmapPoints:
    """The points of a model that has poses alone."""
    return ColmapPoints(
        np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(1, np.int64),
        np.zeros((0, 2), np.int32),
    )  # fmt: skip


def count_images(folder: Path) -> int:
    """The number of registered images that images.bin (or .txt) of a model claims; 0 where it cannot be read."""
    # Before they are opened: opening a pipe waits for a writer.
    binary, text = (path if path.is_file() else None for path in (folder / "images.bin", folder / "images.txt"))
    try:
        if binary is not None:
            with binary.open("rb") as file:
                return int.from_bytes(file.read(8), "little")
        lines = iter(() if text is None else _split_lines(text))
    except (OSError, SceneError):
        return 0
    count = 0
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            count += 1
            next(lines, None)  # its keypoints, on a line that may be empty
    return count


def read_cameras(path: Path) -> dict[int, ColmapCamera]:
    """cameras.bin: u64 count, then (i32 id, i32 model, u64 width, u64 height, f64 parameters); or cameras.txt."""
    cameras: dict[int, ColmapCamera] = {}
    if path.suffix == ".txt":
        for number, line in _text_lines(path):
            with _line(path, number):
                fields = line.split()
                name = fields[1]
                if name not in MODEL_IDS:
                    raise SceneError(
                        f"{path}, line {number}: unknown camera model '{name}', none of COLMAP's up to version 4",
                        path=str(path),
                    )
                params = tuple(float(x) for x in fields[4:])
                if len(params) != MODEL_IDS[name][1]:
                    raise ValueError(f"{name} has {MODEL_IDS[name][1]} parameters, not {len(params)}")
                camera = ColmapCamera(int(fields[0]), name, int(fields[2]), int(fields[3]), params)
            _once(camera.id, cameras, "camera", f"{path}, line {number}")
            cameras[camera.id] = camera
        return cameras
    reader = _Bytes(path)
    for i in range(reader.count("cameras", 24 + 8 * FEWEST_PARAMETERS)):
        camera_id, model, width, height = reader.unpack("<iiQQ", f"camera {i}")
        if model not in MODELS:
            reader.fail(
                f"unknown camera model {model} at byte {reader.at - 20}, none of COLMAP's up to version 4 "
                f"(0 to {max(MODELS)})"
            )
        name, n = MODELS[int(model)]
        params = reader.unpack(f"<{n}d", f"the parameters of camera {i}")
        _once(int(camera_id), cameras, "camera", str(path))
        cameras[int(camera_id)] = ColmapCamera(int(camera_id), name, int(width), int(height), tuple(map(float, params)))
    reader.end()
    return cameras


def read_images(path: Path) -> dict[int, ColmapImage]:
    """images.bin: u64 count, then (i32 id, 7 f64 q t, i32 camera id, name NUL, u64 n, n x (2 f64, i64)); or .txt."""
    if path.suffix == ".txt":
        return _read_images_text(path)
    images: dict[int, ColmapImage] = {}
    reader = _Bytes(path)
    for i in range(reader.count("images", 64 + 1 + 8)):
        image_id, *pose, camera_id = reader.unpack("<i7di", f"image {i}")
        end = reader.data.find(b"\0", reader.at)
        if end < 0:
            reader.fail(f"truncated at byte {reader.at} of {len(reader.data)}: the name of image {i} has no end")
        raw = reader.data[reader.at : end]
        try:
            name = raw.decode()
        except UnicodeDecodeError:
            reader.fail(f"the name of image {i} at byte {reader.at} is not UTF-8")
        reader.at = end + 1
        n = reader.count(f"keypoints of image {i}", 24)
        rows = np.frombuffer(reader.data, dtype=[("xy", "<f8", 2), ("id", "<i8")], count=n, offset=reader.at)
        reader.at += 24 * n
        q, t = [float(x) for x in pose[:4]], [float(x) for x in pose[4:]]
        _once(int(image_id), images, "image", str(path))
        images[int(image_id)] = ColmapImage(
            int(image_id), (q[0], q[1], q[2], q[3]), (t[0], t[1], t[2]), int(camera_id), name, rows["xy"], rows["id"]
        )
    reader.end()
    return images


def read_points(path: Path) -> ColmapPoints:
    """points3D.bin: u64 count, then (u64 id, 3 f64 xyz, 3 u8 rgb, f64 error, u64 track length, track x 2 i32)."""
    if path.suffix == ".txt":
        return _read_points_text(path)
    reader = _Bytes(path)
    count = reader.count("points", 51)
    starts = np.empty(count, np.int64)
    lengths = np.empty(count, np.int64)
    for i in range(count):
        starts[i] = reader.need(43, f"point {i}")
        lengths[i] = n = reader.count(f"track elements of point {i}", 8)
        reader.at += 8 * n
    reader.end()
    buffer = np.frombuffer(reader.data, np.uint8)
    fixed = buffer[starts[:, None] + np.arange(43)].view(
        np.dtype([("id", "<i8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
    )[:, 0]
    track_start = np.concatenate([np.zeros(1, np.int64), np.cumsum(lengths)])
    element = np.repeat(starts + 51 - 8 * track_start[:-1], lengths) + 8 * np.arange(track_start[-1])
    track = buffer[element[:, None] + np.arange(8)].view("<i4")
    _each_once(fixed["id"], path)
    return ColmapPoints(fixed["id"], fixed["xyz"], fixed["rgb"], fixed["error"], track_start, track)


def _once(found: int, earlier: Mapping[int, object], kind: str, where: str) -> None:
    """Two records of one id: which of them an image or a track means cannot be known."""
    if found in earlier:
        raise SceneError(f"{where}: {kind} id {found} occurs twice; the model is damaged")


def _each_once(ids: NDArray[np.int64], path: Path) -> None:
    unique, counts = np.unique(ids, return_counts=True)
    if len(unique) != len(ids):
        raise SceneError(f"{path}: point id {unique[counts > 1][0]} occurs twice; the model is damaged", path=str(path))


def write_model(model: ColmapModel, folder: Path, *, text: bool = False) -> None:
    """Write cameras, images and points3D into `folder` (made if need be), binary, or text with full precision.

    Raises SceneError for an image name that the format cannot hold.
    """
    folder.mkdir(parents=True, exist_ok=True)
    for image in model.images.values():
        unusable = "\0" in image.name or not image.name
        if text:
            unusable |= image.name != image.name.strip() or len(image.name.splitlines()) != 1
        if unusable:
            raise SceneError(f"image name {image.name!r} cannot be written to a COLMAP model")
    if text:
        _write_text(model, folder)
    else:
        _write_binary(model, folder)


def _write_binary(model: ColmapModel, folder: Path) -> None:
    parts = [struct.pack("<Q", len(model.cameras))]
    for camera in model.cameras.values():
        model_id = MODEL_IDS[camera.model][0]
        parts.append(struct.pack("<iiQQ", camera.id, model_id, camera.width, camera.height))
        parts.append(struct.pack(f"<{len(camera.params)}d", *camera.params))
    (folder / "cameras.bin").write_bytes(b"".join(parts))

    parts = [struct.pack("<Q", len(model.images))]
    for image in model.images.values():
        parts.append(struct.pack("<i7di", image.id, *image.qvec, *image.tvec, image.camera_id))
        rows = np.empty(len(image.xys), dtype=[("xy", "<f8", 2), ("id", "<i8")])
        rows["xy"], rows["id"] = image.xys, image.point_ids
        parts += [image.name.encode(), b"\0", struct.pack("<Q", len(rows)), rows.tobytes()]
    (folder / "images.bin").write_bytes(b"".join(parts))

    points = model.points
    parts = [struct.pack("<Q", len(points))]
    for i in range(len(points)):
        track = points.track[points.track_start[i] : points.track_start[i + 1]].astype("<i4")
        parts.append(
            struct.pack(
                "<Q3d3BdQ", int(points.ids[i]), *points.xyz[i], *points.rgb[i].tolist(), points.error[i], len(track)
            )
        )
        parts.append(track.tobytes())
    (folder / "points3D.bin").write_bytes(b"".join(parts))


def _write_text(model: ColmapModel, folder: Path) -> None:
    def numbers(values: object) -> str:
        return " ".join(repr(x) for x in np.asarray(values, dtype=np.float64).ravel().tolist())

    lines = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"]
    lines += [f"{c.id} {c.model} {c.width} {c.height} {numbers(c.params)}" for c in model.cameras.values()]
    _write_lines(folder / "cameras.txt", lines)

    lines = ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, then POINTS2D[] as X Y POINT3D_ID"]
    for image in model.images.values():
        lines.append(f"{image.id} {numbers(image.qvec)} {numbers(image.tvec)} {image.camera_id} {image.name}")
        keypoints = zip(image.xys.tolist(), image.point_ids.tolist(), strict=True)
        lines.append(" ".join(f"{x!r} {y!r} {point}" for (x, y), point in keypoints))
    _write_lines(folder / "images.txt", lines)

    lines = ["# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"]
    points = model.points
    for i in range(len(points)):
        track = points.track[points.track_start[i] : points.track_start[i + 1]].ravel().tolist()
        r, g, b = points.rgb[i].tolist()
        fields = [str(int(points.ids[i])), numbers(points.xyz[i]), f"{r} {g} {b}", numbers(points.error[i])]
        lines.append(" ".join(fields + [str(x) for x in track]))
    _write_lines(folder / "points3D.txt", lines)


def _write_lines(path: Path, lines: list[str]) -> None:
    path.write_bytes(("\n".join(lines) + "\n").encode())


class _line:  # noqa: N801 (a context manager that reads like a statement)
    """Turns what int(), float() and indexing raise on a malformed line into a SceneError naming the line."""

    def __init__(self, path: Path, number: int) -> None:
        self.path, self.number = path, number

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, (ValueError, IndexError, OverflowError)):
            raise SceneError(
                f"{self.path}, line {self.number}: damaged record ({error})", path=str(self.path)
            ) from error


def _split_lines(path: Path) -> list[str]:
    try:
        text = path.read_bytes().decode("utf-8-sig")  # some editors of Windows begin a file with a mark
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: not UTF-8 text at byte {error.start}", path=str(path)) from error
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror or error}", path=str(path)) from error
    return [line.rstrip("\r") for line in text.split("\n")]


def _text_lines(path: Path) -> list[tuple[int, str]]:
    """(line number, line) of everything that is neither blank nor a comment."""
    return [(i, s) for i, s in enumerate(_split_lines(path), 1) if s.strip() and not s.lstrip().startswith("#")]


def _read_images_text(path: Path) -> dict[int, ColmapImage]:
    images: dict[int, ColmapImage] = {}
    lines = _split_lines(path)
    i = 0
    while i < len(lines):
        line, number = lines[i].strip(), i + 1
        i += 1
        if not line or line.startswith("#"):
            continue
        # The line after an image holds its keypoints and may be empty; at the end of the file it may be missing.
        keypoints = lines[i].split() if i < len(lines) else []
        i += 1
        with _line(path, number):
            fields = line.split(maxsplit=9)
            q, t = [float(x) for x in fields[1:5]], [float(x) for x in fields[5:8]]
            image_id, camera_id, name = int(fields[0]), int(fields[8]), fields[9]
        with _line(path, number + 1):
            if len(keypoints) % 3:
                raise ValueError(f"{len(keypoints)} numbers are not triples of x, y, point id")
            xys = np.array([float(x) for k, x in enumerate(keypoints) if k % 3 != 2]).reshape(-1, 2)
            ids = np.array([int(x) for x in keypoints[2::3]], dtype=np.int64)
        _once(image_id, images, "image", f"{path}, line {number}")
        images[image_id] = ColmapImage(
            image_id, (q[0], q[1], q[2], q[3]), (t[0], t[1], t[2]), camera_id, name, xys, ids
        )
    return images


def _read_points_text(path: Path) -> ColmapPoints:
    ids, xyz, rgb, error, track = [], [], [], [], []
    starts = [0]
    for number, line in _text_lines(path):
        with _line(path, number):
            fields = line.split()
            ids.append(np.int64(fields[0]))
            xyz.append([float(x) for x in fields[1:4]])
            colour = [int(x) for x in fields[4:7]]
            if len(xyz[-1]) != 3 or len(colour) != 3 or not all(0 <= c <= 255 for c in colour):
                raise ValueError("a colour is three numbers in 0..255")
            rgb.append(colour)
            error.append(float(fields[7]))
            if len(fields) % 2:
                raise ValueError("a track is pairs of image id and keypoint index")
            track += np.array(fields[8:], dtype=np.int32).reshape(-1, 2).tolist()
            starts.append(len(track))
    _each_once(np.array(ids, dtype=np.int64), path)
    return ColmapPoints(
        np.array(ids, dtype=np.int64),
        np.array(xyz, dtype=np.float64).reshape(-1, 3),
        np.array(rgb, dtype=np.uint8).reshape(-1, 3),
        np.array(error, dtype=np.float64),
        np.array(starts, dtype=np.int64),
        np.array(track, dtype=np.int32).reshape(-1, 2),
    )
