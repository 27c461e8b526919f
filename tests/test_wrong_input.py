"""Wrong input to every command: one or two lines that name it, exit status 2 (1 for a failure), nothing written.

A row: the command line with names of tests/wrong_things.py in braces; what must be in stderr; the exit status; what
differs in the environment. `{new}` is a path that does not exist, `{nowhere}` one whose folder does not exist either.
"""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import torch
from forked_children import run_python
from wrong_things import make_things

from splatwizard_core.cli.main import command_entries, main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.plugins.catalogue import is_ours

pytest.importorskip("sw_3dgs", reason="the rows need a method")


@dataclass(frozen=True)
class Row:
    line: str
    told: str
    status: int = 2
    env: dict[str, str] = field(default_factory=dict)
    root: bool = True  # False: the system refuses root nothing, so the row is for other users

    def __str__(self) -> str:
        return self.line + "".join(f" [{k}={v}]" for k, v in self.env.items())


ROWS = [
    # The command line itself.
    Row("rum", "no command 'rum': did you mean 'run'?"),
    Row("xyzzy", "no command 'xyzzy': installed: run, bench, train, "),
    Row("data lsit", "No such command 'lsit'"),
    Row("run --sceen demo", "No such option '--sceen'"),
    Row("run extra", "unexpected extra argument"),
    Row("encode", "Missing argument 'SOURCE'"),
    Row("completion tcsh", "'tcsh' is not one of 'bash', 'zsh', 'fish'"),
    Row("doctor --quick", "No such option '--quick'"),
    Row("list-plugins 3dgs", "unexpected extra argument"),
    # Names: methods, presets, rate points, metrics, rasterizers, exporters, plugins.
    Row("run --method 3dsg", "no method is called '3dsg'; did you mean '3dgs'?"),
    Row("run --method ,", "--method is empty"),
    Row("train --method hca", "no method is called 'hca'"),
    Row("schedule 3dg", "did you mean '3dgs'?"),
    Row("run --rate r9", "has no rate point 'r9': one of r1, r2"),
    Row("run --rate r1,", "no rate point ''"),
    Row("run --rate midium", "no rate point 'midium'"),
    Row("train --rate all", "takes one method and one rate point"),
    Row("run --method hac --rate all --size 5MB", "--rate all with --size 5MB would make one file again and again"),
    Row("run --preset quik", "no preset 'quik': one of paper"),
    Row("eval {grey.swz} --scene demo:tiny --metrics pnsr", "no metric is called 'pnsr'; did you mean 'psnr'?"),
    Row("eval {grey.swz} --scene demo:tiny --metrics ,", "--metrics is empty"),
    Row("run --scene demo:tiny --set raster.prefer=standrad", "no rasterizer is called 'standrad'"),
    Row("render {grey.swz} --scene demo:tiny --set raster.forbid=refrence", "did you mean 'reference'?"),
    Row("eval {grey.swz} --scene demo:tiny", "no rasterizer is called 'nix'", env={"SW_RASTERIZER": "nix"}),
    Row("export {grey.swz} {new} --format pyl", "no exporter is called 'pyl'; did you mean 'ply'?"),
    Row("export {grey.swz} {new}.xyz", "no installed exporter writes '.xyz' files"),
    Row("export {grey.swz} {new}.swz", "`sw compress` writes .swz"),
    Row("export {grey.swz} {grey.swz}", "is the file that is read: give OUT another name"),
    Row("decode {grey.swz} --out {new}.xyz", "no installed exporter writes '.xyz' files"),
    Row("list-plugins", "SW_PLUGINS names 'nix', which is not installed", env={"SW_PLUGINS": "nix"}),
    Row("run --scene demo:tiny", "no method is named, and the default one is not there", env={"SW_PLUGINS": ""}),
    Row("run --scene demo:tiny --method 3dgs", "no method is called '3dgs'", env={"SW_PLUGINS": ""}),
    # Keys and values.
    Row("run --set itertions=3", "unknown key 'itertions' in --set: did you mean 'iterations'?"),
    Row("train --set densify.grad_treshold=1", "did you mean 'density.settings.grad_threshold'?"),
    Row("schedule 3dgs --set lr.opacty=1", "did you mean 'lr.opacity'?"),
    Row("schedule 3dgs --set lr.xyzzy=1", "'lr' has beta2, max_steps, opacity, position_delay_mult"),
    Row("info demo:tiny --set resolutoin=3", "did you mean 'resolution'?"),
    Row("run --set iterations", "--set needs key=value, got 'iterations'"),
    Row("run --set =3", "--set needs key=value, got '=3'"),
    Row("run --set iterations=-3", "bad value '-3' for 'iterations'"),
    Row("run --set iterations=many", "bad value 'many' for 'iterations'"),
    Row("run --set iterations=1e400", "bad value '1e400' for 'iterations'"),
    Row("run --set lr.opacity=nan", "bad value 'nan' for 'lr.opacity'"),
    Row("run --set lr.opacity=-1", "bad value '-1' for 'lr.opacity'"),
    Row("run --set loss.lambda_dssim=2", "bad value '2' for 'loss.lambda_dssim'"),
    Row("run --set threads=-1", "bad value '-1' for 'threads'"),
    Row("run --set background=puce", "expected one of black, white"),
    Row("run --set seed=1 --seed 2", "--seed 2 contradicts --set seed=1"),
    Row("run --seed -1", "Invalid value for '--seed'"),
    Row("run --seed x", "'x' is not a valid integer"),
    Row("run --gaussians 0", "Invalid value for '--gaussians': 0 is not in the range x>=1"),
    Row("run --method 3dgs --scene demo:tiny --rate r1,r2 --size 1MB", "would make one file again and again"),
    Row("run --device tpu", "'tpu' is not one of 'auto', 'cpu', 'cuda'"),
    Row("run --repeats 0", "Invalid value for '--repeats'"),
    Row("decode {grey.swz} --repeats -1", "Invalid value for '--repeats'"),
    Row("mesh {grey.swz} --scene demo:tiny --depth ratio=2", "must be expected, median, or ratio=R with R in 0..1"),
    Row("render {grey.swz} --views some", "'some' is not one of 'test', 'train', 'all'"),
    Row("bake {grey.swz} {new}.ply --scene demo:tiny", "explicit already"),
    Row("bake {grey.swz} {new}.ply --sh-degree 4", "4 is not in the range 0<=x<=3"),
    Row("render {grey.swz} --trajectory orbti", "'orbti' is none of orbit, spiral, cameras, and no file"),
    Row("render {grey.swz} --video {new}.mp4", "are for --trajectory"),
    Row("render {grey.swz} --scene demo:tiny --trajectory {notes.txt}", "not a JSON file of cameras"),
    Row("build-kernels --jobs 0", "Invalid value for '--jobs'"),
    Row("new-plugin 'a b' --into {new}", "'a b'"),
    Row("check-plugin sw-nothing", "sw-nothing"),
    Row("data synth {new} --size huge", "'huge' is not one of 'demo', 'tiny'"),
    Row("eval {grey.swz} --scene demo:tiny --set iterations=3", "of no use here"),
    # Devices.
    Row("run --scene demo:tiny --device cuda", "torch sees no CUDA device here; use --device cpu"),
    Row("decode {grey.swz} --packets 0", "Invalid value for '--packets'"),
    Row("decode {grey.swz} --packets 1", "it declares no cuts"),
    Row("decode {grey.swz} --bytes much", "'much' is no size: give bytes"),
    Row("decode {grey.swz} --bytes 1MB --packets 1", "each choose a cut: give one of them"),
    Row("truncate {grey.swz} --packets 1 --size 1MiB --out {new}.swz", "each choose a cut: give one of them"),
    Row("truncate {grey.swz} --packets 1 --out {new}.swz", "it declares no cuts"),
    Row("decode {grey.swz} --hash --out {new}.ply", "leave out --out and --json"),
    Row("compress {grey.swz} --size much --out {new}.swz", "'much' is no size"),
    Row("compress {grey.swz} --size 300 kB --out {new}.swz", "has a blank in it: write 300kB"),
    Row("compress {grey.swz} --size 300 KiB --out {new}.swz", "has a blank in it: write 300KiB"),
    Row("run --scene demo:tiny --size 5 MB", "has a blank in it: write 5MB"),
    Row("compress {grey.swz} --size=300 kB --out {new}.swz", "--size 300 kB has a blank in it: write 300kB"),
    Row("run --scene demo:tiny --size=5 MB", "has a blank in it: write 5MB"),
    Row("lod {grey.swz} --out {new}.swz --levels 3", "--levels"),
    Row("lod {cut.ply} --out {new}/lod-meta.json", "cut.ply"),
    Row("lod {grey.swz} --out {new}/lod-meta.json --chunk 8mb", "no number of Gaussians"),
    Row("compress {cut.ply} --size 1MB --out {new}.swz", "cut.ply"),
    Row("truncate {grey.swz} --out {new}.swz", "give --packets P, --size SIZE or --partial"),
    Row("truncate {cut.swz} --partial --out {new}.swz", "truncated"),
    Row("truncate {grey.swz} --packets 1 --out {folder}", "is a folder: give the name of a file in it"),
    Row("decode {grey.swz} --device cuda", "torch sees no CUDA device here"),
    Row("encode {grey.ply} --out {new}.swz --device cuda", "torch sees no CUDA device here"),
    # Configuration files.
    Row("run --config {nowhere}", "cannot read --config {nowhere}: No such file"),
    Row("run --config {folder}", "is a directory"),
    Row("run --config {broken.toml}", "broken.toml is not valid TOML: "),
    Row("run --config {binary.toml}", "binary.toml is not valid TOML: "),
    Row("train --config {typo.toml}", "unknown key 'itertions' in {typo.toml}: did you mean 'iterations'?"),
    Row("train --config {deep.toml}", "did you mean 'density.settings.grad_threshold'?"),
    Row("run --config {value.toml}", "bad value -3 for 'iterations' in {value.toml}"),
    Row("run --config {name.toml}", "expected a name"),
    Row("train --config {other.toml} --rate r2", "was written for rate 'r1', not 'r2'"),
    Row("eval {grey.swz} --config {broken.toml}", "is not valid TOML"),
    # Scenes.
    Row("run --scene {nowhere}", "scene '{nowhere}' is not there"),
    Row("info park/tree", "$SPLATWIZARD_DATA is not set"),
    Row("run --scene park/trea", "did you mean 'tree'?", env={"SPLATWIZARD_DATA": "{data}"}),
    Row("run --scene prak/tree", "did you mean 'park'?", env={"SPLATWIZARD_DATA": "{data}"}),
    Row("run --scene park/tree", "names no folder", env={"SPLATWIZARD_DATA": "{nowhere}"}),
    Row("run --scene {notes.txt}", "is a file, not a scene folder"),
    Row("run --scene {hollow}", "is not a scene of a known family"),
    Row("run --scene {photos}", "holds pictures but no camera poses"),
    Row("train --scene ''", "--scene is empty"),
    Row("info ''", "PATH is empty"),
    Row("info {notes.txt}", "no file that `sw info` can read: .swz, metrics.json, "),
    Row("run --scene demo:giant", "demo"),
    Row("run --scene colmap:{blender}", "cameras"),
    Row("run --scene {scene} --images images_3", "images_3"),
    Row("info {cut-cameras}", "cameras.bin"),
    Row("train --scene {cut-images}", "images.bin"),
    Row("run --scene {cut-points}", "points3D.bin"),
    Row("run --scene {no-images-bin}", "images"),
    Row("run --scene {huge}", "images.bin"),
    Row("run --scene {no-pictures}", "images"),
    Row("train --scene {lost-picture}", "1 of 8 images are missing: 'view_002.png'"),
    Row("run --scene {corrupt}", "view_000.png: the picture cannot be decoded"),
    Row(
        "eval {grey.swz} --scene {corrupt} --metrics psnr --set raster.prefer=reference",
        "view_000.png: the picture cannot be decoded",
    ),
    Row("info {bad-json}", "transforms_train.json"),
    Row("run --scene {no-angle}", "camera_angle_x"),
    Row("run --scene {nan-pose}", "is not finite"),
    Row("run --scene {no-frames}", "has 0 views to train"),
    Row("run --scene {lost-frame}", "1 of 6 images are missing: 'train/none.png'"),
    Row("run --scene {scene} --set test_every=0", "n must be at least 2"),
    Row("run --scene {scene} --set split=sometimes", "split"),
    Row("run --scene {scene} --set resolution=0", "resolution"),
    Row("render {grey.swz} --scene {photos}", "no camera poses"),
    # Files that were encoded, and .ply.
    Row("decode {nowhere}", "there is no such file or folder"),
    Row("decode {folder}", "is a folder, and this command takes a file"),
    Row("decode {empty.swz}", "empty.swz"),
    Row("decode {text.swz}", "not a .swz file"),
    Row("decode {head.swz}", "head.swz"),
    Row("decode {cut.swz}", "truncated"),
    Row("decode {flipped.swz}", "flipped.swz"),
    Row("decode {newer.swz}", "newer.swz"),
    Row("decode {mars.swz}", "'method-from-mars', which is not installed: install the package that provides it"),
    Row("decode {later.swz}", "newer than"),
    Row("decode {hollow.swz}", "hollow.swz"),
    Row("info {cut.swz}", "truncated"),
    Row("info {nowhere}.swz", "there is no such file"),
    Row("eval {mars.swz} --scene demo:tiny", "method-from-mars"),
    Row("eval {notes.txt} --scene demo:tiny", "not a .swz file"),
    Row("render {flipped.swz} --scene demo:tiny", "flipped.swz"),
    Row("export {cut.swz} {new}.ply", "truncated"),
    Row("info {empty.ply}", "empty.ply"),
    Row("info {text.ply}", "text.ply"),
    Row("export {cut.ply} {new}.ply", "cut.ply"),
    Row("encode {mesh.ply} --out {new}.swz", "mesh.ply"),
    Row("encode {huge.ply} --out {new}.swz", "huge.ply"),
    Row("encode {notes.txt} --out {new}.swz", "takes a run directory or a .ply"),
    # Run directories.
    Row("encode {hollow} --out {new}.swz", "config.toml"),
    Row("encode {no-config}/r3 --out {new}.swz", "config.toml: there is no such file"),
    Row("encode {bad-config}/r3 --out {new}.swz", "is not valid TOML"),
    Row("encode {typo-config}/r3 --out {new}.swz", "did you mean 'iterations'?"),
    Row("encode {unfinished}/r3 --out {new}.swz", "holds no finished training"),
    Row("encode {bad-steps}/r3 --out {new}.swz", "holds no finished training"),
    Row("encode {run}/r3 --out {new}.swz --rate r9", "no rate point 'r9'"),
    Row("encode {run}/r3 --out {new}.swz --set lr.opacity=1", "holds no finished training"),
    Row("eval {hollow}", "config.toml"),
    Row("eval {unfinished}/r3", "holds no finished training"),
    Row("train --scene demo:tiny --out {out-run} --set iterations=3", "--fresh"),
    Row("eval {grey.swz} --roundtrip", "--roundtrip is for a run directory"),
    # What strangers install.
    Row("schedule late", "method 'late' of sw-late 1.0 could not be loaded", env={"PYTHONPATH": "{site}"}),
    Row(
        "eval {grey.swz} --scene demo:tiny --metrics twice",
        "claimed by sw-one 1.0 and sw-two 1.0",
        env={"PYTHONPATH": "{site}"},
    ),
    Row("bad", "no command 'bad'", env={"PYTHONPATH": "{site}"}),
    # What a training starts from.
    Row("run --init ''", "--init is empty"),
    Row("train --init {nowhere}.ply", "init: {nowhere}.ply: there is no such file"),
    Row("run --scene demo:tiny --init {cut.ply}", "init: {cut.ply}: "),
    Row("run --scene demo:tiny --init {grey.swz}", "is an encoded file: `sw export {grey.swz} FILE.ply`"),
    Row("train --scene demo:tiny --init {text.ply}", "init: {text.ply}: not a .ply file"),
    Row("run --scene demo:tiny --init {mesh.ply}", "not a 3DGS model"),
    Row("run --scene demo:tiny --init {huge.ply}", "init: {huge.ply}: "),
    Row("run --scene demo:tiny --init {nan.ply}", "init: {nan.ply}: all of its 40 Gaussians mean nothing"),
    Row("train --init {folder}", "init: {folder} is a folder: it has to be the .ply"),
    Row("train --init {trained}", "name the .ply in it, such as {trained}/point_cloud/point_cloud.ply"),
    Row("train --scene demo:tiny --set init={cut.ply}", "init: {cut.ply}: "),
    Row("run --init {grey.ply} --set init={cut.ply}", "contradicts --set init={cut.ply}"),
    Row("run --set pretrained.iterations=3", "method '3dgs' does not start from a trained scene"),
    Row("run --set pretrained=3", "unknown key 'pretrained'"),
    Row(
        "train --scene demo:tiny --method plain --init {grey.ply}",
        "method 'plain' does not start from a trained scene",
        env={"PYTHONPATH": "{site}"},
    ),
    Row("run --method pruned --scene demo:tiny --init {cut.ply}", "init: {cut.ply}: ", env={"PYTHONPATH": "{site}"}),
    Row(
        "run --method pruned --set pretrained.itertions=3",
        "did you mean 'pretrained.iterations'?",
        env={"PYTHONPATH": "{site}"},
    ),
    Row(
        "train --method pruned --set pretrained.lr.opacity=-1",
        "bad value '-1' for 'pretrained.lr.opacity'",
        env={"PYTHONPATH": "{site}"},
    ),
    Row(
        "train --method pruned --set pretrained.preset=quik",
        "has no preset 'quik': one of paper",
        env={"PYTHONPATH": "{site}"},
    ),
    Row(
        "train --method pruned --set pretrained.resolution=2",
        "give 'resolution', which holds for both",
        env={"PYTHONPATH": "{site}"},
    ),
    Row("train --method pruned --set pretrained.init={nan.ply}", "init: {nan.ply}: ", env={"PYTHONPATH": "{site}"}),
    Row(
        "run --scene demo:tiny --method pruned --init {grey.ply} --set pretrained.iterations=3",
        "give one of them",
        env={"PYTHONPATH": "{site}"},
    ),
    Row("info {bad-record}/r3/metrics.json", "metrics.json: not a result record"),
    # What the system refuses.
    Row("decode {locked.swz}", "locked.swz: cannot be read: Permission denied", root=False),
    Row("info {locked.ply}", "locked.ply: cannot be read: Permission denied", root=False),
    Row("run --config {locked.toml}", "'{locked.toml}' is not readable", root=False),
    Row("run --scene demo:tiny --out {read-only}/out", "cannot write into {read-only}/out", root=False),
    Row("export {grey.swz} {read-only}/x.ply", "cannot write {read-only}/x.ply", root=False),
    # Where results go.
    Row("run --scene demo:tiny --out {notes.txt}", "cannot write into {notes.txt}: it is a file, not a folder"),
    Row("train --scene demo:tiny --out {notes.txt}/x", "cannot write into {notes.txt}/x"),
    Row("run --scene demo:tiny --out /proc/x", "cannot write into /proc/x"),
    Row("render {grey.swz} --scene demo:tiny --out {notes.txt}", "cannot write into {notes.txt}"),
    Row("view {nowhere}", "{nowhere}: there is no such file or folder"),
    Row("view {hollow}", "holds no finished run"),
    Row("view {grey.swz} --html {nowhere}/x.html", "{nowhere}"),
    Row("view {flipped.swz} --html {new}.html", "flipped.swz"),
    Row("view {grey.swz} --html {new}.txt", "this is a page, give a name that ends in .html"),
    Row("view {grey.swz} --port 70000", "Invalid value for '--port'"),
    Row("train --view here", "'here' is not a valid integer range"),
    Row("eval {grey.swz} --scene demo:tiny --renders {notes.txt}", "cannot write into {notes.txt}"),
    Row("encode {grey.ply} --out {folder}", "{folder} is a folder: give the name of a file in it"),
    Row("encode {grey.ply} --out {nowhere}.swz", "there is no folder"),
    Row("decode {grey.swz} --out {nowhere}.ply", "there is no folder"),
    Row("export {grey.swz} {folder}", "{folder} is a folder"),
    Row("export {grey.swz} /proc/x.ply", "cannot write /proc/x.ply"),
    Row("data synth {folder}", "is not an empty folder"),
    Row("data synth {notes.txt}", "cannot write into {notes.txt}: it is a file"),
    Row("data synth {notes.txt}/x", "{notes.txt}"),
    # Reports.
    Row("report", "Missing argument"),
    Row("report {hollow}", "hollow"),
    Row("report {nowhere}", "nowhere"),
    Row("report {run}", "run"),
    Row("report {bad-record}", "metrics.json"),
    Row("report {bad-record} --html {folder}", "{folder} is a folder"),
    Row("report {bad-record} --html {new}", "this is a page, give a name that ends in .html"),
    Row("report {bad-record} --distance {new}.pdf", "this is a page, give a name that ends in .html"),
    Row("report {hollow} --anchor nobody", "hollow"),
    Row("config 3dg", "did you mean '3dgs'?"),
    Row("config 3dgs --preset papr", "no preset 'papr'"),
    Row("config 3dgs --only xyzzy", "no key of 3dgs holds 'xyzzy'"),
    Row("compare", "Missing argument"),
    Row("compare {run}", "--published"),
    Row("compare {grey.swz} {new}", "there is no such file"),
    Row("compare {grey.swz} {grey.swz} --cameras {notes.txt}", "not a JSON file of cameras"),
    Row("compare {hollow} --published", "hollow"),
    # Sweeps; more of them in the tests of sw-bench.
    Row("bench {nowhere}.toml", "cannot read the plan {nowhere}.toml: No such file"),
    Row("bench {broken.toml}", "broken.toml is not valid TOML: "),
    Row("bench --scene demo:tiny --method 3dsg", "no method is called '3dsg'; did you mean '3dgs'?"),
    Row("bench --scene demo:tiny --rate r9", "3dgs on demo:tiny: method '3dgs' has no rate point 'r9'"),
    Row("bench --scene demo:tiny --out {notes.txt}", "cannot write into {notes.txt}"),
    Row("bench --scene demo:tiny --executor cloud", "no executor is called 'cloud'"),
    Row("run --scene demo:tiny,{nowhere}", "3dgs on {nowhere}: scene '{nowhere}' is not there"),
    Row("run --scene demo:tiny --seed 0,-1", "Invalid value for '--seed'"),
    # Data sets.
    Row("data list mipnerf306", "mipnerf360", env={"SPLATWIZARD_DATA": "{data}"}),
    Row("data verify nerf_synthetic/lgeo", "has no scene 'lgeo'"),
    Row("data verify {nowhere}", "is neither a folder nor DATASET[/SCENE]"),
    Row("data fetch mipnerf306 --yes", "mipnerf360", env={"SPLATWIZARD_DATA": "{data}"}),
    Row("data fetch", "Missing argument"),
    Row("data list --registry {broken.toml}", "broken.toml"),
    Row("data list --registry {nowhere}", "nowhere"),
    Row("data undistort {hollow} {new}", "hollow"),
    Row("data undistort {nowhere} {new}", "nowhere"),
]


