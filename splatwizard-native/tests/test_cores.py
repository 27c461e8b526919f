"""Cores that this process may use, in control groups of both versions."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from splatwizard_native import cores


def group(root: Path, path: str, **files: str) -> None:
    folder = root / path
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text + "\n")


def quota(root: Path, membership: str) -> float | None:
    (root / "membership").write_text(membership)
    return cores.cgroup_quota(root / "membership", root)


def test_the_tightest_of_the_groups_above_counts_in_version_2(tmp_path):
    group(tmp_path, "user", cpu__max="150000 100000")
    group(tmp_path, "user/job", cpu__max="max 100000")
    assert quota(tmp_path, "0::/user/job\n") == 1.5


def test_version_1_is_read_where_the_cpu_controller_is(tmp_path):
    group(tmp_path, "cpu/docker/a", cpu__cfs_quota_us="300000", cpu__cfs_period_us="100000")
    lines = "9:memory:/docker/a\n3:cpu,cpuacct:/docker/a\n2:cpuset:/docker/a\n"
    assert quota(tmp_path, lines) == 3.0
    assert quota(tmp_path, lines.replace("cpu,", "")) is None


def test_a_container_that_sees_its_own_group_at_the_root_finds_its_quota(tmp_path):
    group(tmp_path, "", cpu__max="200000 100000")
    assert quota(tmp_path, "0::/of/the/host\n") == 2.0


@pytest.mark.parametrize("text", ["max 100000", "", "0 0", "many few", "-1 100000"])
def test_no_quota_or_nonsense_is_no_limit(tmp_path, text):
    group(tmp_path, "a", cpu__max=text)
    group(tmp_path, "cpu/a", cpu__cfs_quota_us="-1", cpu__cfs_period_us="100000")
    assert quota(tmp_path, "0::/a\n3:cpu:/a\n") is None


def test_no_control_groups_are_no_limit(tmp_path):
    assert cores.cgroup_quota(tmp_path / "none", tmp_path) is None


@pytest.mark.parametrize(("limit", "expected"), [(None, 4), (1.5, 2), (0.2, 1), (64.0, 4)])
def test_a_quota_is_rounded_up_and_never_more_than_the_affinity(monkeypatch, limit, expected):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3}, raising=False)
    monkeypatch.setattr(cores, "cgroup_quota", lambda: limit)
    assert cores.available_cores() == expected
