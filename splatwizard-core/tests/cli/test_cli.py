"""The command line: what it says, where it says it, and with which exit status."""

import importlib.abc
import json
import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import click
import pytest
from counted_lines import lines_of_process
from forked_children import run_python
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.__main__ import start
from splatwizard_core.cli.main import cli, main
from splatwizard_core.plugins import catalogue, load_plugins
from splatwizard_core.runs import file_needs

assert file_needs  # here, so that it does not keep the catalogue of a test that imports it first
COMMANDS = (
    "run", "train", "encode", "decode", "eval", "list-plugins", "schedule",
)  # fmt: skip
"""Of the core."""


def sw(*args: str, **env: str) -> subprocess.CompletedProcess[str]:
    """Run `sw` in a process of its own."""
    return run_python("-m", "splatwizard_core", *args, env={**os.environ, **env})


@pytest.mark.parametrize("arguments", [["--help"], ["list-plugins"], ["list-plugins", "--json"], ["run", "--help"]])
def test_help_and_list_plugins_import_no_torch(arguments: list[str]):
    code = f"""
        import sys
        from splatwizard_core.cli.main import main
        status = main({arguments!r})
        heavy = [m for m in ("torch", "numpy", "scipy", "pydantic", "PIL") if m in sys.modules]
        print("heavy:", heavy, file=sys.stderr)
        sys.exit(status)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "heavy: []" in done.stderr


@pytest.mark.parametrize("arguments", [["--help"], ["list-plugins"]])
def test_help_and_list_plugins_take_little_more_than_the_libraries_they_stand_on(arguments: list[str]):
    """By lines of Python: about 5 and 6.5 times as many, reading requirements included; torch would make it 20."""
    libraries, _ = lines_of_process("import click, pluggy, importlib.metadata as m; list(m.distributions())")
    run = "import runpy; runpy.run_module('splatwizard_core', run_name='__main__', alter_sys=True)"
    assert lines_of_process(run, *arguments)[0] < 8 * libraries


@pytest.mark.parametrize("command", [[], *([name] for name in COMMANDS)])
def test_every_command_explains_itself(command: list[str], capsys: pytest.CaptureFixture[str]):
    assert main([*command, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"Usage: {' '.join(['sw', *command])}")
    assert "--debug" in text


def test_every_option_says_what_it_is_for():
    context = click.Context(cli)
    for name in COMMANDS:
        command = cli.get_command(context, name)
        assert command is not None
        for parameter in command.params:
            assert not isinstance(parameter, click.Option) or parameter.help, f"{name} {parameter.name}"


def test_the_core_alone_has_its_own_commands():
    listed = json.loads(sw("list-plugins", "--json", SW_PLUGINS="").stdout)
    assert listed["commands"] == [*COMMANDS]


def test_a_command_of_a_package_that_is_not_installed_names_the_package(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(catalogue, "catalogue", lambda: {"command": {"lorem": "sw-ipsum-dolor"}})
    assert main(["lorem", "--ipsum"]) == 2
    told = capsys.readouterr().err
    assert told == "error: no command 'lorem': it comes with sw-ipsum-dolor: pip install sw-ipsum-dolor\n"


def test_without_the_default_method_its_package_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(type(load_plugins().methods), "default", None)
    monkeypatch.setattr(catalogue, "catalogue", lambda: {"default": {"method": "sw-ipsum-dolor"}})
    assert main(["run"]) == 2
    assert "no method is named, and the default one is not there: pip install sw-ipsum-dolor" in capsys.readouterr().err
    monkeypatch.setattr(catalogue, "catalogue", lambda: {})
    assert main(["train"]) == 2
    assert "pip install 'splatwizard-core[all]'" in capsys.readouterr().err


def test_a_run_that_no_package_reports_ends_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    pytest.importorskip("sw_3dgs", reason="needs a method")
    monkeypatch.setattr(load_plugins().hook, "run_finished", lambda runs: None)
    sets = ["--set", "iterations=2", "--set", "raster.prefer=reference"]
    assert main(["run", "--scene", "demo:tiny", "--rate", "r6", "--out", str(tmp_path), *sets]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    directory = tmp_path / "demo-tiny" / "3dgs" / "r6"
    record = json.loads((directory / "metrics.json").read_text())
    assert line.startswith("3dgs r6: ")
    assert f"PSNR {record['metrics']['psnr']['mean']:.2f} dB" in line
    assert line.endswith(f"{record['file']['bytes']:,} bytes: {directory}")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rum"], "error: no command 'rum': did you mean 'run'?"),
        (["run", "--sceen", "x"], "No such option"),
        (["run", "--seed", "x"], "--seed"),
        (["run", "--method", "no-such-method"], "no method is called 'no-such-method'"),
        (["run", "--config", "/nowhere/config.toml"], "cannot read --config /nowhere/config.toml"),
        (["decode", "/nowhere/scene.swz"], "there is no such file"),
        (["eval", "/nowhere/scene.swz"], "there is no such file"),
        (["eval", "{text}", "--scene", "demo:tiny"], "not a .swz file"),
        (["encode", "{text}"], "takes a run directory or a .ply"),
        (["run", "--scene", ""], "--scene is empty"),
        (["run", "--method", ""], "--method is empty"),
        (["run", "--scene", "demo:tiny", "--out", "{text}"], "cannot write into {text}: it is a file"),
        (["train", "--scene", "demo:tiny", "--out", "{text}"], "cannot write into {text}: it is a file"),
        (["decode", "{folder}"], "{folder} is a folder, and this command takes a file"),
        (["decode", "{text}", "--out", "{folder}"], "{folder} is a folder: give the name of a file in it"),
        (["encode", "{text}", "--out", "{folder}/none/x.swz"], "there is no folder {folder}/none"),
        (["eval", "{text}", "--metrics", ","], "--metrics is empty"),
        (["eval", "{text}", "--scene", "demo:tiny", "--metrics", "pnsr"], "no metric is called 'pnsr'"),
        (["eval", "{text}", "--renders", "{text}"], "cannot write into {text}: it is a file"),
    ],
)  # fmt: skip
def test_wrong_input_is_one_or_two_lines_and_status_2(
    arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    text = tmp_path / "notes.txt"
    text.write_text("hello")
    names = {"text": str(text), "folder": str(tmp_path)}
    assert main([a.format(**names) if "{" in a else a for a in arguments]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert message.format(**names) in told.err
    assert 1 <= len(told.err.strip().splitlines()) <= 2
    assert "Traceback" not in told.err


def test_debug_adds_the_traceback(capsys: pytest.CaptureFixture[str]):
    assert main(["decode", "/nowhere/scene.swz", "--debug"]) == 2
    told = capsys.readouterr().err
    assert "Traceback" in told
    assert "there is no such file" in told


def test_a_key_of_many_letters_is_not_repeated_whole(capsys: pytest.CaptureFixture[str]):
    assert main(["schedule", "3dgs", "--set", f"{'k' * 60_000}=1"]) == 2
    assert len(capsys.readouterr().err) < 3000


def test_an_error_nobody_foresaw_is_one_line_and_status_1(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: object) -> None:
        raise RuntimeError("the sky\nfell")

    monkeypatch.setattr("splatwizard_core.cli.list_plugins.gather", fail)
    assert main(["list-plugins"]) == 1
    told = capsys.readouterr().err
    assert told == "error: RuntimeError: the sky fell (a traceback: add --debug)\n"


@pytest.mark.parametrize(
    ("problem", "status", "told"),
    [
        (FileNotFoundError(2, "No such file or directory", "a/b"), 2, "a/b: No such file or directory"),
        (PermissionError(13, "Permission denied", "a/b"), 2, "a/b: Permission denied"),
        (OSError(5, "Input/output error"), 1, "Input/output error"),
    ],
)
def test_what_the_system_refuses_is_one_line_without_its_python_name(
    problem: OSError, status: int, told: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(*_: object) -> None:
        raise problem

    monkeypatch.setattr("splatwizard_core.cli.list_plugins.gather", fail)
    assert main(["list-plugins"]) == status
    assert capsys.readouterr().err == f"error: {told} (a traceback: add --debug)\n"


@pytest.mark.parametrize("arguments", [[], ["data"]])
def test_a_group_alone_shows_its_help_and_is_status_2(arguments: list[str], capsys: pytest.CaptureFixture[str]):
    assert main(arguments) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert told.err.startswith("Usage: sw")


def test_an_interrupt_while_modules_are_imported_is_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    class Interrupting(importlib.abc.MetaPathFinder):
        def find_spec(self, name: str, *_: object) -> None:
            if name == "splatwizard_core.cli.main":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "splatwizard_core.cli.main", raising=False)
    monkeypatch.setattr("sys.meta_path", [Interrupting(), *sys.meta_path])
    assert start() == 130
    assert capsys.readouterr().err == "interrupted\n"


def test_an_interrupt_is_status_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("splatwizard_core.cli.list_plugins.gather", interrupt)
    assert main(["list-plugins"]) == 130
    assert "interrupted" in capsys.readouterr().err


def test_a_reader_that_goes_away_is_no_error():
    process = subprocess.Popen(
        [sys.executable, "-m", "splatwizard_core", "list-plugins", "--json"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    told = process.stderr.read()
    assert process.wait() == 141
    assert told == ""


def test_list_plugins_as_json(capsys: pytest.CaptureFixture[str]):
    assert main(["list-plugins", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    core = listed["plugins"][0]
    assert core["distribution"] == "splatwizard-core"
    assert core["error"] is None
    names = {(e["kind"], e["name"]) for e in core["provides"]}
    assert {("metric", "psnr"), ("command", "run")} <= names
    assert set(COMMANDS) <= set(listed["commands"])


def test_verbose_list_plugins_has_one_line_an_entry(capsys: pytest.CaptureFixture[str]):
    assert main(["list-plugins", "--json"]) == 0
    core = json.loads(capsys.readouterr().out)["plugins"][0]
    assert main(["list-plugins", "--verbose"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"splatwizard-core {core['version']}"
    assert lines[1 : 1 + len(core["provides"])] == [
        f"  {entry['kind']} {entry['name']}: {entry['summary']}" for entry in core["provides"]
    ]


def test_version(capsys: pytest.CaptureFixture[str]):
    import importlib.metadata

    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == importlib.metadata.version("splatwizard-core")


def test_decoding_a_file_of_a_method_that_is_not_installed_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    from splatwizard_core.coding.container import ContainerWriter

    ContainerWriter("method-from-mars", 1).write(tmp_path / "x.swz")
    assert main(["decode", str(tmp_path / "x.swz")]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert said == (
        "error: x.swz was written by method 'method-from-mars', which is not installed: "
        "install the package that provides it (`sw list-plugins` shows what is there)"
    )


def test_ply_files_are_measured_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str], ply: Path):
    force = ["--set", "raster.prefer=reference"]
    measure = ["eval", str(ply), "--scene", "demo:tiny", "--no-speed", "--metrics", "psnr,l1"]
    folder = str(tmp_path / "views")
    assert main([*measure, "--renders", folder, *force, "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert set(facts["metrics"]) == {"psnr", "l1"}
    assert facts["speed"] is None
    assert sorted(os.listdir(folder)) == sorted(facts["renders"]) == ["view_000.png", "view_004.png"]
    from PIL import Image

    assert Image.open(tmp_path / "views" / "view_000.png").size == (64, 48)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    """Forty grey Gaussians."""
    import torch
    from sw_gaussians.ply import export_ply

    from splatwizard_core.scene.scene import PointCloud

    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    path = tmp_path / "grey.ply"
    export_ply(gaussians_from_points(PointCloud(points, torch.full((40, 3), 0.5)), max_sh_degree=1), path)
    return path


def test_progress_and_messages_leave_stdout_to_json(tmp_path: Path, ply: Path):
    for module in ("sw_datasets", "sw_gaussians", "sw_reference"):
        pytest.importorskip(module, reason="needs a scene, .ply and a rasterizer")
    only = "sw-datasets,sw-gaussians,sw-reference"
    done = sw("eval", str(ply), "--scene", "demo:tiny", "--set", "raster.prefer=reference", "--json", SW_PLUGINS=only)
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    assert facts["speed"]["frames"] == 8
    assert facts["memory"]["kind"] == "rss"


@pytest.mark.slow
def test_ctrl_c_leaves_a_training_that_resumes(tmp_path: Path):
    pytest.importorskip("sw_3dgs", reason="needs a method")
    command = [
        sys.executable, "-m", "splatwizard_core", "train", "--scene", "demo:tiny", "--out", str(tmp_path),
        "--set", "iterations=400", "--set", "checkpoint_every=50",
    ]  # fmt: skip
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    log = tmp_path / "demo-tiny" / "3dgs" / "r3" / "log.jsonl"
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline and not list(tmp_path.rglob("*.safetensors")):
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130
    assert "Traceback" not in told
    done = subprocess.run([*command, "--json"], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["steps"] == 400
    assert log.exists()


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["run", "--iterations", "300"], "--set iterations=300"),
        (["run", "--method", "3dgs", "--grad-threshold=4e-4"], "--set density.settings.grad_threshold=4e-4"),
        (["train", "--density.settings.grad_threshold", "4e-4"], "--set density.settings.grad_threshold=4e-4"),
        (["eval", "scene.ply", "--test-every", "4"], "--set test_every=4"),
        (["schedule", "3dgs", "--iterations"], "--set iterations=VALUE"),
        (["run", "--log-every", "5"], "--set log_every=5"),
    ],
)
def test_a_key_that_is_given_as_an_option_is_answered_with_set(arguments, told, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"error: no option {arguments[-1] if told.endswith('VALUE') else '--'}")
    assert line.endswith(f"it is a key of the configuration, give {told}")


@pytest.mark.parametrize("arguments", [["run", "--nonsense", "3"], ["list-plugins", "--iterations", "3"]])
def test_an_option_that_is_no_key_is_no_option(arguments, capsys):
    assert main(arguments) == 2
    assert "No such option" in capsys.readouterr().err


def test_a_configuration_that_names_no_preset_leaves_the_plan_that_of_paper(tmp_path: Path, capsys):
    pytest.importorskip("sw_3dgs", reason="needs a method")
    (tmp_path / "c.toml").write_text("seed = 1")
    assert main(["schedule", "3dgs", "--config", str(tmp_path / "c.toml")]) == 0
    assert capsys.readouterr().out.startswith("3dgs: 30,000 steps")
