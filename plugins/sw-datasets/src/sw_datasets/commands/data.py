"""`sw data`: scenes on disk."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import (
    OUTPUT_FOLDER,
    Choices,
    console,
    debug_option,
    json_option,
    options,
    print_json,
    say,
    set_option,
)
from sw_datasets.commands import completions
from sw_datasets.commands.fetch import fetch, registry_option

if TYPE_CHECKING:
    from sw_datasets.downloads.presence import ScenePresence
    from sw_datasets.downloads.registry import DataSet, DataSets
    from sw_datasets.verify import Verdict


@click.group(short_help="scenes on disk: list, verify, fetch, undistort, synth")
def data() -> None:
    """Scenes on disk."""


@data.command("list", short_help="the published data sets, and which of them are here")
@click.argument("dataset", required=False, shell_complete=completions.datasets)
@options(registry_option, json_option, debug_option)
def list_datasets(dataset: str | None, registry: str | None, as_json: bool) -> None:
    """The published data sets, and which scenes of them lie under $SPLATWIZARD_DATA; of one DATASET scene by scene.

    Checksum: "verified" if everything that is here was unpacked by `sw data fetch` from archives whose SHA-256 was
    pinned; "pinned" if nothing is here and the registry states the SHA-256 of what would be fetched.
    """
    from splatwizard_core.tooling import DATA_VARIABLE
    from sw_datasets.downloads.presence import data_root
    from sw_datasets.downloads.registry import load_registry

    known = load_registry(registry)
    # Without the variable everything is missing, and the folders show where it would go.
    named = bool(os.environ.get(DATA_VARIABLE))
    root = data_root() if named else Path(f"${DATA_VARIABLE}")
    facts = [_dataset_facts(root, known[name]) for name in ([dataset] if dataset is not None else known)]
    if as_json:
        print_json({"root": str(root) if named else None, "datasets": facts})
    elif dataset is not None:
        _print_one(facts[0])
    else:
        _print_all(root, facts)


def _dataset_facts(root: Path, dataset: DataSet) -> dict[str, Any]:
    from sw_datasets.downloads.presence import dataset_state, scene_presence

    scenes = [scene_presence(root, dataset, name) for name in dataset.scenes]
    return {
        "id": dataset.id,
        "title": dataset.title,
        "homepage": dataset.homepage,
        "licence": dataset.licence,
        "note": dataset.note,
        "registry": dataset.registry,
        "package": None if dataset.package is None else dataset.package.requirement,
        "state": dataset_state(root, dataset, scenes),
        "checksum": _checksum(dataset, scenes),
        "scenes": [_scene_facts(scene) for scene in scenes],
        "files": [
            {
                "name": file.name,
                "url": file.url,
                "size": file.size,
                "about": file.about,
                "sha256": file.sha256,
                "by_hand": file.by_hand,
                "scenes": list(dataset.scenes_of(file)),
            }
            for file in dataset.files
        ],
    }


def _scene_facts(scene: ScenePresence) -> dict[str, Any]:
    return {
        "name": scene.name,
        "state": scene.state,
        "path": str(scene.path),
        "lacking": list(scene.lacking),
        "verified": scene.verified,
    }


def _checksum(dataset: DataSet, scenes: list[ScenePresence]) -> str:
    """ "verified" or "unverified" of what is there; if nothing is, whether the registry pins what would be fetched."""
    there = [scene for scene in scenes if scene.state != "missing"]
    if not there:
        return "pinned" if dataset.files and all(file.sha256 for file in dataset.files) else "unverified"
    return "verified" if all(scene.verified for scene in there) else "unverified"


def _sizes(facts: dict[str, Any]) -> str:
    return "\n".join(
        f"{file['name']}: " + (f"{file['size']:,} bytes" if file["size"] else file["about"] or "not known")
        for file in facts["files"]
    )


def _print_all(root: Path, facts: list[dict[str, Any]]) -> None:
    from rich.markup import escape
    from rich.table import Table

    table = Table("data set", "here", "scenes", "checksum", "to fetch", "how")
    for entry in facts:
        scenes = entry["scenes"]
        there = sum(scene["state"] == "present" for scene in scenes)
        here = entry["state"] if not scenes or entry["state"] != "partly" else f"partly, {there} of {len(scenes)}"
        how = "by hand" if all(file["by_hand"] for file in entry["files"]) else f"sw data fetch {entry['id']}"
        names = ", ".join(scene["name"] for scene in scenes)
        row = (f"{entry['id']}\n{entry['title']}", here, names, entry["checksum"], _sizes(entry), how)
        table.add_row(*map(escape, row))
    out = console()
    out.print(table)
    there_is = "" if root.is_dir() else " (not set)" if not root.is_absolute() else " (no such folder yet)"
    out.print(escape(f"under {root}{there_is}; one data set scene by scene: sw data list DATASET"), soft_wrap=True)


def _print_one(facts: dict[str, Any]) -> None:
    from rich.markup import escape
    from rich.table import Table

    out = console()
    out.print(escape(f"{facts['id']}: {facts['title']}, {facts['state']}"), soft_wrap=True)
    licence = facts["licence"] or ("see the homepage" if facts["homepage"] else None)
    for name, value in (("homepage", facts["homepage"]), ("licence", licence), ("note", facts["note"])):
        if value:
            out.print(escape(f"{name}: {value}"), soft_wrap=True)
    for file in facts["files"]:
        size = f"{file['size']:,} bytes" if file["size"] else file["about"] or "size not known"
        pin = f"sha256 {file['sha256']}" if file["sha256"] else "no checksum published"
        hand = ", by hand" if file["by_hand"] else ""
        out.print(escape(f"file: {file['name']}, {size}, {pin}{hand}: {file['url']}"), soft_wrap=True)
    if facts["package"]:
        out.print(escape(f"where that cannot be reached: made from the package {facts['package']}"), soft_wrap=True)
    if not facts["scenes"]:
        return
    table = Table("scene", "here", "checksum", "folder")
    for scene in facts["scenes"]:
        here = scene["state"] + (f", without {', '.join(scene['lacking'])}" if scene["lacking"] else "")
        checksum = {None: "", True: "verified", False: "unverified"}[scene["verified"]]
        if scene["state"] != "missing" and scene["verified"] is None:
            checksum = "unverified"
        table.add_row(*map(escape, (scene["name"], here, checksum, scene["path"])))
    out.print(table)


@data.command(short_help="check the scenes that are here")
@click.argument(
    "targets", nargs=-1, metavar="[DATASET[/SCENE]|FOLDER]...", shell_complete=completions.dataset_or_folder
)
@options(
    click.option("--checksums", is_flag=True,
                 help="Compare the SHA-256 of every file with what `sw data fetch` unpacked, not its size alone."),
    click.option("--decode", is_flag=True, help="Decode every picture, not its header alone (minutes)."),
    registry_option, json_option, debug_option,
)  # fmt: skip
def verify(targets: tuple[str, ...], checksums: bool, decode: bool, registry: str | None, as_json: bool) -> None:
    """Check that scenes are whole: each loads, has its cameras and views, and every picture has a readable header.

    Without a name: every scene of the known data sets that lies under $SPLATWIZARD_DATA. Exit status 1 if anything is
    wrong, or if there is nothing to check.
    """
    from splatwizard_core.tooling import load_plugins
    from sw_datasets.downloads.registry import load_registry

    jobs = _verify_jobs(targets, load_registry(registry))
    plugins = load_plugins()
    verdicts = [_verify_one(job, plugins, checksums=checksums, decode=decode) for job in jobs]
    if as_json:
        print_json({"scenes": [{**vars(verdict), "whole": verdict.is_whole} for verdict in verdicts]})
    else:
        _print_verdicts(verdicts)
    if not verdicts and not as_json:
        say("nothing to check: `sw data list` shows what is where")
    if not verdicts or not all(verdict.is_whole for verdict in verdicts):
        raise click.exceptions.Exit(1)


def _verify_jobs(targets: tuple[str, ...], known: DataSets) -> list[tuple[str, Path, DataSet | None, bool]]:
    """(name, folder, data set or None, whether it is there at all) of every scene to check."""
    from splatwizard_core.api import UserInputError
    from sw_datasets.downloads.presence import data_root, scene_presence

    jobs: list[tuple[str, Path, DataSet | None, bool]] = []
    for target in targets or tuple(known):
        name, slash, scene = target.partition("/")
        if targets and name not in known:
            if not Path(target).is_dir():
                raise UserInputError(
                    f"'{target}' is neither a folder nor DATASET[/SCENE]; data sets: {', '.join(known)}"
                )
            jobs.append((target, Path(target), None, True))
            continue
        dataset = known[name]
        if slash:
            dataset.check_scene(scene)
        for one in [scene] if slash else dataset.scenes:
            found = scene_presence(data_root(), dataset, one)
            if targets or found.state != "missing":
                jobs.append((f"{name}/{one}", found.path, dataset, found.state != "missing"))
    return jobs


def _verify_one(job: tuple[str, Path, DataSet | None, bool], plugins: Any, *, checksums: bool, decode: bool) -> Verdict:
    from sw_datasets.downloads.presence import read_receipt
    from sw_datasets.verify import Verdict, verify_scene

    name, path, dataset, is_there = job
    if not is_there:
        return Verdict(name, str(path), problems=["not there"])
    if dataset is None:
        return verify_scene(name, path, plugins, checksums=checksums, decode=decode)
    receipt = read_receipt(path.parent, path.name)
    return verify_scene(
        name,
        path,
        plugins,
        family=dataset.folder,
        needs=dataset.needs,
        views=dataset.views,
        recorded=None if receipt is None else receipt["files"],
        checksums=checksums,
        decode=decode,
    )


def _print_verdicts(verdicts: list[Verdict]) -> None:
    from rich.markup import escape
    from rich.table import Table

    out = console()
    if verdicts:
        table = Table("scene", "", "train", "test", "cameras", "points", "pictures", "files on record")
        for v in verdicts:
            pictures = ", ".join(f"{folder} {count}" for folder, count in v.pictures.items())
            counts = (f"{n:,}" if n else "" for n in (v.train, v.test, v.cameras, v.points, v.recorded))
            train, test, cameras, points, recorded = counts
            verdict = "whole" if v.is_whole else "WRONG"
            table.add_row(escape(v.name), verdict, train, test, cameras, points, escape(pictures), recorded)
        out.print(table)
    for v in verdicts:
        for problem in v.problems:
            out.print(escape(f"{v.name}: {problem}"), soft_wrap=True)
        for warning in v.warnings:
            out.print(escape(f"{v.name}: note: {warning}"), soft_wrap=True)


data.add_command(fetch)


@data.command(short_help="a pinhole copy of a COLMAP scene with lens distortion")
@click.argument("scene", metavar="SCENE", type=click.Path(file_okay=False))
@click.argument("out", metavar="OUT", type=OUTPUT_FOLDER)
@options(
    click.option("--images", metavar="FOLDER", default="images", show_default=True,
                 help="Which picture folder of SCENE to undistort; OUT/images holds the result."),
    click.option("--quality", type=click.IntRange(1, 100), default=100, show_default=True, metavar="1..100",
                 help="Of JPEG pictures that are written."),
    json_option, debug_option,
)  # fmt: skip
def undistort(scene: str, out: Path, images: str, quality: int, as_json: bool) -> None:
    """Write a copy of the COLMAP scene SCENE without lens distortion into the new folder OUT: pinhole cameras, the
    same poses, points and image names, pictures (and masks) resampled and cut so that no black border is left.

    Needs the package pycolmap, the extra [pycolmap] of sw-datasets.
    """
    from sw_datasets.undistort import undistort_scene

    done = undistort_scene(Path(scene), out, images=images, quality=quality)
    facts = {"scene": scene, "folder": str(out), **vars(done)}
    if as_json:
        print_json(facts)
    else:
        click.echo(
            f"{done.images} images ({done.undistorted} undistorted), {done.masks} masks, "
            f"{done.cameras} pinhole cameras, {done.points:,} points: {out}"
        )


@data.command(short_help="write the procedural demo scene")
@click.argument("out", metavar="OUT", type=OUTPUT_FOLDER)
@options(
    click.option(
        "--size", type=click.Choice(["demo", "tiny"]), default="demo", show_default=True,
        help="demo: 72 views of 256x192 px; tiny: 8 views of 64x48 px.",
    ),
    click.option(
        "--format", "layout", type=click.Choice(["colmap", "blender"]), default="colmap", show_default=True,
        help="Folder layout; colmap keeps the start points, blender the split into train and test views.",
    ),
    click.option("--text", is_flag=True, help="COLMAP model as text.  [default: binary]"),
    set_option, json_option, debug_option,
)  # fmt: skip
def synth(out: Path, size: str, layout: str, text: bool, sets: tuple[str, ...], as_json: bool) -> None:
    """Write the procedural demo scene into the folder OUT, as a data set that any trainer reads.

    --set takes scene keys: resolution, test_every, background, split.
    """
    from splatwizard_core.api import UserInputError
    from splatwizard_core.tooling import load_plugins, load_scene
    from sw_datasets.write_scene import write_scene

    if out.exists() and any(out.iterdir()):
        raise UserInputError(f"{out} is not an empty folder: choose another one")
    scene_options = Choices(sets=sets).resolve_without_method().scene
    scene = load_scene("demo" if size == "demo" else f"demo:{size}", scene_options, load_plugins())
    say(f"drawing {len(scene.train) + len(scene.test)} views")
    write_scene(scene, out, layout, text=text)
    facts = {
        "folder": str(out),
        "layout": layout,
        "train_views": len(scene.train),
        "test_views": len(scene.test),
        "points": 0 if scene.points is None else len(scene.points),
        "split": scene.protocol.split,
    }
    if as_json:
        print_json(facts)
    else:
        # A COLMAP folder holds no split: who reads it by another rule tests other views.
        rule = f" by --set split={facts['split']}" if layout == "colmap" else ""
        click.echo(f"{facts['train_views']} train and {facts['test_views']} test views{rule} ({layout}): {out}")
