"""`sw doctor`, check by check, on machines where something is missing or broken."""

from __future__ import annotations

import errno
import os
import shutil
import sys
import tempfile
import textwrap
from collections import namedtuple
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from sw_doctor import child, compilers, diagnosis, packages, probe, registered, system
from sw_doctor.cures import cure_of
from sw_doctor.text import gigabytes, one_line

from splatwizard_core.plugins import Entry, PluginManager, load_plugins
from splatwizard_core.plugins.check import Check
from splatwizard_native import NativeModule, toolchain

needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in toolchain.COMPILERS), reason="no C++ compiler on this machine"
)


@pytest.fixture
def bare(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A PATH that leads to one folder, empty so far, and no variable that points to a compiler."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    for name in ("CXX", "CUDA_HOME", "CUDA_PATH"):
        monkeypatch.delenv(name, raising=False)
    return folder


def script(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(["#!/bin/sh", *lines]) + "\n")
    path.chmod(0o755)
    return path


def distribution(folder: Path, name: str, requires: tuple[str, ...] = (), extras: tuple[str, ...] = (), **modules: str):
    """An installed distribution as importlib.metadata sees it: modules and metadata in `folder`."""
    info = folder / f"{name.replace('-', '_')}-1.0.dist-info"
    info.mkdir(parents=True)
    lines = ["Metadata-Version: 2.1", f"Name: {name}", "Version: 1.0"]
    lines += [f"Provides-Extra: {extra}" for extra in extras] + [f"Requires-Dist: {text}" for text in requires]
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    (info / "RECORD").write_text("".join(f"{module}.py,,\n" for module in modules))
    for module, source in modules.items():
        (folder / f"{module}.py").write_text(textwrap.dedent(source))


# ---------------------------------------------------------------------------------------------- compilers


@needs_compiler
def test_a_compiler_that_works_is_ok_by_its_own_name(monkeypatch):
    monkeypatch.delenv("CXX", raising=False)
    found = compilers.check_cxx()
    assert (found.state, found.mend) == ("ok", None)
    assert any(name in found.detail.lower() for name in ("g++", "clang", "gcc", "c++"))


def test_without_a_compiler_the_line_installs_one(bare):
    script(bare / "apt-get", "exit 0")
    found = compilers.check_cxx()
    assert (found.state, found.mend) == ("missing", "sudo apt install g++")


@pytest.mark.skipif(sys.platform == "darwin", reason="macOS has its own line")
def test_where_there_is_no_package_manager_that_it_knows_the_line_is_a_sentence(bare):
    assert compilers.how_to_get_a_compiler().startswith("install g++ or clang++")
    script(bare / "dnf", "exit 0")
    assert compilers.how_to_get_a_compiler() == "sudo dnf install gcc-c++"


def test_a_compiler_that_does_not_compile_is_broken_in_its_own_words(bare):
    script(bare / "g++", "echo 'doctor.cpp:1:10: fatal error: span: No such file or directory' >&2", "exit 1")
    found = compilers.check_cxx()
    assert found.state == "broken"
    assert "fatal error: span: No such file or directory" in found.detail
    assert found.mend is not None


def test_a_compiler_that_writes_nothing_is_broken_though_it_says_0(bare):
    script(bare / "g++", "exit 0")
    assert compilers.check_cxx().state == "broken"


def test_a_compiler_without_openmp_is_told_how_to_get_it(bare):
    script(bare / "clang++", 'echo "ld: error: cannot find -lomp" >&2', "exit 1")
    assert "libomp" in (compilers.check_cxx().mend or "")


@pytest.mark.parametrize("value", ["no-such-compiler", "'unclosed"])
def test_cxx_that_names_nothing_is_broken_and_can_be_unset(bare, monkeypatch, value):
    monkeypatch.setenv("CXX", value)
    found = compilers.check_cxx()
    assert found.state == "broken"
    assert "CXX" in found.detail
    assert found.mend == "unset CXX, or set it to a compiler"


@pytest.fixture
def cuda_build(monkeypatch):
    monkeypatch.setattr(compilers.importlib.metadata, "version", lambda name: "2.13.0+cu130")


def nvcc(folder: Path, release: str, status: int = 0) -> None:
    script(
        folder / "nvcc",
        f'if [ "$1" = --version ]; then echo "Cuda compilation tools, release {release}, V{release}.1"; exit 0; fi',
        'for last; do :; done; : > "$last"',
        f"test {status} = 0 || echo 'error: unsupported GNU version!' >&2",
        f"exit {status}",
    )


def test_nvcc_is_judged_by_the_cuda_of_torch(bare, cuda_build):
    nvcc(bare, "13.0")
    found = compilers.check_nvcc()
    assert (found.state, found.facts["release"]) == ("ok", "13.0")
    assert compilers.judge_nvcc(found, "13.1").state == "ok"  # one major release
    other = compilers.judge_nvcc(found, "12.8")
    assert other.state == "broken"
    assert "13.0" in other.detail
    assert "12.8" in other.detail
    assert other.mend is not None
    assert "cuda-toolkit-12-8" in other.mend
    assert "of no use" in compilers.judge_nvcc(found, None).detail


def test_an_nvcc_that_compiles_nothing_is_broken(bare, cuda_build):
    nvcc(bare, "13.0", status=1)
    found = compilers.check_nvcc()
    assert found.state == "broken"
    assert "unsupported GNU version" in found.detail
    assert compilers.judge_nvcc(found, "13.0") == found


def test_an_nvcc_is_not_tried_beside_a_torch_for_cpus(bare, monkeypatch):
    monkeypatch.setattr(compilers.importlib.metadata, "version", lambda name: "2.13.0+cpu")
    nvcc(bare, "13.0", status=1)
    found = compilers.judge_nvcc(compilers.check_nvcc(), None)
    assert found.state == "ok"
    assert "not tried" in found.detail


@pytest.mark.skipif(Path("/usr/local/cuda/bin/nvcc").is_file(), reason="this machine has one at its usual place")
def test_a_missing_nvcc_matters_only_to_a_torch_with_cuda(bare):
    found = compilers.check_nvcc()
    assert found.state == "missing"
    assert compilers.judge_nvcc(found, None).mend is None
    assert "cuda-toolkit-13-0" in (compilers.judge_nvcc(found, "13.0").mend or "")


# ------------------------------------------------------------------------------------------------- system


def test_folders_that_can_be_written_are_left_as_they_were(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "not" / "yet"))
    monkeypatch.chdir(tmp_path)
    assert system.check_cache().state == "ok"
    assert system.check_working_folder().state == "ok"
    assert list(tmp_path.iterdir()) == []


