"""A disk that fills up: one message that names the file, nothing half-written, and the run goes on with more space."""

import contextlib
import errno
import json
import os
import resource
import subprocess
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from sw_gaussians.ply import export_ply
from sw_gaussians.start import gaussians_from_points

from splatwizard_core.base.files import TEMPORARY
from splatwizard_core.base.run_log import RunLog
from splatwizard_core.cli.main import main
from splatwizard_core.errors import DiskFullError
from splatwizard_core.plugins import PluginManager
from splatwizard_core.runs import run as run_module
from splatwizard_core.runs.config import parse_set, resolve
from splatwizard_core.runs.decode import open_model
from splatwizard_core.runs.directory import RunRequest
from splatwizard_core.runs.facts import DecodingFacts
from splatwizard_core.runs.run import run, train_only
from splatwizard_core.runs.session import Session
from splatwizard_core.scene.scene import PointCloud

pytestmark = pytest.mark.pipeline


def request(plugins: PluginManager, out: Path) -> tuple[Session, RunRequest]:
    """A new invocation of a training of six steps with three checkpoints."""
    sets = parse_set(["iterations=6", "checkpoint_every=2"])
    resolved = resolve(plugins.methods.load("toy"), sets=sets, scene="demo:tiny")
    return Session(plugins, torch.device("cpu"), lambda message: None), RunRequest(resolved, out)


@pytest.fixture(scope="module")
def expected(toy_plugins: PluginManager, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Digest of the model that comes out where there is space."""
    return train_only(*request(toy_plugins, tmp_path_factory.mktemp("space")))[0].model.digest()


@contextlib.contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """What this process and its children write ends at `size` bytes of each file: the system says EFBIG."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def temporaries(folder: Path) -> list[Path]:
    import re

    return [p for p in folder.rglob("*") if re.fullmatch(rf".*{TEMPORARY}", p.name)]


def test_a_checkpoint_without_space_ends_the_training_in_one_sentence_and_it_resumes(
    toy_plugins: PluginManager, tmp_path: Path, expected: str
):
    limit = 10_000  # the tensors of sixty Gaussians and their two moments take more, everything before them less
    with files_of_at_most(limit), pytest.raises(DiskFullError, match=r"00-0000002\.safetensors: the file may") as told:
        train_only(*request(toy_plugins, tmp_path))
    assert told.value.wanted is not None
    assert told.value.wanted > limit
    assert f"({told.value.wanted:,} bytes wanted)" in str(told.value)
    assert "Make space and give the same command again" in str(told.value)
    assert len(str(told.value).splitlines()) == 1
    assert temporaries(tmp_path) == []
    assert train_only(*request(toy_plugins, tmp_path))[0].model.digest() == expected


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Fresh processes are this one: starting them would be most of the time."""

    def in_this_process(arguments: Sequence[str], **_: object) -> dict[str, Any]:
        capsys.readouterr()
        assert main(arguments) == 0
        told: dict[str, Any] = json.loads(capsys.readouterr().out)
        return told

    def decode(path: Path, device: str, *, repeats: int, threads: int) -> DecodingFacts:
        told = in_this_process(["decode", str(path), "--device", device, "--repeats", str(repeats), "--json"])
        return DecodingFacts.model_validate(told)

    monkeypatch.setattr(run_module, "run_fresh", in_this_process)
    monkeypatch.setattr(run_module, "decode_fresh", decode)
    monkeypatch.setattr(run_module, "started_ahead", contextlib.nullcontext)


def test_every_file_of_a_run_may_meet_a_full_disk(
    toy_plugins: PluginManager, tmp_path: Path, expected: str, monkeypatch: pytest.MonkeyPatch, here: None
):
    """Each file but the renders cannot be put in its place the first time; the run is given again until it is through.

    The renders are written by the evaluation, which says so with its exit status.
    """
    refused: list[str] = []
    replace = os.replace

    def full(source: str | Path, target: str | Path) -> None:
        name = Path(target).name
        if Path(target).is_relative_to(tmp_path) and name not in refused and not name.endswith(".png"):
            refused.append(name)
            raise OSError(errno.ENOSPC, "No space left on device")
        replace(source, target)

    monkeypatch.setattr(os, "replace", full)
    told: list[DiskFullError] = []
    for _ in range(20):
        try:
            record, directory = run(*request(toy_plugins, tmp_path))
            break
        except DiskFullError as error:
            told.append(error)
    assert [Path(error.path).name for error in told] == refused
    assert all(str(error).startswith(f"{error.path}: the disk is full") for error in told)
    assert temporaries(tmp_path) == []
    assert {"config.toml", "steps.json", "scene.swz", "metrics.json", "00-0000002.json"} <= set(refused)
    assert {p.name for p in directory.iterdir()} >= {"config.toml", "steps.json", "scene.swz", "metrics.json"}
    trained = train_only(*request(toy_plugins, tmp_path))[0].model
    assert trained.digest() == expected
    decoded, _ = open_model(directory / "scene.swz", toy_plugins, torch.device("cpu"))
    assert torch.equal(decoded.means, trained.means)
    assert record.file.digest == decoded.digest()


def test_a_log_line_without_space_names_the_log(tmp_path: Path):
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    with pytest.raises(DiskFullError, match=r"^/dev/full: the disk is full \(.* bytes wanted"):
        RunLog(Path("/dev/full")).write(0, 1, loss=0.5)
    path = tmp_path / "log.jsonl"
    log = RunLog(path)
    log.write(0, 1, loss=0.5)
    whole = path.read_bytes()
    with files_of_at_most(len(whole) + 5), pytest.raises(DiskFullError):
        log.write(0, 2, loss=0.5)
    assert path.read_bytes() == whole
    log.write(0, 2, loss=0.5)
    assert path.read_bytes() == whole + whole.replace(b'"step": 1', b'"step": 2')


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 32 KiB, which only root may make."""
    place = tmp_path / "small"
    place.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", "size=32k", "tmpfs", str(place)], capture_output=True).returncode:
        pytest.skip("no right to mount here")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_real_full_disk(toy_plugins: PluginManager, small_disk: Path, expected: str):
    with pytest.raises(DiskFullError, match=r"the disk is full \([\d,]+ bytes wanted, [\d,]+ free\)"):
        train_only(*request(toy_plugins, small_disk))
    assert temporaries(small_disk) == []
    subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    assert train_only(*request(toy_plugins, small_disk))[0].model.digest() == expected


def test_encode_and_eval_without_space_are_status_1_and_leave_nothing(
    toy_plugins: PluginManager, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    points = torch.rand(40, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    ply = tmp_path / "grey.ply"
    export_ply(gaussians_from_points(PointCloud(points, torch.full((40, 3), 0.5)), max_sh_degree=1), ply)
    commands = {
        "scene.swz": ["encode", str(ply), "--method", "toy", "--out", str(tmp_path / "scene.swz")],
        "view_000.png": [
            "eval", str(ply), "--scene", "demo:tiny", "--no-speed", "--metrics", "l1", "--renders", str(tmp_path / "v"),
        ],
    }  # fmt: skip
    for name, command in commands.items():
        with files_of_at_most(100):
            assert main(command) == 1, command
        told = capsys.readouterr()
        assert told.out == ""
        (line,) = [line for line in told.err.splitlines() if line.startswith("error")]
        assert "may not grow that large here" in line
        assert name in line
        assert temporaries(tmp_path) == []
    assert {p.name for p in tmp_path.iterdir()} <= {"grey.ply", "v"}
