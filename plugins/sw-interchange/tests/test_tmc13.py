"""`tmc13` through a stand-in for the program, which has its command line: nothing here ran the program itself."""

from __future__ import annotations

import importlib.util
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from sw_interchange import tmc3
from sw_interchange.tmc13 import SHARED, Tmc13, Tmc13Config, colors, luma_chroma, parts_of

from splatwizard_core.api import (
    BitstreamError,
    CapabilityError,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    SplatwizardError,
)
from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides

FAKE = Path(__file__).with_name("fake_tmc3.py")


@pytest.fixture(autouse=True)
def _without_gradients() -> Iterator[None]:
    with torch.no_grad():
        yield


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("tmc3") / "tmc3"
    found.write_text(f'#!/bin/sh\nexec {shlex.quote(sys.executable)} {shlex.quote(str(FAKE))} "$@"\n')
    found.chmod(0o755)
    return found


@pytest.fixture
def named(program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The stand-in under its name, called without a process of its own."""
    spec = importlib.util.spec_from_file_location("fake_tmc3", FAKE)
    assert spec is not None
    assert spec.loader is not None
    fake = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(fake)

    def run(command: list[str], **how: object) -> subprocess.CompletedProcess[bytes]:
        assert command[0] == str(program)
        try:
            fake.main(command[1:])
        except SystemExit as error:
            return subprocess.CompletedProcess(command, 1, b"", str(error).encode())
        return subprocess.CompletedProcess(command, 0, b"", b"")

    monkeypatch.setenv(tmc3.VARIABLE, str(program))
    monkeypatch.setattr(tmc3.subprocess, "run", run)


def test_a_process_gives_points_and_values_back_and_its_last_words(program: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(tmc3.VARIABLE, str(program))
    points = np.array([[3, 1, 5], [0, 2, 9], [3, 1, 5]])
    found, values = tmc3.decode(tmc3.encode(points, np.array([7, 4095, 8]), bits=12, qp=4))
    assert values is not None
    assert sorted(map(tuple, np.column_stack([found, values]))) == [(0, 2, 9, 4095), (3, 1, 5, 7), (3, 1, 5, 8)]
    monkeypatch.setenv("FAKE_TMC3", "fail")
    with pytest.raises(SplatwizardError, match=r"tmc3 failed with status 1: Error: could not open input file!"):
        tmc3.encode(points, None, bits=12, qp=4)


def model_of(n: int = 40, degree: int = 0, spread: float = 2.0) -> GaussianModel:
    g = torch.Generator().manual_seed(0)
    return GaussianModel.from_tensors(
        spread * torch.randn(n, 3, generator=g), 0.4 * torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), 2 * torch.randn(n, generator=g),
        0.3 * torch.randn(n, 3, generator=g) - 4, 3 * torch.randn(n, 4, generator=g),
    )  # fmt: skip


def written(model: GaussianModel, rate: str = "r5", **values: object) -> ContainerReader:
    config = apply_overrides(Tmc13Config(), {**Tmc13.RATES[rate], **values}, source="test")
    writer = ContainerWriter("tmc13", 1)
    Tmc13(load_plugins(), config).encode(model, writer)
    return ContainerReader(writer.to_bytes(), "file.swz")


def read(reader: ContainerReader) -> GaussianModel:
    found = Tmc13(load_plugins(), None).decode(reader)
    assert isinstance(found, GaussianModel)
    return found


def test_positions_come_back_to_half_a_step_and_values_to_the_loss_of_their_qp(named: None):
    model = model_of()
    reader = written(model)
    decoded = read(reader)
    rows = torch.cdist(decoded.means.double(), model.means.double()).argmin(dim=1)
    assert sorted(rows.tolist()) == list(range(40))
    assert float((decoded.means - model.means[rows]).abs().max()) <= 256 / (2**18 - 1) / 2 + 1e-6
    for name, (low, high) in (("log_scales", (-26, 4)), ("opacity_logits", (-7, 18))):  # QP 4 is a step of one code
        error = float((getattr(decoded, name) - getattr(model, name)[rows]).abs().max())
        assert error <= (high - low) / 4095 / 2 + 1e-6, name
    chroma_step = 8 / 4095 * (0.5 + 2 ** (2 / 6) / 2)  # of rounding to codes, and of QP 6
    assert float((decoded.sh_dc - model.sh_dc[rows]).abs().max()) <= 3 * chroma_step


def test_smaller_rate_points_lose_more(named: None):
    model = model_of()
    errors = []
    for rate in ("r1", "r5"):
        decoded = read(written(model, rate))
        rows = torch.cdist(decoded.means.double(), model.means.double()).argmin(dim=1)
        errors.append(float((decoded.sh_dc - model.sh_dc[rows]).abs().mean()))
    assert errors[0] > 5 * errors[1]


def test_the_points_are_in_the_file_once(named: None):
    reader = written(model_of(), bits=8)
    assert [each.kind for each in tmc3.units_of(reader.section("position"))] == [0, 2]
    for name, columns in (("sh0", 3), ("opacity", 1), ("scaling", 3), ("rotation", 4)):
        kinds = [[each.kind for each in tmc3.units_of(part)] for part in parts_of(reader.section(name))]
        assert kinds == [[0, SHARED, 4]] * columns


def test_all_bands_have_the_qp_of_their_band_and_plane(named: None, monkeypatch: pytest.MonkeyPatch):
    asked: list[int] = []

    def noted(points: np.ndarray, values: np.ndarray | None, *, bits: int, qp: int) -> bytes:
        asked.append(qp)
        return tmc3.stream_of([tmc3.Unit(2, b"points")])

    monkeypatch.setattr(tmc3, "encode", noted)
    written(model_of(3, 3), "r3")
    bands = [10, 14, 14] + 3 * [22, 26, 26] + 5 * [30, 34, 34] + 7 * [33, 37, 37]
    assert asked == [0, *bands, *[10] * 8]


def test_an_empty_model_needs_no_program(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(tmc3.VARIABLE, raising=False)
    reader = written(model_of(0, 3))
    assert not reader.sections
    assert read(reader).num_rows == 0


def test_luma_and_chroma_keep_the_range_and_come_back():
    values = np.random.default_rng(0).uniform(-4, 4, (50, 15))
    turned = luma_chroma(values)
    assert np.abs(turned).max() <= 4
    assert np.abs(colors(turned) - values).max() < 1e-12


def test_a_range_that_would_clip_is_taken_from_the_values(named: None):
    model = model_of(12, spread=400.0)
    reader = written(model)
    assert reader.static["range_auto"] == ["position"]
    width = float((model.means.amax(0) - model.means.amin(0)).max())
    decoded = read(reader)
    rows = torch.cdist(decoded.means.double(), model.means.double()).argmin(dim=1)
    assert float((decoded.means - model.means[rows]).abs().max()) <= width / (2**18 - 1)


@pytest.mark.parametrize(
    ("value", "told"),
    [
        (None, "not available: tmc13 needs MPEG's program tmc3: build mpeg-pcc-tmc13"),
        ("/no/such/tmc3", "is no program that can be run"),
        ("./build/tmc3", "give the whole path"),
    ],
)
def test_without_the_program_it_says_what_to_do(value: str | None, told: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv(tmc3.VARIABLE, raising=False)
    if value is not None:
        monkeypatch.setenv(tmc3.VARIABLE, value)
    with pytest.raises(CapabilityError, match=told):
        written(model_of())


def test_the_programs_last_words_are_told(named: None, monkeypatch: pytest.MonkeyPatch):
    reader = written(model_of())
    monkeypatch.setenv("FAKE_TMC3", "fail")
    with pytest.raises(BitstreamError, match=r"section 'position'.*tmc3 failed with status 1: Error: could not open"):
        read(reader)


def test_a_column_of_other_points_is_refused(named: None):
    reader, other = written(model_of(20)), written(model_of(20, spread=1.0))
    writer = ContainerWriter("tmc13", 1)
    writer.static.update(reader.static)
    for name in reader.sections:
        (whole,) = [reader] if name != "opacity" else [other]
        data = whole.section(name)
        if name == "opacity":  # with its own geometry
            units = tmc3.units_of(next(parts_of(data)))
            geometry = tmc3.units_of(other.section("position"))[1]
            content = tmc3.stream_of([geometry if each.kind == SHARED else each for each in units])
            data = len(content).to_bytes(4, "little") + content
        writer.add(name, data)
    with pytest.raises(BitstreamError, match=r"section 'opacity'.*a column's points are not those of the positions"):
        read(ContainerReader(writer.to_bytes(), "file.swz"))


@pytest.mark.parametrize("data", [b"\x02", b"\x02\0\0\0\x09abc"])
def test_a_cut_stream_is_refused(data: bytes):
    with pytest.raises(BitstreamError, match="ends within"):
        tmc3.units_of(data)


def test_a_text_ply_is_read_too():
    text = b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\n"
    points, values = tmc3.points_of(text + b"property uint16 reflectance\nend_header\n1 2 3 7\n4 5 6 8\n")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert values is not None
    assert values.tolist() == [7, 8]


def test_sw_run_says_it_before_it_trains_a_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.delenv(tmc3.VARIABLE, raising=False)
    assert main(["run", "--scene", "demo:tiny", "--method", "gsc-quant,tmc13", "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error: method 'tmc13': not available: tmc13 needs MPEG's program tmc3")
    assert not (tmp_path / "out").exists()


def test_sw_encode_says_it_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    from sw_gaussians.ply import export_ply

    monkeypatch.delenv(tmc3.VARIABLE, raising=False)
    export_ply(model_of(3), tmp_path / "m.ply")
    words = ["encode", str(tmp_path / "m.ply"), "--method", "tmc13", "--out", str(tmp_path / "m.swz")]
    assert main(words) == 2
    assert capsys.readouterr().err.strip().splitlines()[-1].startswith("error: not available: tmc13 needs")
