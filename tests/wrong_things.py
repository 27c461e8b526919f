"""The things that tests/test_wrong_input.py hands to `sw`: sound ones, and copies of them with one thing wrong."""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable
from pathlib import Path

from sw_gaussians.start import gaussians_from_points

from splatwizard_core.cli.main import main

STEPS = 2
PRUNED = """
from splatwizard_core.plugins import hookimpl


@hookimpl
def register_methods(registry):
    registry.add("pruned", "sw_pruned:Pruned", summary="starts from a trained 3dgs scene")
    registry.add("plain", "sw_pruned:Plain", summary="starts from nothing")


def __getattr__(name):
    from splatwizard_core.method import Method
    from splatwizard_core.training.stage import Stage

    class FromTrained(Stage):
        starts_from = "3dgs"

    class Plain(Method):
        def stages(self):
            return [Stage(self.config)]

    class Pruned(Method):
        def stages(self):
            return [FromTrained(self.config)]

    Plain.name, Pruned.name = "plain", "pruned"
    try:
        return {"Plain": Plain, "Pruned": Pruned}[name]
    except KeyError:
        raise AttributeError(name) from None
"""


def make_things(root: Path) -> None:
    """Fill `root`; every name in it can stand in braces in the table."""
    make_files(root)
    make_scenes(root)
    make_models(root)
    make_runs(root)
    make_strangers(root)
    make_locked(root)


def sw(*arguments: object) -> None:
    assert main([str(a) for a in arguments]) == 0, arguments


def make_files(root: Path) -> None:
    (root / "notes.txt").write_text("hello")
    (root / "empty.swz").write_bytes(b"")
    (root / "empty.ply").write_bytes(b"")
    (root / "folder").mkdir()
    (root / "folder" / "note").write_text("not empty")
    (root / "hollow").mkdir()
    for name, text in {
        "broken.toml": "iterations = = 3\n",
        "typo.toml": "itertions = 3\n",
        "value.toml": "iterations = -3\n",
        "binary.toml": "\udcff\udcfe",
        "name.toml": "method = 3\n",
        "other.toml": 'method = "3dgs"\nrate = "r1"\n',
        "deep.toml": "[densify]\ngrad_treshold = 1e-4\n",
    }.items():
        (root / name).write_bytes(text.encode("utf-8", errors="surrogateescape"))


def copied(source: Path, name: str) -> Path:
    return Path(shutil.copytree(source, source.parent / name))