@pytest.fixture(scope="module")
def things(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    root = tmp_path_factory.mktemp("things")
    load_plugins.cache_clear()  # of other surroundings
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPLATWIZARD_NATIVE", "0")  # wrong input is found before anything is compiled
        make_things(root)
        yield root


@pytest.fixture
def surroundings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """An empty working folder, and no variable of ours but those that a row sets."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    for name in list(os.environ):
        if name.startswith(("SPLATWIZARD_DATA", "SW_")):
            monkeypatch.delenv(name)
    # What is not refused must not train for hours before the test fails.
    monkeypatch.setattr("splatwizard_core.training.trainer.Trainer.run", _began, raising=True)
    return monkeypatch


def _began(*_: object, **__: object) -> None:
    raise AssertionError("the training began")


def tree(*roots: Path) -> dict[str, tuple[int, int]]:
    """Everything below: path -> (size, time of the last change); a folder's own times change with what is in it."""
    found = {}
    for root in roots:
        for folder, folders, files in os.walk(root):
            found |= {os.path.join(folder, name): (0, 0) for name in folders}
            for name in set(files) - {".lock"}:  # who looks for a checkpoint holds the directory meanwhile
                status = os.stat(os.path.join(folder, name))
                found[os.path.join(folder, name)] = (status.st_size, status.st_mtime_ns)
    return found


def filled(text: str, things: Path, tmp_path: Path) -> str:
    """The text with paths for the names in braces."""
    for name in ("new", "nowhere", *os.listdir(things)):
        place = {"new": tmp_path / "work" / "new", "nowhere": tmp_path / "none" / "nowhere"}.get(name, things / name)
        text = text.replace("{" + name + "}", str(place))
    assert "{" not in text, f"no such thing: {text}"
    return text


def test_there_are_rows_for_every_command():
    commands = {row.line.split()[0] for row in ROWS}
    assert {entry.name for entry in command_entries() if is_ours(entry.distribution)} <= commands
    assert len(ROWS) >= 60


@pytest.mark.parametrize("row", ROWS, ids=str)
def test_wrong_input(row: Row, things: Path, tmp_path: Path, surroundings, capsys: pytest.CaptureFixture[str], request):
    if not row.root and os.access(things / "locked.swz", os.R_OK):
        pytest.skip("the system refuses root nothing")
    if "--device cuda" in row.line and torch.cuda.is_available():
        pytest.skip("there is a CUDA device here")
    if row.env:  # the plugins of these surroundings alone
        load_plugins.cache_clear()
        request.addfinalizer(load_plugins.cache_clear)
    for name, value in row.env.items():
        surroundings.setenv(name, filled(value, things, tmp_path))
        if name == "PYTHONPATH":
            surroundings.syspath_prepend(os.environ[name])
            surroundings.setattr(sys, "dont_write_bytecode", True)  # beside those modules it would be a new file
    before = tree(things, tmp_path)
    status = main(shlex.split(filled(row.line, things, tmp_path)))
    told = capsys.readouterr()
    assert_told(told.err, told.out, filled(row.told, things, tmp_path))
    assert status == row.status
    assert tree(things, tmp_path) == before


IN_A_PROCESS = ("rum", "decode {cut.swz}")


@pytest.mark.parametrize("row", [row for row in ROWS if row.line in IN_A_PROCESS], ids=str)
def test_wrong_input_to_a_real_process(row: Row, things: Path, tmp_path: Path, surroundings):
    before = tree(things, tmp_path)
    done = run_python("-m", "splatwizard_core", *shlex.split(filled(row.line, things, tmp_path)))
    assert_told(done.stderr, done.stdout, filled(row.told, things, tmp_path))
    assert done.returncode == row.status
    assert tree(things, tmp_path) == before


PROGRESS = re.compile(r"^[\w ,-]+: [\d,/]+ (?:in .+ )?· ")
"""Lines of progress, of which a slow machine gets some."""


def assert_told(err: str, out: str, fragment: str) -> None:
    assert fragment in err
    answer = [
        line
        for line in err.strip().splitlines()
        if not line.startswith(("computing on ", "preset quick: ")) and not PROGRESS.search(line)
    ]
    assert 1 <= len(answer) <= 2, err
    assert "Traceback" not in err
    assert "add --debug" not in err, "an error that nobody foresaw"
    assert out == ""
