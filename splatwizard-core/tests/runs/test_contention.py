"""Times beside other processes: what steps tell of them, and threads of the decoding process."""

from __future__ import annotations

import pytest

from splatwizard_core.runs import fresh
from splatwizard_core.runs.facts import contention
from splatwizard_native import CoreTime, core_time

DECODED = {
    "method": "toy", "method_version": 1, "digest": "ab", "counts": {}, "bytes": 1, "sections": {"header": 1},
    "decode_s": 1.0, "peak_bytes": 1, "memory_kind": "rss",
}  # fmt: skip


@pytest.mark.parametrize(("waited", "told"), [(0, {}), (3 * 10**12, {"train": 0.25})])
def test_a_phase_is_told_if_its_threads_had_to_wait(monkeypatch, waited, told):
    times = iter([{"1": (0, 0)}, {"1": (10**12, waited)}])
    monkeypatch.setattr(core_time, "_threads", lambda: next(times))
    assert contention("train", CoreTime()) == told


def test_the_decoding_process_gets_the_number_of_threads(monkeypatch, tmp_path):
    asked = []
    monkeypatch.setattr(fresh, "run_fresh", lambda arguments, **_: asked.append(list(arguments)) or DECODED)
    (tmp_path / "a.swz").write_bytes(b"x")
    fresh.decode_fresh(tmp_path / "a.swz", "cpu", threads=3)
    assert asked[0][:2] == ["decode", "a.swz"]
    assert asked[0][asked[0].index("--set") + 1] == "threads=3"
