"""A forked process of a run is what a new interpreter would be: same folder, variables, path, plugins, exit status."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import forked_children
import pytest

from splatwizard_core.errors import UserInputError
from splatwizard_core.runs.fresh import FreshProcessError, run_fresh

STRANGER = '''
import os
import signal
import subprocess
import sys

import click

from splatwizard_core.plugins import hookimpl


@hookimpl
def register_commands(registry):
    registry.add("whereabouts", "stranger:whereabouts", summary="for tests")


@click.command()
@click.option("--end")
def whereabouts(end):
    """Tell where this process is."""
    import json

    import torch

    if end == "die":
        os._exit(3)
    if end == "wrong":
        from splatwizard_core.errors import UserInputError
        raise UserInputError("nothing is right")
    print(json.dumps({
        "folder": os.getcwd(), "path": sys.path, "arguments": sys.argv[1:], "environment": dict(os.environ),
        "plugins": sorted(name for name in sys.modules if name.startswith(("sw_", "stranger"))),
        "threads": torch.get_num_threads(), "drawn": float(torch.rand(1)), "input": sys.stdin.read(),
    }))
'''


@pytest.fixture(scope="module", autouse=True)
def stranger(tmp_path_factory: pytest.TempPathFactory):
    """A command that is found by processes started from here alone."""
    site = tmp_path_factory.mktemp("site")
    (site / "stranger.py").write_text(STRANGER)
    information = site / "sw_stranger-1.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: sw-stranger\nVersion: 1\n")
    (information / "entry_points.txt").write_text("[splatwizard]\nstranger = stranger\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(site), prepend=":")
        patch.setenv("SW_PLUGINS", "stranger")
        patch.setenv("SPLATWIZARD_DATA", str(site))
        yield


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_it_is_told_and_sees_what_a_new_interpreter_does(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Whatever the path of the request was with which the server began."""
    with forked_children.forking():
        with monkeypatch.context() as patch:
            patch.setenv("PYTHONPATH", os.pathsep.join(filter(None, sys.path)), prepend=os.pathsep)
            run_fresh(["whereabouts"], alone_in=tmp_path)
        forked = [run_fresh(["whereabouts"], alone_in=tmp_path) for _ in range(2)]
    with forked_children.starting():
        new = run_fresh(["whereabouts"], alone_in=tmp_path)
    drawn = {child.pop("drawn") for child in (*forked, new)}
    assert len(drawn) == 3
    for name in new:
        assert [child[name] for child in forked] == [new[name]] * 2, name
    assert new["plugins"] == ["stranger"]
    assert "SPLATWIZARD_DATA" not in new["environment"]


def test_its_end_is_told():
    with pytest.raises(UserInputError, match="nothing is right"):
        run_fresh(["whereabouts", "--end", "wrong"])
    with pytest.raises(FreshProcessError, match="status 3"):
        run_fresh(["whereabouts", "--end", "die"])
    with pytest.raises(UserInputError, match="No such option"):
        run_fresh(["whereabouts", "--no-such-option"])


def test_another_locale_gets_a_new_interpreter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    run_fresh(["whereabouts"], alone_in=tmp_path)
    monkeypatch.setenv("PYTHONIOENCODING", "latin-1")
    assert run_fresh(["whereabouts"], alone_in=tmp_path)["environment"]["PYTHONIOENCODING"] == "latin-1"


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_what_a_training_sets_costs_no_new_interpreter(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setenv("CUBLAS_WORKSPACE_CONFIG", ":16:8")
    monkeypatch.setenv("TORCHINDUCTOR_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(forked_children, "START", None)
    assert run_fresh(["whereabouts"], alone_in=tmp_path)["environment"]["CUBLAS_WORKSPACE_CONFIG"] == ":16:8"


@pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux alone")
def test_it_is_started_stopped_and_killed_as_any_process():
    program = "import sys; print(sys.stdin.readline().strip(), flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "start_new_session": True}
    with forked_children.start_python("-c", program, **pipes) as child:
        child.stdin.write("hello\n")
        child.stdin.flush()
        assert child.stdout.readline() == "hello\n"
        assert os.getsid(child.pid) == child.pid
        assert child.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            child.wait(0.01)
        child.kill()
        assert child.wait() == -signal.SIGKILL
