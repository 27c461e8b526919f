"""A file whose parts come from a stranger's package: what is said where that package is missing, left out, or another
release than the one that wrote it."""

import os
import sys
from pathlib import Path

import pytest
from forked_children import run_python

from splatwizard_core.cli.main import main
from splatwizard_core.coding.container import ContainerReader
from splatwizard_core.plugins import load_plugins

GOLDEN = Path(__file__).parent / "golden"
OURS = "speedy-splat,3dgs,gaussians,codecs"
CODEC = """
import torch
from splatwizard_core.api import BitstreamError, GaussianModel, hookimpl

NAMES = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")


@hookimpl
def register_coders(registry):
    if {provides}:
        registry.add("martian", "martian:Martian", codes="gaussians", summary="plain arrays")


@hookimpl
def register_methods(registry):
    registry.add("mars", "martian:Mars", summary="a method")


class Martian:
    def __init__(self, plugins):
        pass

    def encode(self, model, writer):
        for name in NAMES:
            writer.add_array(name, getattr(model, name).detach().numpy())

    def decode(self, reader):
        if not {reads}:
            raise BitstreamError("no such layout")
        return GaussianModel(*(torch.from_numpy(reader.array(name, dtype="<f4")) for name in NAMES))
"""


class Stranger:
    """The package sw-martian as it is installed in a folder of its own: there, in another release, or gone."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()

    def install(self, version: str, *, provides: bool = True, reads: bool = True) -> None:
        self.remove()
        about = self.folder / f"sw_martian-{version}.dist-info"
        about.mkdir()
        (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: sw-martian\nVersion: {version}\n")
        (about / "entry_points.txt").write_text("[splatwizard]\nmartian = martian\n")
        source = CODEC.replace("{provides}", str(provides)).replace("{reads}", str(reads))
        (self.folder / "martian.py").write_text(source)

    def remove(self) -> None:
        for file in sorted(self.folder.rglob("*"), reverse=True):
            file.rmdir() if file.is_dir() else file.unlink()
        sys.modules.pop("martian", None)
        load_plugins.cache_clear()


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    found = Stranger(tmp_path / "site")
    monkeypatch.syspath_prepend(str(found.folder))
    yield found
    found.remove()
    monkeypatch.undo()
    load_plugins.cache_clear()


@pytest.fixture
def file(stranger, tmp_path):
    """A file of speedy-splat by the codec of sw-martian 1.2."""
    stranger.install("1.2")
    scene, path = tmp_path / "scene.ply", tmp_path / "scene.swz"
    assert main(["export", str(GOLDEN / "3dgs_one_v1.swz"), str(scene)]) == 0
    assert main(["encode", str(scene), "--method", "speedy-splat", "--set", "codec=martian", "--out", str(path)]) == 0
    requires = {each.distribution: each for each in ContainerReader.open(path).requires}
    assert requires["sw-martian"].provided == (("coder", "martian"),)
    assert main(["decode", str(path), "--repeats", "0"]) == 0
    return path


def error(capsys, path: Path) -> str:
    capsys.readouterr()
    assert main(["decode", str(path), "--repeats", "0"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return line


def test_a_codec_that_was_uninstalled(file, stranger, capsys):
    stranger.remove()
    assert error(capsys, file) == (
        "error: scene.swz needs coder 'martian', which is not installed: "
        "pip install 'sw-martian>=1.2' (the package that the file names)"
    )


def test_a_codec_that_is_left_out(file, stranger, capsys, monkeypatch):
    monkeypatch.setenv("SW_PLUGINS", OURS)
    load_plugins.cache_clear()
    assert error(capsys, file).endswith("sw-martian 1.2 is there, but SW_PLUGINS leaves it out")


def test_a_codec_that_is_left_out_of_another_process(file, stranger):
    program = "import sys; from splatwizard_core.cli.main import main; sys.exit(main(sys.argv[1:]))"
    surroundings = {**os.environ, "SW_PLUGINS": OURS, "PYTHONPATH": ":".join(sys.path)}
    done = run_python("-c", program, "decode", str(file), "--repeats", "0", env=surroundings)
    assert done.returncode == 2
    assert "needs coder 'martian', which is not installed: sw-martian 1.2 is there, but SW_PLUGINS" in done.stderr


@pytest.mark.parametrize(
    ("version", "advice"),
    [
        ("1.0", "(the file is newer: it was written with sw-martian 1.2, installed is 1.0: "
                "pip install 'sw-martian>=1.2')"),
        ("3.0", "(the file is older: it was written with sw-martian 1.2, installed is 3.0: "
                "pip install 'sw-martian==1.2')"),
        ("1.2", ""),
    ],
)  # fmt: skip
def test_a_codec_of_another_release(file, stranger, capsys, version, advice):
    stranger.install(version, reads=False)
    line = error(capsys, file)
    assert line == f"error: no such layout {advice}".rstrip()
    stranger.install(version, provides=False)
    assert error(capsys, file) == (
        f"error: scene.swz needs coder 'martian', which is not installed: sw-martian {version} does not provide it "
        f"{advice}".rstrip()
    )


def test_a_codec_of_ours_is_named_by_the_catalogue(tmp_path, capsys, monkeypatch):
    path = GOLDEN / "trimming_the_fat_zstd_v1.swz"
    monkeypatch.setenv("SW_PLUGINS", "trimming-the-fat")
    load_plugins.cache_clear()
    try:
        assert "coder 'gaussians-zstd', which is not installed: sw-codecs " in error(capsys, path)
    finally:
        monkeypatch.undo()
        load_plugins.cache_clear()


def test_a_layout_that_is_newer_than_a_strangers_method(stranger, tmp_path, capsys):
    """Also where the file names another distribution than the one that provides the method here."""
    from sw_kit.hostile_files import Parts

    stranger.install("1.2")
    (stranger.folder / "martian.py").write_text(
        (stranger.folder / "martian.py").read_text()
        + "\nfrom splatwizard_core.api import Method\n\nclass Mars(Method):\n    name = 'mars'\n    version = 1\n"
        "    def decode(self, reader):\n        self.check_version(reader)\n"
    )
    parts = Parts.of((GOLDEN / "3dgs_one_v1.swz").read_bytes())
    path = tmp_path / "scene.swz"

    def write(version: int, requires: dict[str, list[str]]) -> Path:
        parts.header.update(method="mars", method_version=version, requires=requires)
        path.write_bytes(parts.join())
        return path

    told = (
        "error: scene.swz: version 2 of the layout of 'mars' is newer than 1, which sw-martian 1.2 reads: upgrade with "
    )
    assert error(capsys, write(2, {"sw-martian": ["1.5", "method:mars"]})) == f"{told}pip install 'sw-martian>=1.5'"
    assert error(capsys, write(2, {"sw-mars": ["0.3", "method:mars"]})) == (
        f"{told}pip install 'sw-mars>=0.3' (the package that the file names)"
    )
    assert error(capsys, write(2, {})) == f"{told}pip install --upgrade sw-martian"
    line = error(capsys, write(0, {"sw-martian": ["0.7", "method:mars"]}))
    assert "mars layout version 0 is unknown, this installation reads 1; the file is older" in line
    assert line.endswith("written with sw-martian 0.7, installed is 1.2: pip install 'sw-martian==0.7')")


def test_a_part_that_is_there_but_of_another_sort_is_damage_and_not_missing(tmp_path, capsys):
    """A hostile header: the octree codes positions, and no package to install makes it a codec of Gaussians."""
    from sw_kit.hostile_files import Parts

    parts = Parts.of((GOLDEN / "trimming_the_fat_zstd_v1.swz").read_bytes())
    parts.header["static"]["codec"] = "octree"
    parts.header["requires"] = {"sw-codecs": ["9.9", "coder:octree"]}
    path = tmp_path / "scene.swz"
    path.write_bytes(parts.join())
    line = error(capsys, path)
    assert "header value 'codec' is 'octree', must be one of " in line
    assert "gaussians-exact, " in line
    assert "not installed" not in line