def make_scenes(root: Path) -> None:
    from sw_datasets.write_scene import write_scene

    from splatwizard_core.plugins import load_plugins
    from splatwizard_core.scene.dataset import SceneOptions
    from splatwizard_core.scene.loading import load_scene

    scene, blender = root / "scene", root / "blender"
    drawn = load_scene("demo:tiny", SceneOptions(), load_plugins())
    write_scene(drawn, scene, "colmap")
    write_scene(drawn, blender, "blender")
    model = Path("sparse/0")
    cut(copied(scene, "cut-cameras") / model / "cameras.bin")
    cut(copied(scene, "cut-images") / model / "images.bin")
    cut(copied(scene, "cut-points") / model / "points3D.bin")
    (copied(scene, "no-images-bin") / model / "images.bin").unlink()
    huge = copied(scene, "huge") / model / "images.bin"
    huge.write_bytes(struct.pack("<Q", 2**60) + huge.read_bytes()[8:])
    pictures = copied(scene, "corrupt") / "images"
    first = sorted(pictures.iterdir())[0]
    first.write_bytes(first.read_bytes()[:100])
    sorted((copied(scene, "lost-picture") / "images").iterdir())[2].unlink()
    shutil.rmtree(copied(scene, "no-pictures") / "images")
    shutil.copytree(scene / "images", root / "photos")

    transforms = Path("transforms_train.json")
    (copied(blender, "bad-json") / transforms).write_text("{")
    for name, change in {
        "no-angle": lambda t: t.pop("camera_angle_x"),
        "nan-pose": lambda t: t["frames"][0].update(transform_matrix=[[float("nan")] * 4] * 4),
        "no-frames": lambda t: t.update(frames=[]),
        "lost-frame": lambda t: t["frames"][0].update(file_path="./train/none"),
    }.items():
        path = copied(blender, name) / transforms
        content = json.loads(path.read_text())
        change(content)
        path.write_text(json.dumps(content))
    (copied(blender, "no-test") / "transforms_test.json").unlink()

    data = root / "data"
    (data / "park").mkdir(parents=True)
    shutil.copytree(scene, data / "park" / "tree")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def make_models(root: Path) -> None:
    """grey.ply, grey.swz and what can be wrong with such."""
    import torch
    from sw_gaussians.ply import export_ply

    from splatwizard_core.coding.container import ContainerWriter
    from splatwizard_core.scene.scene import PointCloud

    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    ply = root / "grey.ply"
    export_ply(gaussians_from_points(PointCloud(points, torch.full((40, 3), 0.5)), max_sh_degree=1), ply)
    content = ply.read_bytes()
    head, _, body = content.partition(b"end_header\n")
    (root / "cut.ply").write_bytes(content[:-50])
    (root / "mesh.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\n"
        "property float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"
    )
    (root / "huge.ply").write_bytes(head.replace(b"vertex 40", b"vertex 4000000000") + b"end_header\n" + body)
    (root / "text.ply").write_text("hello")
    damaged = gaussians_from_points(PointCloud(points, torch.full((40, 3), 0.5)), max_sh_degree=1)
    with torch.no_grad():
        damaged.means[:, 1] = float("nan")
    export_ply(damaged, root / "nan.ply")
    (root / "trained" / "point_cloud").mkdir(parents=True)
    shutil.copyfile(ply, root / "trained" / "point_cloud" / "point_cloud.ply")

    sw("encode", ply, "--method", "3dgs", "--out", root / "grey.swz", "--set", "raster.prefer=reference")
    swz = (root / "grey.swz").read_bytes()
    (root / "cut.swz").write_bytes(swz[: len(swz) // 2])
    (root / "head.swz").write_bytes(swz[:7])
    (root / "flipped.swz").write_bytes(swz[:-9] + bytes([swz[-9] ^ 255]) + swz[-8:])
    (root / "newer.swz").write_bytes(swz[:4] + struct.pack("<H", 9) + swz[6:])
    (root / "text.swz").write_text("hello")
    writer = ContainerWriter("method-from-mars", 1)
    writer.write(root / "mars.swz")
    later = ContainerWriter("3dgs", 99)
    later.write(root / "later.swz")
    ContainerWriter("3dgs", 1).write(root / "hollow.swz")


def make_runs(root: Path) -> None:
    """run/r3, a run of a few steps, and copies of that directory with one thing wrong: each has no neighbour."""
    out = root / "out"
    sets = [f"iterations={STEPS}", "checkpoint_every=1", "keep_checkpoints=9", "raster.prefer=reference"]
    sw("train", "--scene", "demo:tiny", "--out", out, *(word for pair in sets for word in ("--set", pair)))
    (run,) = (path.parent for path in out.glob("*/*/*/config.toml"))
    shutil.move(run.parent, root / "run")
    shutil.rmtree(out)

    def changed(name: str, change: Callable[[Path], object]) -> None:
        change(copied(root / "run", name) / run.name)

    changed("no-config", lambda run: (run / "config.toml").unlink())
    changed("bad-config", lambda run: (run / "config.toml").write_text("method = "))
    changed("typo-config", lambda run: (run / "config.toml").write_text("itertions = 4\n"))
    changed("unfinished", lambda run: (run / "steps.json").unlink())
    changed("bad-record", lambda run: (run / "metrics.json").write_text('{"schema": '))
    changed("bad-steps", lambda run: (run / "steps.json").write_text("{"))
    shutil.copytree(root / "run", root / "out-run" / "demo-tiny" / "3dgs")  # where `sw train --out` looks for it


def make_strangers(root: Path) -> None:
    """site: distributions that a stranger installed. None of them is sound but sw-pruned."""
    site = root / "site"
    adds = """
from splatwizard_core.plugins import hookimpl

@hookimpl
def register_{kind}s(registry):
    registry.add("{name}", "{module}:thing", summary="none", direction="higher")
"""
    for distribution, source in {
        "sw-bad": "import no_such_library",
        "sw-late": adds.format(kind="method", name="late", module="no_such_module"),
        "sw-one": adds.format(kind="metric", name="twice", module="sw_one"),
        "sw-two": adds.format(kind="metric", name="twice", module="sw_two"),
        "sw-pruned": PRUNED,
    }.items():
        module = distribution.replace("-", "_")
        info = site / f"{module}-1.0.dist-info"
        info.mkdir(parents=True)
        (site / f"{module}.py").write_text(source)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {distribution}\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[splatwizard]\n{distribution[3:]} = {module}\n")


def make_locked(root: Path) -> None:
    """Sound things that their owner may not read or write."""
    for name in ("grey.swz", "grey.ply", "other.toml"):
        locked = root / f"locked{Path(name).suffix}"
        shutil.copyfile(root / name, locked)
        locked.chmod(0)
    (root / "read-only").mkdir()
    (root / "read-only").chmod(0o555)