def test_a_cache_folder_that_a_file_stands_in_the_way_of_is_broken(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "file" / "cache"))
    found = system.check_cache()
    assert (found.state, found.needed) == ("broken", False)
    assert str(tmp_path) in found.detail
    assert "SPLATWIZARD_CACHE" in (found.mend or "")


def test_a_working_folder_that_refuses_files_stops_the_main_job(tmp_path, monkeypatch):
    def refuse(**_: object):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refuse)
    found = system.check_working_folder()
    assert (found.state, found.needed) == ("broken", True)
    assert "Permission denied" in found.detail


def test_a_disk_that_takes_no_byte_more_is_told_apart(tmp_path, monkeypatch):
    def refuse(**_: object):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(tempfile, "NamedTemporaryFile", refuse)
    found = system.check_working_folder()
    assert found.state == "missing"
    assert "no space left" in found.detail
    assert "free some space" in (found.mend or "")


def test_a_nearly_full_disk_is_missing_space(tmp_path, monkeypatch):
    usage = namedtuple("usage", "total used free")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage(10**9, 10**9 - 10**6, 10**6))
    found = system.check_working_folder()
    assert found.state == "missing"
    assert "0.00 GB free" in found.detail


def test_the_limit_of_a_container_is_the_memory_there_is(monkeypatch):
    monkeypatch.setattr(system, "container_limit", lambda: 500_000_000)
    found = system.check_memory()
    assert (found.state, found.needed) == ("missing", True)
    assert found.facts["total_bytes"] == 500_000_000
    assert "limit of the container" in found.detail


