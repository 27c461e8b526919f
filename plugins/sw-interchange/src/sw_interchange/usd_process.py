"""A program of its own that reads the splats of an OpenUSD file: usd-core crashes on some damaged files.

    python usd_process.py FILE MEGABYTES SECONDS

FILE is named `.usd`, or `.usdz` for an archive. Standard output is one line of JSON, and after it the arrays of each
prim in the order that the line tells. A file that is refused gives the line {"refused": REASON}. Only usd-core and
numpy are imported, so that the process starts quickly.
"""

import json
import math
import posixpath
import signal
import sys
from collections.abc import Iterator
from typing import Any

import numpy as np

TYPE = "ParticleField3DGaussianSplat"
NOT_DRAWN = ("guide", "proxy")
"""Purposes of prims that stand for others."""
MAX_PRIMS = 1 << 10
WAITS = 4
"""Seconds of the clock for one of the processor: other programs run, too."""
LAYERS = (".usd", ".usda", ".usdc")
COLUMNS = {"positions": 3, "orientations": 4, "scales": 3, "opacities": 1}
SH, SH_DEGREE = "radiance:sphericalHarmonicsCoefficients", "radiance:sphericalHarmonicsDegree"


class RefusedError(Exception):
    """The reason why a file is not read."""


def main(path: str, megabytes: int, seconds: float) -> None:
    """Read a file within bounds on memory and time, and write what was found to standard output."""
    _bound_memory(megabytes << 20)
    from pxr import Sdf, Tf, Usd, UsdGeom, UsdVol  # noqa: F401  (loaded here, so that no file pays for it)

    _bound_time(seconds)
    try:
        told, arrays = _splats(path)
    except RefusedError as error:
        told, arrays = {"refused": str(error)}, []
    except (Tf.ErrorException, RuntimeError, ValueError) as error:
        reason = " ".join(str(error).split()).rpartition(" : ")[2].replace(path, "line ")
        told, arrays = {"refused": f"damaged: {reason[:200]}"}, []
    out = sys.stdout.buffer
    out.write(json.dumps(told).encode() + b"\n")
    for array in arrays:
        out.write(array.data)


def _bound_memory(memory: int) -> None:
    """Bound the memory, bytes, of this process; Windows has no such limit."""
    try:
        import resource
    except ImportError:
        return
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def _bound_time(seconds: float) -> None:
    """End this process after so much processor time, or WAITS times as long by the clock; Windows has no such timers.

    By the clock too, since usd-core may wait for ever where memory ends in one of its threads.
    """
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)
        signal.setitimer(signal.ITIMER_REAL, WAITS * seconds)


def _splats(path: str) -> tuple[dict[str, Any], list[Any]]:
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.FindOrOpen(path)
    if layer is None:
        raise RefusedError("damaged, or no OpenUSD")
    _check_references(path, layer)
    stage = Usd.Stage.Open(layer)
    _check_instances(stage)
    world = UsdGeom.XformCache(Usd.TimeCode.EarliestTime())
    prims, arrays, notes = [], [], []
    for prim in stage.Traverse():
        if prim.GetTypeName() != TYPE:
            continue
        if not _is_drawn(prim):
            notes.append(f"{prim.GetPath()} is invisible, or a guide or proxy, and is left out")
            continue
        if len(prims) == MAX_PRIMS:
            raise RefusedError(f"more than {MAX_PRIMS:,} prims with splats")
        columns, about = _columns(prim)
        place = np.array(world.GetLocalToWorldTransform(prim)).T  # its vectors are rows
        prims.append({**about, "name": str(prim.GetPath()), "place": place.tolist()})
        arrays += columns
    about = {"up": UsdGeom.GetStageUpAxis(stage), "meters": UsdGeom.GetStageMetersPerUnit(stage)}
    return {**about, "prims": prims, "notes": notes}, arrays


def _check_references(path: str, layer: Any) -> None:
    """Raise RefusedError if the file, or a layer inside of an archive, names a layer beyond it; none is opened."""
    from pxr import Sdf

    layers = {"": layer}
    members = set(Sdf.ZipFile.Open(path).GetFileNames()) if path.endswith(".usdz") else set()
    for name in sorted(members):
        if name.lower().endswith(LAYERS):
            layers[name] = Sdf.Layer.FindOrOpen(f"{path}[{name}]")
    for name, each in layers.items():
        if each is None:
            raise RefusedError(f"damaged: '{name}' inside")
        for asset in filter(None, each.GetCompositionAssetDependencies()):  # "": a prim of the same layer
            if posixpath.normpath(posixpath.join(posixpath.dirname(name), asset)) not in members:
                raise RefusedError(
                    f"names another file, '{asset[:60]}', which is not opened: flatten it (usdcat --flatten)"
                )


def _check_instances(stage: Any) -> None:
    roots = [each for each in stage.GetPrototypes() if any(prim.GetTypeName() == TYPE for prim in _below(each))]
    points = [prim for prim in stage.Traverse() if prim.GetTypeName() == "PointInstancer"]
    if roots or any(prim.GetTypeName() == TYPE for each in points for prim in _below(each)):
        raise RefusedError("its splats are instances, which are not read")


def _below(prim: Any) -> Iterator[Any]:
    from pxr import Usd

    return iter(Usd.PrimRange(prim))


def _is_drawn(prim: Any) -> bool:
    from pxr import UsdGeom

    about = UsdGeom.Imageable(prim)
    return about.ComputeVisibility() != "invisible" and about.ComputePurpose() not in NOT_DRAWN


def _columns(prim: Any) -> tuple[list[Any], dict[str, Any]]:
    """The five arrays of a prim as float32, and their number of rows, degree and marks."""
    found: dict[str, Any] = {name: _array(prim, name) for name in COLUMNS}
    if found["positions"] is None:
        raise RefusedError(f"{prim.GetPath()} has no positions")
    n = len(found["positions"])
    for name, width in COLUMNS.items():
        rows = None if found[name] is None else found[name].size // width
        if rows != n:
            raise RefusedError(
                f"{prim.GetPath()} has {'no' if rows is None else f'{rows:,}'} {name} for {n:,} positions"
            )
    degree = prim.GetAttribute(SH_DEGREE).Get()
    if type(degree) is not int or not 0 <= degree <= 4:
        raise RefusedError(f"{prim.GetPath()} has SH degree {degree!r:.20}; 0 to 4 are possible")
    needed, sh = 3 * n * (degree + 1) ** 2, _array(prim, SH)
    # The schema: what is longer is cut, what is shorter is no radiance, which is grey.
    has_sh = sh is not None and sh.size >= needed
    if sh is None or not has_sh:
        degree, sh, needed = 0, np.zeros(3 * n, np.float32), 3 * n
    columns = [*found.values(), sh.reshape(-1)[:needed]]
    marks = {key: prim.GetCustomDataByKey(key) for key in ("antialiased", "surfels")}
    return [np.ascontiguousarray(each) for each in columns], {
        "count": n, "degree": degree, "has_sh": has_sh, **{key: value is True for key, value in marks.items()},
    }  # fmt: skip


def _array(prim: Any, name: str) -> Any:
    """The values of an attribute at its first time, or of its twin of half precision; None if there are neither."""
    from pxr import Usd

    for each in (name, f"{name}h"):
        attribute = prim.GetAttribute(each)
        if attribute and attribute.HasAuthoredValue():
            values = attribute.Get(Usd.TimeCode.EarliestTime())
            if values is not None and len(values):
                return np.array(values, np.float32)
    return None


if __name__ == "__main__":
    main(sys.argv[1], math.ceil(float(sys.argv[2])), float(sys.argv[3]))
