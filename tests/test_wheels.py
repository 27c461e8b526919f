"""Every package with kernels can put them, compiled, into its wheel."""

from __future__ import annotations

import importlib.metadata
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import build_cuda_wheel  # noqa: E402
import build_wheels  # noqa: E402

from splatwizard_core.cli.list_plugins import gather  # noqa: E402
from splatwizard_native import Toolchain  # noqa: E402
from splatwizard_native.toolchain import Job  # noqa: E402

WITH_KERNELS = [
    package
    for package in build_wheels.packages([])
    if any(build_wheels.DECLARES.search(path.read_text("utf-8")) for path in (package / "src").rglob("*native.py"))
]


def test_packages_with_kernels_are_found():
    assert {package.name for package in WITH_KERNELS} >= {"splatwizard-native", "sw-codecs", "sw-rasterizers"}


@pytest.mark.parametrize("package", WITH_KERNELS, ids=lambda package: package.name)
def test_its_wheel_takes_them_and_tells_the_platform(package):
    project = (package / "pyproject.toml").read_text("utf-8")
    assert 'artifacts = ["**/prebuilt/*.so", "**/prebuilt/*.json"]' in project
    assert "\n[tool.hatch.build.targets.wheel.hooks.custom]\n" in project
    hook = (package / "hatch_build.py").read_text("utf-8")
    assert hook == (ROOT / "splatwizard-native" / "hatch_build.py").read_text("utf-8")


def test_each_package_lists_the_state_of_all_kernels_that_it_computes_with():
    listed = {row["distribution"]: row["kernels"] for row in gather()["plugins"]}
    assert listed["sw-hac"].keys() == {"sw_anchors", "sw_codecs", "sw_hac"}
    assert listed["sw-hac"]["sw_anchors"] == listed["sw-cat-3dgs"]["sw_anchors"]
    assert {state for kernels in listed.values() for state in kernels.values()} <= {"prebuilt", "built", "reference"}


def test_the_tag_names_the_newest_glibc_of_all_libraries(tmp_path):
    for name, symbols in (("a.so", b"\0GLIBC_2.2.5\0GLIBC_2.34\0"), ("b.so", b"\0GLIBC_2.29\0GLIBCXX_3.4.30\0")):
        (tmp_path / name).write_bytes(symbols)
    libraries = sorted(tmp_path.iterdir())
    assert re.fullmatch(r"manylinux_2_34_aarch64", build_wheels.platform_of(libraries, "aarch64"))


def test_zig_is_told_of_cpus_by_its_own_names_and_its_target_is_part_of_its_version(tmp_path, monkeypatch):
    zig, job = tmp_path / "zig", Job(tmp_path / "a.cpp", tmp_path / "a.o", ("-O3", "-march=x86-64-v3"))
    zig.write_text('#!/bin/sh\necho "zig $*"\n')
    zig.chmod(0o755)
    monkeypatch.setenv("CXX", f"{zig} c++ -target x86_64-linux-gnu.2.17")
    tools = build_wheels.toolchain()
    tools.compile([job], tmp_path / "log")
    assert "-O3 -march=x86_64_v3" in (tmp_path / "log").read_text()
    assert tools.version().endswith(" c++ -target x86_64-linux-gnu.2.17")
    monkeypatch.setenv("CXX", sys.executable)
    assert type(build_wheels.toolchain()) is Toolchain


def test_the_distribution_of_cuda_kernels_pins_what_it_was_built_from(tmp_path):
    found = list(build_cuda_wheel.modules())
    with_kernels = {
        module.cuda.name for package in WITH_KERNELS for module in build_wheels.declared(package) if module.cuda
    }
    assert {module.name for _, module in found} == with_kernels
    versions = {package.name: build_cuda_wheel.version_of(package) for package, _ in found}
    for name, content in (("a.so", b"library"), ("a.json", b"{}")):
        (tmp_path / name).write_bytes(content)
    wheel = build_cuda_wheel.write_wheel([tmp_path / "a.so"], 13, versions, "manylinux_2_17_x86_64", tmp_path)
    assert wheel.name == f"splatwizard_cuda13-{versions['sw-rasterizers']}-py3-none-manylinux_2_17_x86_64.whl"
    installed = tmp_path / "site"
    pip = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--no-index", "--target", installed, wheel]
    subprocess.run(pip, check=True)
    assert (installed / "splatwizard_cuda13" / "prebuilt" / "a.so").read_bytes() == b"library"
    (distribution,) = importlib.metadata.distributions(path=[str(installed)])
    assert distribution.requires == [f"{name}=={version}" for name, version in sorted(versions.items())]
    with zipfile.ZipFile(wheel) as inside:
        assert {info.date_time[:3] for info in inside.infolist()} == {(2020, 1, 1)}


def test_only_gpus_that_a_compiler_knows_are_asked_for(tmp_path):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text("#!/bin/sh\necho compute_75 compute_80 compute_86 compute_89 compute_90 compute_90a\n")
    nvcc.chmod(0o755)
    assert build_cuda_wheel.offered(str(nvcc)) == ["7.5", "8.0", "8.6", "8.9", "9.0+PTX"]


@pytest.mark.parametrize(
    ("told", "flags"),
    [("--compress-mode {default|size|speed|balance|none}", "--compress-mode=size"), ("", "-Xfatbin -compress-all")],
)
def test_a_cuda_compiler_makes_the_smallest_libraries_that_it_can(tmp_path, told, flags):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text(f"#!/bin/sh\necho '{told}'\n")
    nvcc.chmod(0o755)
    assert build_cuda_wheel.compression(str(nvcc)) == flags
