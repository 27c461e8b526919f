"""Formats as codecs and methods: their bytes are the format's own, and what is decoded is what another reader finds."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from sw_gaussians.ply import export_ply
from sw_gaussians.surfels import SurfelModel
from sw_interchange import decode, encode, from_gaussians, to_gaussians

from splatwizard_core.api import (
    BitstreamError,
    ConfigError,
    ContainerReader,
    ContainerWriter,
    GaussianModel,
    UserInputError,
    create_method,
)
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import load_plugins

PLUGINS = load_plugins()
DEGREES = {"spz": 3, "sog": 3, "compressed-ply": 3, "splat": 0}
NAMES = list(DEGREES)


def model_of(n: int = 300, degree: int = 3) -> GaussianModel:
    g = torch.Generator().manual_seed(7)
    return GaussianModel.from_tensors(
        torch.randn(n, 3, generator=g), 0.4 * torch.randn(n, 1, 3, generator=g),
        0.1 * torch.randn(n, (degree + 1) ** 2 - 1, 3, generator=g), torch.randn(n, generator=g),
        0.5 * torch.randn(n, 3, generator=g) - 3, torch.randn(n, 4, generator=g),
    )  # fmt: skip


def written(name: str, model: GaussianModel, **settings: object) -> ContainerReader:
    method = create_method(PLUGINS, name, {f"codec.settings.{key}": value for key, value in settings.items()})
    writer = ContainerWriter(name, 1)
    method.encode(model, writer)
    return ContainerReader(writer.to_bytes(), "file.swz")


def read(name: str, reader: ContainerReader) -> GaussianModel:
    model = PLUGINS.methods.load(name)(PLUGINS, None).decode(reader)
    reader.finish()
    assert isinstance(model, GaussianModel)
    return model


@pytest.mark.parametrize("name", NAMES)
def test_the_section_is_the_file_of_the_format(name: str):
    model = model_of()
    reader = written(name, model)
    own, _ = encode(from_gaussians(model), name, **({"level": 6} if name == "spz" else {}))
    assert reader.section("file") == own
    assert reader.size - len(own) < 350
    found, wanted = read(name, reader), to_gaussians(decode(own, name))
    for (key, ours), (_, theirs) in zip(found.named_parameters(), wanted.named_parameters(), strict=True):
        assert torch.equal(ours, theirs), key
    assert found.active_sh_degree == DEGREES[name]
    # Every Gaussian is still there, wherever it went: the spread of the positions is that of the model.
    torch.testing.assert_close(found.means.mean(dim=0), model.means.mean(dim=0), atol=1e-2, rtol=0)
    torch.testing.assert_close(found.means.std(dim=0), model.means.std(dim=0), atol=1e-2, rtol=0)


@pytest.mark.parametrize(("version", "level"), [(3, 6), (4, 12)])
def test_spz_is_compressed_as_hard_as_by_the_tools_of_its_authors(version: int, level: int):
    model = model_of(2000)
    scene = from_gaussians(model)
    files = {n: encode(scene, "spz", version=version, level=n)[0] for n in (1, 3, level)}
    assert written("spz", model, version=version).section("file") == files[level]
    assert written("spz", model, version=version, level=1).section("file") == files[1]
    assert len(files[level]) < len(files[3])


def test_levels_that_gzip_does_not_have_are_refused():
    model = model_of(5)
    for settings in ({"level": 10}, {"level": 15, "version": 3}):
        with pytest.raises(ConfigError, match=r"'codec\.settings\.level'.*: must be at most 9, except with version 4"):
            written("spz", model, **settings)
    for settings in ({"level": 9}, {"level": 15, "version": 4}):
        assert read("spz", written("spz", model, **settings)).num_rows == 5


@pytest.mark.parametrize("name", NAMES)
def test_small_and_empty_models_and_lower_degrees_come_back(name: str):
    for degree in (0, 2):
        assert read(name, written(name, model_of(5, degree))).max_sh_degree == min(degree, DEGREES[name])
    empty = read(name, written(name, model_of(0)))
    assert (empty.num_rows, empty.max_sh_degree) == (0, DEGREES[name])


@pytest.mark.parametrize(("name", "low", "high"), [
    ("spz", {"sh1_bits": 4, "sh_bits": 2}, {"sh1_bits": 8, "sh_bits": 8}), ("sog", {"palette": 8}, {"palette": 256}),
])  # fmt: skip
def test_rate_points_trade_bytes_for_loss(name: str, low: dict[str, object], high: dict[str, object]):
    model = model_of(800)
    small, large = written(name, model, **low), written(name, model, **high)
    assert small.size < large.size

    def error(reader: ContainerReader) -> float:
        found = read(name, reader)  # .sog comes back in another order: each with its nearest
        nearest = torch.cdist(found.means.detach(), model.means.detach()).argmin(dim=1)
        return (found.sh_rest - model.sh_rest[nearest]).square().mean().item()

    assert error(small) > 1.5 * error(large)
    for rate in PLUGINS.methods.load(name).RATES.values():
        settings = {key.removeprefix("codec.settings."): value for key, value in rate.items()}
        assert read(name, written(name, model_of(40), **settings)).num_rows == 40


@pytest.mark.parametrize("name", NAMES)
def test_damage_and_lies_are_told(name: str):
    reader = written(name, model_of())
    data = reader.section("file")

    def damaged(content: bytes, **values: object) -> ContainerReader:
        writer = ContainerWriter(name, 1)
        writer.static.update(reader.static | values)
        writer.raster.update(reader.raster)
        writer.add("file", content)
        return ContainerReader(writer.to_bytes(), "file.swz")

    for bad in (data[: len(data) // 2], b"", b"\0" * 64):
        with pytest.raises(BitstreamError):
            read(name, damaged(bad))
    for count in (299, 301):
        with pytest.raises(BitstreamError):
            read(name, damaged(data, num_gaussians=count))
    with pytest.raises(BitstreamError, match="may stand for at most"):
        read(name, damaged(data, num_gaussians=2**31))
    with pytest.raises(BitstreamError, match="sh_degree"):
        read(name, damaged(data, sh_degree=4))


@pytest.mark.parametrize("name", NAMES)
def test_rows_that_lie_column_after_column_are_written_alike(name: str):
    model = model_of(20)
    wanted = written(name, model).section("file")
    for key in model.RAW:
        values = getattr(model, key).detach()
        turned = values.flatten(1).T.contiguous().T.reshape(values.shape) if values.dim() == 2 else values
        setattr(model, key, torch.nn.Parameter(turned))
    assert not model.means.is_contiguous()
    assert written(name, model).section("file") == wanted


@pytest.mark.parametrize("name", NAMES)
def test_surfels_are_refused(name: str):
    n = 4
    surfels = SurfelModel.from_tensors(
        torch.zeros(n, 3), torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.zeros(n), torch.zeros(n, 2),
        torch.ones(n, 4),
    )  # fmt: skip
    with pytest.raises(UserInputError, match="surfels"):
        written(name, surfels)


@pytest.mark.slow
def test_a_run_encodes_a_trained_scene_and_decodes_it_in_a_fresh_process(tmp_path: Path, capsys):
    export_ply(model_of(50, 1), tmp_path / "model.ply")
    ply, out = str(tmp_path / "model.ply"), str(tmp_path / "out")
    status = main(["run", "--method", "spz", "--rate", "r3", "--scene", "demo:tiny", "--init", ply, "--out", out])
    assert status == 0
    (record,) = (tmp_path / "out").rglob("metrics.json")
    facts = json.loads(record.read_text())
    file = record.parent / "scene.swz"
    assert facts["counts"] == {"num_gaussians": 50}
    reader = ContainerReader.open(file)
    assert reader.size == file.stat().st_size
    own, _ = encode(from_gaussians(read("spz", reader)), "spz", sh1_bits=8, sh_bits=8)
    assert decode(own, "spz").num_gaussians == 50


def test_what_a_codec_clamps_is_told(caplog):
    model = model_of()
    with torch.no_grad():
        model.log_scales[0] = 20
        model.means[1] = 5000
    written("spz", model)
    assert "spz: 3 values of log_scales lie beyond its range" in caplog.text
    assert "10 fractional bits instead of 12" in caplog.text
