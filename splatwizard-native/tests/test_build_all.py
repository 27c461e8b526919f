"""Building every module of a list ahead of time."""

import sys

from native_package import call, needs_compiler
from sw_doctor.building import build_all


@needs_compiler
def test_build_all_builds_every_target_and_reports_what_fails(package):
    package.write(
        "native.py",
        "from splatwizard_native import NativeModule\n"
        f"GOOD = NativeModule('good', '{package.folder.name}', 'face.h', ('answer.cpp',), ('*.h',))\n"
        f"BAD = NativeModule('bad', '{package.folder.name}', 'face.h', ('bad.cpp',), ('*.h',))\n"
        "NOT_ONE = 3\n",
    )
    package.write("bad.cpp", "nonsense\n")
    targets = [f"{package.folder.name}.native:{name}" for name in ("GOOD", "BAD", "NOT_ONE")] + ["no.such.module:X"]
    good, bad, not_one, absent = build_all(targets, jobs=1)
    assert [row.state for row in (good, bad, not_one, absent)] == ["built", "failed", "failed", "failed"]
    assert (good.name, bad.name) == ("good", targets[1])
    assert "bad.cpp:1:1: error" in str(bad.error)
    assert "not a NativeModule but int" in str(not_one.error)
    assert "no.such.module" in str(absent.error)
    assert call(good.path) == 42
    assert build_all(targets)[0].state == "up to date"
    into = build_all(targets[:1], into_packages=True)[0]
    assert into.path is not None
    assert into.path.parent == package.folder / "prebuilt"
    assert build_all([]) == []


def test_build_all_for_cuda_fails_where_it_would_leave_kernels_out(package, monkeypatch):
    monkeypatch.setattr("sw_doctor.building.toolkit_mismatch", lambda: "there is none")
    monkeypatch.setenv("CXX", sys.executable)  # there, and not called
    package.write(
        "native.py",
        "from splatwizard_native import NativeModule\n"
        f"GPU = NativeModule('gpu', '{package.folder.name}', 'face.h', ('answer.cpp',), cuda_sources=('fill.cu',))\n",
    )
    (row,) = build_all([f"{package.folder.name}.native:GPU"], cuda=True)
    assert (row.state, row.error) == ("failed", "the CUDA kernels of 'gpu' cannot be built: there is none")
    assert package.compilations == 0