def test_a_python_that_is_too_old_is_broken(monkeypatch):
    monkeypatch.setattr(system, "OLDEST_PYTHON", (99, 0))
    assert system.check_python().state == "broken"


# ----------------------------------------------------------------------------------------------- packages


@pytest.fixture
def site(tmp_path, monkeypatch) -> Path:
    """A folder whose distributions count as installed, here and in child processes."""
    folder = tmp_path / "site"
    folder.mkdir()
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, (str(folder), os.environ.get("PYTHONPATH")))))
    return folder


def test_requirements_and_extras_come_from_the_metadata(site):
    distribution(
        site, "sw-thing",
        requires=("lib-a>=1", "splatwizard-core>=0.1", "sw-other", "old; python_version < '3'",
                  "lib-b; extra == 'fast'", "lib-c>=2; extra == 'fast'", "not//valid"),
        extras=("fast",),
    )  # fmt: skip
    distribution(site, "splatwizard-core")
    needs = packages.collect_needs(["sw-thing", "not-installed"])
    assert list(needs.required) == ["lib-a"]
    assert {name: [r.name for r in found] for name, found in needs.extras.items()} == {
        "sw-thing[fast]": ["lib-b", "lib-c"]
    }
    assert needs.names() == ["lib-a", "lib-b", "lib-c"]


def test_what_lies_below_the_core_is_asked_too(site):
    distribution(site, "splatwizard-below", requires=("lib-z>=3",))
    distribution(site, "sw-thing", requires=("lib-a", "splatwizard-below>=0.1", "splatwizard-absent"))
    assert list(packages.collect_needs(["sw-thing"]).required) == ["lib-a", "lib-z"]


def test_packages_are_imported_and_one_that_crashes_takes_no_other_along(site):
    distribution(site, "good", good="print('noise on stdout')")
    distribution(site, "crash", crash="import os\nos.abort()\n")
    distribution(site, "wrong", wrong="import no_such_library\n")
    distribution(site, "leave", leave="raise SystemExit(3)\n")
    distribution(site, "after", after="")
    found = packages.try_imports(["good", "crash", "wrong", "leave", "absent", "after"])
    assert found["good"] is None
    assert found["after"] is None
    assert found["crash"] == "the process that imports it was killed by signal SIGABRT"
    assert "No module named 'no_such_library'" in (found["wrong"] or "")
    assert "SystemExit" in (found["leave"] or "")
    assert "absent" not in found


def test_each_package_that_does_not_work_has_its_line(site):
    distribution(
        site, "sw-thing",
        requires=("there>=1", "absent>=3", "old>=2", "bad", "lib-x; extra == 'gone'", "there; extra == 'here'",
                  "bad; extra == 'sick'"),
        extras=("gone", "here", "sick"),
    )  # fmt: skip
    for name in ("there", "old", "bad"):
        distribution(site, name)
    problems = {"there": None, "old": None, "bad": "does not import: OSError: libfoo.so"}
    checks = {c.name: c for c in packages.package_checks(packages.collect_needs(["sw-thing"]), problems)}
    assert (checks["absent"].state, checks["absent"].mend) == ("missing", "pip install 'absent>=3'")
    assert checks["absent"].needed
    assert checks["old"].state == "broken"
    assert "is 1.0; needed is >=2" in checks["old"].detail
    assert "libfoo.so" in checks["bad"].detail
    assert checks["required"].detail == "1 of 4 packages work"
    assert (checks["sw-thing[gone]"].state, checks["sw-thing[gone]"].mend) == (
        "missing", "pip install 'sw-thing[gone]'"
    )  # fmt: skip
    assert not checks["sw-thing[gone]"].needed
    assert checks["sw-thing[here]"].state == "ok"
    assert checks["sw-thing[sick]"].state == "broken"


