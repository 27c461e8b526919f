"""Every package with kernels can put them, compiled, into its wheel."""

from __future__ import annotations

import re
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

import build_cuda_wheel  # noqa: E402
import build_wheels  # noqa: E402

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


def test_the_tag_names_the_newest_glibc_of_all_libraries(tmp_path):
    for name, symbols in (("a.so", b"\0GLIBC_2.2.5\0GLIBC_2.34\0"), ("b.so", b"\0GLIBC_2.29\0GLIBCXX_3.4.30\0")):
        (tmp_path / name).write_bytes(symbols)
    libraries = sorted(tmp_path.iterdir())
    assert re.fullmatch(r"manylinux_2_34_aarch64", build_wheels.platform_of(libraries, "aarch64"))


def test_the_distribution_of_cuda_kernels_pins_what_it_was_built_from(tmp_path):
    found = list(build_cuda_wheel.modules())
    assert {module.name for _, module in found} == {
        module.cuda.name for package in WITH_KERNELS for module in build_wheels.declared(package) if module.cuda
    }
    versions = {package.name: build_cuda_wheel.version_of(package) for package, _ in found}
    into = build_cuda_wheel.write_project(tmp_path, 13, versions)
    (into / "a.so").write_bytes(b"GLIBC_2.17")
    wheel = build_wheels.packed(tmp_path, "manylinux_2_17_x86_64", tmp_path)
    assert wheel.name == f"splatwizard_cuda13-{versions['sw-hac']}-py3-none-manylinux_2_17_x86_64.whl"
    with zipfile.ZipFile(wheel) as inside:
        assert "splatwizard_cuda13/prebuilt/a.so" in inside.namelist()
        (metadata,) = [name for name in inside.namelist() if name.endswith("METADATA")]
        pinned = re.findall(r"^Requires-Dist: (.+)$", inside.read(metadata).decode(), re.MULTILINE)
    assert pinned == [f"{name}=={version}" for name, version in sorted(versions.items())]


def test_only_gpus_that_a_compiler_knows_are_asked_for(tmp_path):
    nvcc = tmp_path / "nvcc"
    nvcc.write_text("#!/bin/sh\necho compute_75 compute_80 compute_86 compute_89 compute_90 compute_90a\n")
    nvcc.chmod(0o755)
    assert build_cuda_wheel.offered(str(nvcc)) == ["7.5", "8.0", "8.6", "8.9", "9.0+PTX"]
