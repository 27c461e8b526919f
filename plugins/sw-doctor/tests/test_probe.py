"""Trials of `sw doctor` with torch: the GPU, kernels, entries, rasterizers, scenes, the main job."""

from __future__ import annotations

import sys
import textwrap
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from sw_doctor import probe

from splatwizard_core.plugins import PluginManager, load_plugins
from splatwizard_native import NativeModule


def test_torch_multiplies():
    (found,) = probe.check_torch()
    assert (found.state, found.needed) == ("ok", True)


def test_without_torch_nothing_that_needs_it_is_tried(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    found = probe.check_torch()[0]
    assert (found.state, found.needed) == ("missing", True)
    assert [name for name, _ in probe.steps()] == ["torch"]


@pytest.mark.parametrize(
    ("driver", "built", "state"),
    [(None, None, "missing"), ("580.1", None, "broken"), (None, "13.0", "missing"), ("580.1", "13.0", "broken")],
)
def test_why_there_is_no_cuda(monkeypatch, driver, built, state):
    import torch

    def no_gpu():
        raise RuntimeError("CUDA driver version is insufficient\nfor CUDA runtime version")

    monkeypatch.setattr(probe, "nvidia_driver", lambda: driver)
    monkeypatch.setattr(torch.version, "cuda", built)
    monkeypatch.setattr(torch.cuda, "init", no_gpu)
    (found,) = probe.check_cuda()
    assert found.state == state
    assert (found.mend is None) == (driver is None and built is None)
    assert not found.needed
    if driver and built is None:
        assert "pip install" in (found.mend or "")


@pytest.fixture
def kernels(tmp_path, monkeypatch) -> NativeModule:
    """A native module with a source, not built; nothing here compiles it."""
    package = tmp_path / "src" / "doctored_kernels"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text(
        "from splatwizard_native import NativeModule\n"
        "MODULE = NativeModule(name='doctored', package='doctored_kernels', face='a.h', sources=('a.cpp',),"
        " without='it is slow')\n"
    )
    (package / "a.cpp").write_text("int a;\n")
    monkeypatch.syspath_prepend(str(package.parent))
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("SPLATWIZARD_NATIVE", raising=False)
    sys.modules.pop("doctored_kernels", None)
    import doctored_kernels

    return doctored_kernels.MODULE


def test_kernels_that_are_not_built_are_missing_and_stay_so(kernels, tmp_path):
    (found,) = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("missing", "sw build-kernels")
    assert "about" not in found.detail  # nothing was measured here so far
    assert "it is slow" in found.detail
    assert not (tmp_path / "cache").exists()


def test_damaged_kernels_are_broken(kernels):
    library = kernels._library(kernels.cache_folder, "native")
    library.parent.mkdir(parents=True)
    library.write_bytes(b"half a libr")
    (found,) = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("broken", "sw build-kernels --force")


def test_kernels_that_are_switched_off_say_so(kernels, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    (found,) = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("missing", "unset SPLATWIZARD_NATIVE")


def test_a_native_module_that_cannot_be_imported_is_broken():
    assert probe.check_kernels("no_such_module:MODULE")[0].state == "broken"


def manager(site: Path, name: str, source: str) -> PluginManager:
    """The core, the reference rasterizer and one plugin, whose module holds `source`."""
    (site / f"{name}.py").write_text("from splatwizard_core.plugins import hookimpl\n" + textwrap.dedent(source))
    modules = {"core": "splatwizard_core.builtin", "reference": "sw_reference.plugin", name: name}
    return PluginManager([EntryPoint(key, module, "splatwizard") for key, module in modules.items()])


def test_an_entry_whose_target_is_not_there_is_broken(site):
    plugins = manager(
        site, "doctored_entry",
        """
        @hookimpl
        def register_metrics(registry):
            registry.add("gone", "no_such_module:metric", summary="none", direction="higher")
        """,
    )  # fmt: skip
    summary, broken = probe.check_entries(plugins)
    assert summary.state == "ok"
    assert (broken.name, broken.state) == ("metric gone", "broken")
    assert "no_such_module" in broken.detail


def test_a_rasterizer_that_draws_black_is_broken_and_the_reference_is_not(site):
    plugins = manager(
        site, "doctored_raster",
        """
        @hookimpl
        def register_rasterizers(registry):
            registry.add("black", "doctored_raster:Black", summary="none", devices=["cpu"], features=["COLORS_ND"],
                         speed=3)

        def Black():
            from sw_reference.rasterizer import ReferenceRasterizer

            class BlackRasterizer(ReferenceRasterizer):
                def render(self, g, cam, opt):
                    found = super().render(g, cam, opt)
                    found.image = found.image * 0
                    return found

            return BlackRasterizer()
        """,
    )  # fmt: skip
    checks = {c.name: c for c in probe.check_rasterizers(plugins)}
    assert checks["reference"].state == "ok"
    assert checks["black"].state == "broken"
    assert "wrong picture" in checks["black"].detail


@pytest.mark.parametrize(
    ("answer", "state", "detail", "mend"),
    [
        ("return 'their is not installed (pip install \"sw-their[x]\")'", "missing", "their is not installed",
         'pip install "sw-their[x]"'),
        ("return 'it needs a GPU (a new one)'", "missing", "it needs a GPU (a new one)", None),
        ("raise OSError('libtheir.so')", "broken", "OSError: libtheir.so",
         "pip install --force-reinstall --no-deps doctored_absent"),
        ("return None", "ok", "drew a test picture on cpu (runs on cpu)", None),
    ],
)  # fmt: skip
def test_a_rasterizer_whose_probe_says_why_it_cannot_run_is_missing_not_broken(
    site, monkeypatch, answer, state, detail, mend
):
    monkeypatch.delitem(sys.modules, "doctored_absent", raising=False)
    plugins = manager(
        site, "doctored_absent",
        f"""
        @hookimpl
        def register_rasterizers(registry):
            registry.add("their", "sw_reference.rasterizer:ReferenceRasterizer", summary="none",
                         devices=["cpu"], features=["COLORS_ND"], available="doctored_absent:unavailable", speed=3)

        def unavailable():
            {answer}
        """,
    )  # fmt: skip
    found = next(c for c in probe.check_rasterizers(plugins) if c.name == "their")
    assert (found.state, found.detail, found.mend) == (state, detail, mend)


def test_a_rasterizer_of_surfels_draws_surfels(site):
    plugins = manager(
        site, "doctored_flat",
        """
        @hookimpl
        def register_rasterizers(registry):
            registry.add("flat", "doctored_flat:Flat", summary="none", devices=["cpu"], features=["SURFEL", "BACKWARD"],
                         needs=["SURFEL"], speed=3)

        def Flat():
            from sw_reference.rasterizer import ReferenceRasterizer

            class FlatRasterizer(ReferenceRasterizer):
                def render(self, g, cam, opt):
                    assert g.scales.shape[1] == 2
                    return super().render(g, cam, opt)

            return FlatRasterizer()
        """,
    )  # fmt: skip
    checks = {c.name: c for c in probe.check_rasterizers(plugins)}
    assert checks["reference"].state == "ok"
    assert checks["flat"].state == "ok", checks["flat"].detail


def test_scenes_are_counted_by_dataset(tmp_path, monkeypatch):
    plugins = load_plugins()
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    assert probe.check_scenes(plugins).state == "missing"
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "nowhere"))
    assert probe.check_scenes(plugins).state == "broken"
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path))
    assert probe.check_scenes(plugins).state == "missing"
    for scene in ("park/tree", "park/bench"):
        (tmp_path / scene / "sparse" / "0").mkdir(parents=True)
        for name in ("cameras.bin", "images.bin", "points3D.bin"):
            (tmp_path / scene / "sparse" / "0" / name).write_bytes(b"")
    (tmp_path / "park" / "notes").mkdir()
    found = probe.check_scenes(plugins)
    assert (found.state, found.facts["scenes"]) == ("ok", {"park": 2})


def test_with_the_core_alone_the_packages_that_the_main_job_needs_are_named(monkeypatch):
    monkeypatch.delenv("SW_PLUGINS", raising=False)
    core = PluginManager([EntryPoint("core", "splatwizard_core.builtin", "splatwizard")])
    found = probe.check_main_job(core)
    assert (found.name, found.state, found.needed) == ("sw run", "broken", True)
    assert found.detail == "not installed: a method, a scene, a rasterizer"
    assert found.mend == "pip install sw-3dgs sw-datasets sw-rasterizers"
    (rasterizers,) = probe.check_rasterizers(core)
    assert (rasterizers.state, rasterizers.mend) == ("missing", "pip install sw-rasterizers")
    monkeypatch.setenv("SPLATWIZARD_DATA", "/")
    assert probe.check_scenes(core).mend == "pip install sw-datasets"


def test_the_main_job_is_the_default_method_on_the_default_scene():
    plugins = load_plugins()
    found = probe.check_main_job(plugins)
    assert found.name == f"sw run --method {plugins.methods.default} --scene {plugins.datasets.default}"
    assert (found.state, found.needed) == ("ok", True)
