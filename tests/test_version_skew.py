"""A file from another time or another installation says exactly what to install."""

import importlib.metadata
import json
import re
import struct
import zlib
from pathlib import Path

import pytest
from advice import as_written
from sw_kit.hostile_files import Parts

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins

GOLDEN = Path(__file__).parent / "golden"
HERE = importlib.metadata.version("sw-3dgs")  # all packages have one version
COMMANDS = {
    "decode": ["decode", "{file}"],
    "eval": ["eval", "{file}", "--scene", "demo:tiny", "--no-speed"],
    "export": ["export", "{file}", "{folder}/x.ply"],
    "render": ["render", "{file}", "--scene", "demo:tiny", "--out", "{folder}/views"],
}


@pytest.fixture
def only(monkeypatch):
    """only("3dgs") restricts the plugins of this process."""

    def restrict(names):
        monkeypatch.setenv("SW_PLUGINS", names)
        load_plugins.cache_clear()

    yield restrict
    monkeypatch.undo()
    load_plugins.cache_clear()


def write(folder: Path, name: str = "3dgs_r3_v1", *, data: bytes | None = None, **header) -> Path:
    """A golden file with other header values (`requires` is merged) as garden.swz."""
    parts = Parts.of((GOLDEN / f"{name}.swz").read_bytes())
    parts.header.update(header)
    path = folder / "garden.swz"
    path.write_bytes(parts.join() if data is None else data)
    return path


def requires(**versions: str) -> dict[str, list[str]]:
    """The requirements of the golden file with these versions, `version` or `other-distribution=version`."""
    found = Parts.of((GOLDEN / "3dgs_r3_v1.swz").read_bytes()).header["requires"]
    for name, version in versions.items():
        name = name.replace("_", "-")
        renamed, _, number = version.rpartition("=")
        row = found.pop(name)
        found[renamed or name] = [number, *row[1:]]
    return found


def said(capsys, command: str, path: Path) -> str:
    arguments = [a.format(file=path, folder=path.parent) for a in COMMANDS[command]]
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    (line,) = [line for line in err.splitlines() if line.startswith("error: ")]
    assert sorted(p.name for p in path.parent.iterdir()) == ["garden.swz"]  # nothing was written
    return line


def test_a_golden_file_says_who_wrote_it():
    row = requires()
    assert set(row) == {"splatwizard-core", "sw-3dgs", "sw-codecs"}
    assert row["sw-3dgs"][1:] == ["method:3dgs"]
    assert row["sw-codecs"][1:] == ["coder:octree", "entropy model:columns"]


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_method(tmp_path, capsys, command):
    path = write(tmp_path, method="mars", requires={"sw-method-of-mars": ["3.1", "method:mars"]})
    assert said(capsys, command, path) == (
        "error: garden.swz was written by method 'mars', which is not installed: "
        "pip install 'sw-method-of-mars>=3.1' (the package that the file names)"
    )


