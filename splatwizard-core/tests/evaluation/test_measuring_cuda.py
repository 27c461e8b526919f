"""Speed and memory where there is a GPU: the clock of the harness against CUDA's own."""

import json
import statistics
from pathlib import Path

import pytest
import torch

from splatwizard_core.cli.main import main
from splatwizard_core.evaluation.speed import measure_speed

pytestmark = [
    pytest.mark.cuda,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device"),
]


def test_throughput_is_that_of_cudas_own_events():
    device = torch.device("cuda")
    a = torch.randn(4096, 4096, device=device)
    events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []

    def render(view: int) -> torch.Tensor:
        begin, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        begin.record()
        product = a @ a
        end.record()
        events.append((begin, end))
        return product

    report = measure_speed(render, list(range(10)), device)
    # Both clocks look at the same frames, so what else the GPU has to do counts for both.
    together = events[report.warmup_frames : report.warmup_frames + report.frames]
    one_by_one = events[report.warmup_frames + report.frames :]
    assert len(one_by_one) == len(together) == report.frames
    milliseconds = together[0][0].elapsed_time(together[-1][1])
    assert report.fps == pytest.approx(1e3 * report.frames / milliseconds, rel=0.05)
    drawing = statistics.median(begin.elapsed_time(end) for begin, end in one_by_one)
    assert 0.99 * drawing <= report.latency_ms_median <= 3 * drawing
    assert report.memory_kind == "cuda"
    assert report.peak_bytes >= 2 * 4096 * 4096 * 4  # the factor and the product
    assert report.peak_reserved_bytes >= report.peak_bytes


def test_an_evaluation_on_cuda_reports_the_allocators_memory(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    out = ["--scene", "demo:tiny", "--rate", "r6", "--set", "iterations=10", "--out", str(tmp_path)]
    assert main(["run", *out, "--device", "cuda"]) == 0
    record = json.loads((tmp_path / "demo-tiny" / "3dgs" / "r6" / "metrics.json").read_text())
    assert record["memory"]["kind"] == record["train"]["memory_kind"] == record["codec"]["memory_kind"] == "cuda"
    assert "rss" not in record["flags"]
    assert record["memory"]["peak_reserved_bytes"] >= record["memory"]["peak_render_bytes"] > 0
    assert record["speed"]["frames"] >= 100 or record["speed"]["rounds"] * 8 / record["speed"]["fps"] >= 1.9
    assert record["environment"]["gpu"]["name"]