@pytest.mark.parametrize(
    ("why", "mend"),
    [
        ("No module named 'jax'", "pip install jax"),
        ("No module named 'heavy_lib'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("No module named 'weighty'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("No module named 'heavy_lib.csrc'", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
        ("OSError: libheavy.so", "pip install --upgrade --force-reinstall --no-deps heavy-lib"),
    ],
)
def test_an_extra_gets_what_it_lacks_or_is_put_there_anew(site, why, mend):
    distribution(site, "heavy-lib", weighty="")
    distribution(site, "sw-thing", requires=("heavy-lib; extra == 'fast'",), extras=("fast",))
    needs = packages.collect_needs(["sw-thing"])
    checks = {c.name: c for c in packages.package_checks(needs, {"heavy-lib": f"does not import: {why}"})}
    assert (checks["sw-thing[fast]"].state, checks["sw-thing[fast]"].mend) == ("broken", mend)


def test_what_only_a_stranger_needs_decides_nothing_about_the_main_job(site):
    for name in ("old", "bad", "shared"):
        distribution(site, name)
    distribution(site, "sw-thing", requires=("shared>=1",))
    distribution(site, "stranger", requires=("absent", "old>=2", "bad", "shared<1"))
    needs = packages.collect_needs(["sw-thing"], ["stranger"])
    checks = {c.name: c for c in packages.package_checks(needs, {"bad": "does not import: OSError", "shared": None})}
    assert set(checks) == {"bad", "required"}  # what it has not is told in its plugin's line
    assert (checks["bad"].state, checks["bad"].needed) == ("broken", False)


@pytest.mark.parametrize(
    ("why", "foreign", "mend"),
    [
        ("needs numpy>=9, but 2.0 is installed: pip install 'numpy>=9'", True, "pip install 'numpy>=9'"),
        ("ModuleNotFoundError: No module named 'jax'", True, "pip install jax"),
        ("ModuleNotFoundError: No module named 'jax'", False, "pip install jax"),
        ("ModuleNotFoundError: No module named 'sw_thing'", False, "pip install --force-reinstall --no-deps sw-thing"),
        ("its entry point is called 'core', which is the name of ...", True, "pip uninstall sw-thing"),
        ("OSError: no disk", True,
         "pip install --upgrade sw-thing  (or, to be without it: pip uninstall sw-thing)"),
        ("OSError: no disk", False, "pip install --force-reinstall --no-deps sw-thing"),
    ],
)  # fmt: skip
def test_the_cure_of_a_plugin_is_what_helps_against_its_reason(site, why, foreign, mend):
    distribution(site, "sw-thing", sw_thing="")
    assert cure_of("sw-thing", why, foreign=foreign) == mend


def test_a_distribution_in_two_places_is_told_with_both(site, tmp_path, monkeypatch):
    distribution(site, "sw-thing")
    assert diagnosis.check_shadowed("sw-thing") is None
    distribution(tmp_path / "other", "sw-thing")
    monkeypatch.syspath_prepend(str(tmp_path / "other"))
    found = diagnosis.check_shadowed("sw-thing")
    assert found is not None
    assert f"1.0 in {tmp_path / 'other'} is used, 1.0 in {site} is shadowed" in found.detail
    assert not found.needed


def test_a_process_that_a_stranger_ends_after_the_main_job_decides_nothing():
    job = Check("main job", "sw run", "ok", "fine", needed=True)
    answer = child.Answer([job], ("entries of sw-thing", "was killed by signal SIGSEGV"))
    _, found = diagnosis.probed(answer)
    assert (found.group, found.state, found.needed) == ("plugins", "broken", False)
    assert "pip uninstall sw-thing" in (found.mend or "")


# ------------------------------------------------------------------------------------------ child processes


def serving(site: Path, *steps: str) -> str:
    body = "\n".join(steps)
    (site / "served.py").write_text(
        "import os, sys, time\n"
        "from splatwizard_core.plugins.check import Check\n"
        "from sw_doctor.child import serve\n"
        "def ok(name):\n    print('noise')\n    return [Check('g', name, 'ok', 'fine')]\n"
        f"def bad():\n    {body}\n"
        "serve([('one', lambda: ok('one')), ('two', bad), ('three', lambda: ok('three'))])\n"
    )
    return "served"


def test_noise_and_exceptions_do_not_stop_the_steps(site):
    answer = child.ask(serving(site, "raise RuntimeError('two\\nlines')"), timeout=60)
    assert answer.died_in is None
    assert [(c.name, c.state) for c in answer.checks] == [("one", "ok"), ("two", "broken"), ("three", "ok")]
    assert answer.checks[1].detail == "RuntimeError: two lines"


@pytest.mark.parametrize(
    ("step", "how"),
    [
        ("os.kill(os.getpid(), 11)", "was killed by signal SIGSEGV"),
        ("print('last words', file=sys.stderr); os._exit(3)", "ended with status 3: last words"),
        ("time.sleep(60)", "gave no answer within"),
        ("os._exit(0)", "ended before it had answered"),
    ],
)
def test_a_process_that_dies_or_hangs_is_a_finding(site, step, how):
    answer = child.ask(serving(site, step), timeout=10 if "sleep" in step else 60)
    assert answer.died_in is not None
    assert answer.died_in[0] == "two"
    assert how in answer.died_in[1]
    broken = diagnosis.probed(answer)[-1]
    assert (broken.state, broken.needed) == ("broken", True)


# -------------------------------------------------------------------------------------- registered checks


@pytest.fixture
def check_of(site):
    """(body of the check, **fields) -> entry of a check that the installed distribution sw-stranger registers."""

    def register(body: str, **fields: object) -> Entry:
        distribution(
            site, "sw-stranger",
            sw_stranger="from splatwizard_core.api import hookimpl\n"
            "@hookimpl\n"
            "def register_checks(registry):\n"
            f"    registry.add('strange', 'sw_strange:check', summary='', **{fields!r})\n",
            sw_strange="import os, sys, time\n"
            "from splatwizard_core.tooling import Check\n"
            f"def check():\n    {body}\n",
        )  # fmt: skip
        info = site / "sw_stranger-1.0.dist-info"
        (info / "entry_points.txt").write_text("[splatwizard]\nstranger = sw_stranger\n")
        return Entry("check", "strange", "sw_strange:check", "", fields, "sw-stranger", "1.0")

    return register


def test_a_registered_check_runs_in_a_process_of_its_own(check_of):
    entry = check_of("return [Check('radio', 'aerial', 'missing', str(os.getpid()), 'buy one', facts={'n': 1})]")
    (found,) = registered.run_registered(entry)
    assert (found.group, found.name, found.state, found.mend, found.facts) == (
        "radio", "aerial", "missing", "buy one", {"n": 1}
    )  # fmt: skip
    assert found.detail != str(os.getpid())


@pytest.mark.parametrize(
    ("body", "how"),
    [
        ("os.abort()", "was killed by signal SIGABRT"),
        ("time.sleep(60)", "gave no answer within 5 s"),
        ("os._exit(0)", "ended before it had answered"),
        ("os._exit(4)", "ended with status 4"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("raise OSError('no\\nradio')", "OSError: no radio"),
        ("return 'fine'", "no list of Check"),
        ("return [Check('g', 'n', 'fine', '')]", "the state of 'n' is 'fine'"),
        ("return [Check('g', 'n', 'ok', '', facts={'n': float('nan')})]", "Out of range float"),
        ("import no_such_library", "No module named 'no_such_library'"),
    ],
)
def test_a_registered_check_that_fails_is_one_line_with_its_distribution(check_of, body, how):
    entry = check_of(body, group="radio")
    (found,) = registered.run_registered(entry, seconds=5 if "sleep" in body else 60)
    assert (found.group, found.name, found.state, found.needed) == ("radio", "strange", "broken", False)
    assert how in found.detail
    assert "sw-stranger" in found.detail
    assert "\n" not in found.detail
    assert ("pip install no_such_library" if "no_such" in body else "sw-stranger") in (found.mend or "")


def test_what_a_registered_check_prints_stands_nowhere(check_of, capfd):
    entry = check_of("print('noise'); os.write(1, b'more'); return [Check('g', 'n', 'ok', 'fine')]")
    (found,) = registered.run_registered(entry)
    assert (found.state, found.detail) == ("ok", "fine")
    assert capfd.readouterr() == ("", "")


def test_a_registered_check_decides_nothing_about_the_main_job(check_of):
    entry = check_of("return [Check('main job', 'sw run', 'broken', 'a\\nb' + 'x' * 999, 'c\\nd', True)]")
    (found,) = registered.run_registered(entry)
    assert (found.group, found.needed, found.mend) == ("checks", False, "c d")
    assert "\n" not in found.detail
    assert len(found.detail) < 400


def test_a_registered_check_is_left_out_where_what_it_needs_does_not_work():
    def needs_of(**fields: object) -> set[str]:
        return registered.needs_of(Entry("check", "c", "module:attribute", "", fields))

    assert needs_of(needs="torch") == {"torch"}
    assert needs_of(needs=["torch", "C++"]) == {"torch", "C++"}
    assert needs_of() == needs_of(needs=3) == set()


# ------------------------------------------------------------------------------------- what needs torch


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
        "MODULE = NativeModule(name='doctored', package='doctored_kernels', sources=('a.cpp',), seconds=7,"
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
    found = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("missing", "sw build-kernels")
    assert "about 7 s" in found.detail
    assert "it is slow" in found.detail
    assert not (tmp_path / "cache").exists()


def test_damaged_kernels_are_broken(kernels):
    library = kernels._library(kernels.cache_folder, "native")
    library.parent.mkdir(parents=True)
    library.write_bytes(b"half a libr")
    found = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("broken", "sw build-kernels --force")


def test_kernels_that_are_switched_off_say_so(kernels, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    found = probe.check_kernels("doctored_kernels:MODULE")
    assert (found.state, found.mend) == ("missing", "unset SPLATWIZARD_NATIVE")


def test_a_native_module_that_cannot_be_imported_is_broken():
    assert probe.check_kernels("no_such_module:MODULE").state == "broken"


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


# ------------------------------------------------------------------------------------------ the whole page


def test_what_waits_for_a_compiler_is_mended_by_the_line_of_the_compiler():
    job = Check("main job", "sw run", "ok", "", None, True, {"device": "cpu", "compiled_first": ["standard"]})
    unbuilt = Check("kernels", "k", "missing", "not built", "sw build-kernels")
    obstacle = Check("compilers", "C++", "missing", "none", "sudo apt install g++")
    assert diagnosis._without_builds(unbuilt, obstacle).mend == "sudo apt install g++"
    slow = diagnosis._without_builds(job, obstacle)
    assert slow.mend == "sudo apt install g++"
    assert "slowly" in slow.detail
    assert slow.state == "ok"


def test_only_needed_checks_decide(monkeypatch):
    fine, optional = Check("g", "a", "ok", "", needed=True), Check("g", "b", "broken", "")
    assert diagnosis.Diagnosis([fine, optional], 1.0).ok
    assert not diagnosis.Diagnosis([fine, Check("g", "c", "missing", "", needed=True)], 1.0).ok


def test_strangers_text_becomes_one_line_of_bounded_length():
    assert one_line("a\n\n  b") == "a b"
    assert len(one_line("x" * 9999)) < 400
    assert gigabytes(1.5e9) == "1.50 GB"
    assert gigabytes(25.3e9) == "25 GB"