def test_a_missing_method_of_a_file_that_names_no_package(tmp_path, capsys):
    assert "install the package that provides it (`sw list-plugins` shows what is there)" in said(
        capsys, "decode", write(tmp_path, method="mars", requires={})
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_a_missing_coder(tmp_path, capsys, only, command):
    only("3dgs,render,interchange")
    path = write(tmp_path, requires=requires(sw_codecs="sw-coders-of-mars=2.0"))
    assert said(capsys, command, path) == (  # a name of ours is ours, whatever the file says
        f"error: garden.swz needs coder 'gaussians-quantized', which is not installed: sw-codecs {HERE} is there, "
        "but SW_PLUGINS leaves it out"
    )


def test_a_missing_entropy_model(tmp_path, capsys, only):
    only("3dgs")
    row = requires()
    row["sw-codecs"] = ["4.5", "entropy model:columns"]
    # The codec of the file is asked for first, and the file does not say who provides it.
    assert "needs coder 'gaussians-quantized'" in said(capsys, "decode", write(tmp_path, requires=row))
    only("3dgs,codecs")
    del load_plugins().entropy_models._entries["columns"]
    assert said(capsys, "decode", write(tmp_path, requires=row)).endswith(
        f"entropy model 'columns', which is not installed: sw-codecs {HERE} does not provide it (the file is newer: "
        f"it was written with sw-codecs 4.5, installed is {HERE}: pip install 'sw-codecs>=4.5')"
    )


def test_an_installed_plugin_that_is_left_out_needs_no_installation(tmp_path, capsys, only):
    only("3dgs")
    assert said(capsys, "decode", write(tmp_path)).endswith(f"sw-codecs {HERE} is there, but SW_PLUGINS leaves it out")


def test_a_plugin_too_old_to_have_the_method(tmp_path, capsys):
    path = write(
        tmp_path, method="3dgs-next", requires=requires(sw_3dgs="0.7") | {"sw-3dgs": ["0.7", "method:3dgs-next"]}
    )
    assert said(capsys, "decode", path).endswith(
        f"sw-3dgs {HERE} does not provide it (the file is newer: it was written with sw-3dgs 0.7, installed is {HERE}: "
        "pip install 'sw-3dgs>=0.7')"
    )


@pytest.mark.parametrize("command", COMMANDS)
def test_a_newer_layout_of_a_method(tmp_path, capsys, command):
    path = write(tmp_path, method_version=2, requires=requires(sw_3dgs="0.9"))
    assert said(capsys, command, path) == (
        f"error: garden.swz: version 2 of the layout of '3dgs' is newer than 1, which sw-3dgs {HERE} reads: "
        "upgrade with pip install 'sw-3dgs>=0.9'"
    )


def test_a_newer_layout_of_a_method_in_a_file_that_names_no_package(tmp_path, capsys):
    path = write(tmp_path, method_version=2, requires={})
    assert "upgrade with pip install --upgrade sw-3dgs" in said(capsys, "decode", path)


@pytest.mark.parametrize("section", ["positions", "color"])
def test_a_newer_coded_stream(tmp_path, capsys, section):
    parts = Parts.of((GOLDEN / "3dgs_r3_v1.swz").read_bytes())
    parts.header["requires"] = requires(sw_codecs="0.4")
    parts.sections = [(n, b"\x02" + content[1:] if n == section else content) for n, content in parts.sections]
    line = said(capsys, "decode", write(tmp_path, data=parts.join()))
    assert f"section '{section}'" in line
    assert "version 2" in line
    assert line.endswith(
        f"(the file is newer: it was written with sw-codecs 0.4, installed is {HERE}: pip install 'sw-codecs>=0.4')"
    )


def newer_container(data: bytes, header: bytes) -> bytes:
    """A file of container version 3 that keeps what every version keeps: the first 10 bytes, a JSON header, its CRC."""
    return struct.pack("<4sHI", b"SPWZ", 3, len(header)) + header + struct.pack("<I", zlib.crc32(header)) + data


@pytest.mark.parametrize("command", [*COMMANDS, "info"])
def test_a_newer_container(tmp_path, capsys, monkeypatch, command):
    monkeypatch.setitem(COMMANDS, "info", ["info", "{file}"])
    header = json.dumps({"requires": {"splatwizard-core": ["0.8"]}, "whatever": ["comes", "then"]}).encode()
    path = write(tmp_path, data=newer_container(b"\x00" * 50, header))
    assert said(capsys, command, path) == (
        "error: garden.swz: container version 3 is newer than 2, the newest that this installation reads: "
        "upgrade splatwizard-core with pip install 'splatwizard-core>=0.8'"
    )


@pytest.mark.parametrize("header", [b"not JSON", b"[]", b'{"requires": 3}', b'{"requires": {"splatwizard-core": []}}'])
def test_a_newer_container_that_says_nothing(tmp_path, capsys, header):
    path = write(tmp_path, data=newer_container(b"", header))
    assert said(capsys, "decode", path).endswith("pip install --upgrade splatwizard-core")


def test_info_needs_no_plugin_but_its_own(tmp_path, capsys, only):
    only("report")
    path = write(tmp_path, requires=requires() | {"sw-3dgs-of-mars": ["5.0", "coder:martian"]})
    assert main(["info", str(path), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert sum(facts["bytes"].values()) == facts["size"] == path.stat().st_size
    assert {"header", "positions", "color", "sh1", "sh3"} <= set(facts["bytes"])
    assert facts["requires"]["sw-3dgs-of-mars"] == "5.0"
    assert set(facts["missing"]) == {"method 3dgs", "coder octree", "entropy model columns", "coder martian"}
    assert main(["info", str(path)]) == 0
    shown = capsys.readouterr().out
    assert "positions" in shown
    assert "pip install 'sw-3dgs-of-mars>=5.0'" in shown


def test_info_of_a_file_that_can_be_decoded_misses_nothing(capsys):
    assert main(["info", str(GOLDEN / "3dgs_r3_v1.swz"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["missing"] == {}


@pytest.mark.pipeline
def test_really_missing_packages(core, wheels, tmp_path):
    """Without any plugin, and with one whose own requirement is missing."""
    path = write(tmp_path)
    (done,) = core.run_each([["decode", str(path)]])
    assert done.status == 2
    assert "pip install 'sw-3dgs>=0.1.0' (the package that the file names)" in as_written(done.stderr)
    command = re.search(r"(\S+ (?:-m pip )?install --find-links \S+ '[^']+')", done.stderr)
    assert command is not None
    assert Path(re.search(r"--find-links (\S+)", command[1])[1]) == wheels["sw-3dgs"].parent
    core.install(wheels["sw-3dgs"])
    done = core.run("decode", str(path), check=False)
    assert done.returncode == 2
    assert f"sw-3dgs {HERE} does not load: needs " in done.stderr


def test_a_part_that_the_user_left_out_is_told_to_be_left_out(capsys, only):
    only("3dgs")
    assert main(["schedule", "3dgs"]) == 2
    assert "it comes with sw-gaussians, which SW_PLUGINS=3dgs leaves out" in capsys.readouterr().err
