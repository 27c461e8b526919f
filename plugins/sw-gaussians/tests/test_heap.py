"""Numbers that lie in a file: the same, writable, and not in memory once they were let go."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from sw_gaussians import heap


def of_files() -> int:
    """Bytes of files among the resident memory of this process."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * sum(int(line.split()[1]) for line in lines if line.startswith(("RssFile", "RssShmem")))


def test_numbers_stay_what_they_are(tmp_path):
    values = torch.arange(12.0).view(4, 3)
    found = heap.in_file(values, tmp_path)
    heap.trim()
    assert torch.equal(found, values)
    found[1] = 7
    heap.trim()
    assert found[1].tolist() == [7, 7, 7]
    assert list(tmp_path.iterdir()) == []


def test_what_was_looked_at_leaves_memory_again():
    if not sys.platform.startswith("linux"):
        pytest.skip("the system does not tell it")
    found = heap.in_file(torch.ones(8 << 20))
    heap.trim()
    least = of_files()
    assert float(found.sum()) == 8 << 20
    assert of_files() > least + 0.9 * found.nbytes
    heap.trim()
    assert of_files() < least + 0.1 * found.nbytes


def test_where_there_is_no_room_they_stay_in_memory(tmp_path, monkeypatch):
    values = torch.ones(3)
    monkeypatch.setattr(heap.shutil, "disk_usage", lambda folder: SimpleNamespace(free=2 * values.nbytes - 1))
    assert heap.in_file(values, tmp_path).data_ptr() == values.data_ptr()
    monkeypatch.undo()
    assert heap.in_file(values, tmp_path / "none").data_ptr() == values.data_ptr()
    assert heap.in_file(values[:0]).numel() == 0
