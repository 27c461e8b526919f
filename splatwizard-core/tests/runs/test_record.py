"""The result record: its schema, its nulls, and what is said of a damaged one."""

import json
from pathlib import Path
from typing import Any

import pytest
from pydantic import ValidationError

from splatwizard_core.errors import SplatwizardError, UserInputError
from splatwizard_core.runs.record import (
    Record,
    complete_record,
    missing_reasons,
    read_record,
)


def content(**changes: Any) -> dict[str, Any]:
    """A complete record as plain values."""
    found: dict[str, Any] = {
        "method": "toy", "method_version": 1, "distribution": "sw-toy 0.1", "preset": "paper", "rate": "r1",
        "config": {"config": {"iterations": 3}}, "config_hash": "00", "dataset": "demo", "scene": "demo",
        "protocol": {
            "id": "demo/i/r-1/every8/black/pp-center/q8", "dataset": "demo", "images": "i", "resolution": -1,
            "split": "every8", "background": "black", "principal_point": "center", "quantize8": True, "masked": False,
        },
        "train_views": 7, "test_views": 1, "views": ["a.png"],
        "metrics": {"psnr": {"mean": 30.0, "per_view": [30.0], "direction": "higher"}},
        "file": {"bytes": 12, "sha256": "00", "sections": {"header": 12}, "digest": "00"},
        "counts": {"num_gaussians": 1}, "visible_gaussians": 0.5,
        "codec": {
            "encode_s": 0.1, "decode_s": 0.2, "decode_runs_s": [0.1, 0.2, 0.3], "first_decode_s": 0.3, "jit_s": 0.01,
            "decode_spread": {"n": 3, "mean": 0.2, "std": 0.1, "min": 0.1, "max": 0.3}, "peak_decode_bytes": 1,
            "memory_kind": "rss",
        },
        "speed": {
            "fps": 10.0, "latency_ms_median": 100.0, "latency_ms_p95": 120.0, "prepare_s": 0.0, "frames": 1,
            "rounds": 1, "views": 1, "warmup_frames": 10, "image_size": [4, 3], "jit_s": 0.01, "load_s": 0.3,
            "repeats": 1, "spread": None,
        },
        "memory": {
            "kind": "rss", "model_bytes": 1, "peak_load_bytes": 2, "peak_render_bytes": 2, "peak_reserved_bytes": None,
        },
        "train": {
            "train_s": 1.0, "stages": [{"name": "toy", "seconds": 1.0}], "with_pretraining_s": 1.0, "steps": 3,
            "peak_bytes": 5, "memory_kind": "rss", "breakdown_s": None, "trained_in": "r1",
            "pictures_in": "host", "pretraining": {},
        },
        "phases": [{"phase": "train: toy", "provided_by": [
            {"kind": "stage", "name": "toy", "distribution": "sw-toy", "version": "0.1"}]}],
        "plan": [], "rasterizers": {"train": {"BACKWARD": "reference"}}, "environment": {"python": "3"},
        "flags": ["rss"],
        "unknown": {
            "memory.peak_reserved_bytes": "a CPU has none", "train.breakdown_s": "not profiled",
            "geometry": "not asked for", "speed.spread": "measured once",
            "training_psnr": "not asked for",
        },
        "date": "2026-01-01T00:00:00+00:00",
    }  # fmt: skip
    return {**found, **changes}


def test_a_record_survives_its_file(tmp_path: Path):
    record = Record.model_validate(content())
    record.write(tmp_path / "metrics.json")
    assert read_record(tmp_path / "metrics.json") == record
    assert json.loads((tmp_path / "metrics.json").read_text())["schema_version"] == 3


def test_a_record_of_an_earlier_release_is_read_without_what_it_does_not_have(tmp_path: Path):
    old = content()
    for name in ("geometry", "training_psnr", "raster_options", "contended"):
        old.pop(name, None)
        old["unknown"].pop(name, None)
    (tmp_path / "metrics.json").write_text(json.dumps(old))
    record = read_record(tmp_path / "metrics.json")
    assert (record.training_psnr, record.geometry) == (None, None)
    assert record.metrics["psnr"].mean == 30.0


def test_every_null_has_its_reason():
    assert missing_reasons(Record.model_validate(content())) == []
    without = Record.model_validate(content(unknown={"train.breakdown_s": "not profiled"}))
    nulls = {"speed.spread", "memory.peak_reserved_bytes", "geometry", "training_psnr"}
    assert set(missing_reasons(without)) == nulls


@pytest.mark.parametrize(
    "change",
    [
        {"visible_gaussians": float("nan")},
        {"file": {"bytes": 0, "sha256": "", "sections": {}, "digest": ""}},
        {"metrics": {"psnr": {"mean": 1e308, "per_view": [], "direction": "higher"}}},
    ],
)
def test_what_is_not_in_the_schema_is_refused(change: dict[str, Any]):
    with pytest.raises(ValidationError):
        Record.model_validate(content(**change))


def test_a_damaged_record_is_named_with_its_field(tmp_path: Path):
    path = tmp_path / "metrics.json"
    damaged = content()
    del damaged["file"]["bytes"]
    path.write_text(json.dumps(damaged))
    with pytest.raises(UserInputError, match=r"not a result record of schema 3: file\.bytes: Field required"):
        read_record(path)
    path.write_text("{")
    with pytest.raises(UserInputError, match=r"metrics\.json: not a result record"):
        read_record(path)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('{"method_version": 1' + "0" * 400 + "}", "an integer does not fit 64 bits"),
        ('{"config": ' + "[" * 100_000, "nested deeper than 32 levels"),
        ('{"date": NaN}', "nan is not a finite number"),
    ],
)
def test_a_record_of_a_stranger_is_refused_in_a_line(tmp_path: Path, text: str, told: str):
    path = tmp_path / "metrics.json"
    path.write_text(text)
    with pytest.raises(UserInputError, match=rf"metrics\.json: not a result record of schema 3: .*{told}"):
        read_record(path)


@pytest.mark.parametrize("version", [2, 4, True, None])
def test_a_record_of_another_schema_is_refused(tmp_path: Path, version: Any):
    path = tmp_path / "metrics.json"
    path.write_text(json.dumps(content(schema_version=version)))
    with pytest.raises(UserInputError, match="not a result record of schema 3: schema_version: "):
        read_record(path)


def test_what_a_scene_was_trained_with_may_hold_null_and_what_is_unknown_of_it_needs_a_reason():
    scene = {"file": {}, "preset": None, "config": {"cap": None}, "steps": 3, "train_s": 1.0, "made_by": {}}
    found = content()
    found["train"] = {**found["train"], "pretraining": {"3dgs": scene}}
    assert missing_reasons(Record.model_validate(found)) == ["train.pretraining.3dgs.preset"]


def test_nulls_get_the_reasons_of_their_fields_and_keep_better_ones():
    values = content(unknown={"geometry": "no mesh"})
    values["speed"]["spread"] = values["train"]["breakdown_s"] = None
    record = complete_record(values)
    assert record.unknown["geometry"] == "no mesh"
    assert record.unknown["speed.spread"] == "measured once (--repeats N)"
    assert record.unknown["train.breakdown_s"].startswith("not profiled")
    values["codec"]["encode_s"] = None
    with pytest.raises(SplatwizardError, match=r"null without a reason: codec\.encode_s"):
        complete_record(values)
