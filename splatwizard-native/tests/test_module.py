"""The native loader, on C++ files of a few lines that need no torch header and compile in a moment."""

import ctypes
import hashlib
import itertools
import json
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from splatwizard_native import NativeBuildError, NativeModule, build_all, cache_root, cuda_toolkit, toolchain
from splatwizard_native import library as library_module
from splatwizard_native.lock import build_lock

needs_compiler = pytest.mark.skipif(
    not any(shutil.which(name) for name in toolchain.COMPILERS), reason="no C++ compiler on this machine"
)
packages = itertools.count()


class Package:
    """A package on disk with native sources, and a compiler that counts how often it is called."""

    def __init__(self, folder: Path, calls: Path) -> None:
        self.folder, self.calls = folder, calls
        self.write("__init__.py", "")
        self.write("value.h", "#define VALUE 41\n")
        self.write("answer.cpp", '#include "value.h"\nextern "C" int answer() { return VALUE + 1; }\n')

    def write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text)

    def module(self, **changes) -> NativeModule:
        """A new object each time, as a new process would have."""
        fields = {"sources": ("answer.cpp",), "headers": ("*.h",), "without": "answers are guessed"}
        return NativeModule(name="answer", package=self.folder.name, **{**fields, **changes})

    @property
    def compilations(self) -> int:
        return self.calls.read_text().count(" -c ") if self.calls.exists() else 0


def digest_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def call(library: Path | str | None, function: str = "answer") -> int:
    # A copy: the dynamic linker would hand out the library that is already open under this path.
    assert library is not None
    copy = Path(library).with_name(f"copy-{next(packages)}.so")
    shutil.copy(library, copy)
    return getattr(ctypes.CDLL(str(copy)), function)()


@pytest.fixture
def package(tmp_path, monkeypatch) -> Package:
    folder = tmp_path / "src" / f"tiny_native_{next(packages)}"
    folder.mkdir(parents=True)
    monkeypatch.syspath_prepend(str(folder.parent))
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "cache"))
    for name in ("SPLATWIZARD_NATIVE", "SPLATWIZARD_BUILD_TIMEOUT", "CXX", "MAX_JOBS"):
        monkeypatch.delenv(name, raising=False)
    calls = tmp_path / "calls"
    real = next((found for name in toolchain.COMPILERS if (found := shutil.which(name))), None)
    if real is not None:
        wrapper = tmp_path / "counting-compiler"
        wrapper.write_text(f'#!/bin/sh\necho "$@" >> {calls}\nexec {real} "$@"\n')
        wrapper.chmod(0o755)
        monkeypatch.setenv("CXX", str(wrapper))
    return Package(folder, calls)


@needs_compiler
def test_the_first_load_compiles_with_a_line_of_progress_and_the_second_finds_the_cache(package):
    said: list[str] = []
    first = package.module(seconds=40)
    assert first.state()["state"] == "not built"
    first.load(say=said.append)
    assert said[0] == "compiling kernels 'answer' (once, about 40 s) ..."
    assert package.compilations == 1
    second = package.module()
    second.load(say=said.append)
    assert package.compilations == 1
    assert len(said) == 2
    assert second.state()["state"] == "cached"
    assert call(second.state()["path"]) == 42


@needs_compiler
@pytest.mark.parametrize("name", ["answer.cpp", "value.h"])
def test_a_changed_source_or_header_recompiles(package, name):
    package.module().build()
    text = (package.folder / name).read_text()
    package.write(name, text.replace("41", "50").replace("VALUE + 1", "VALUE + 10"))
    assert call(package.module().build()) == 51
    assert package.compilations == 2


def test_the_cache_key_names_torch_flags_and_cpu(package, monkeypatch):
    import torch

    module = package.module()
    keys = {module.key("native"), module.key("portable"), package.module(cflags=("-DX",)).key("native")}
    with monkeypatch.context() as patch:
        patch.setattr(torch, "__version__", "99.0")
        keys.add(module.key("native"))
    with monkeypatch.context() as patch:
        patch.setattr(toolchain, "cpu_identity", lambda: "another CPU")
        keys.add(module.key("native"))
        assert module.key("portable") in keys
    assert len(keys) == 5
    assert module.key("native") in keys


@needs_compiler
def test_a_header_that_is_not_declared_is_an_error_that_names_it(package):
    with pytest.raises(NativeBuildError, match=r"answer\.cpp includes value\.h.*add it to headers"):
        package.module(headers=()).build()


@needs_compiler
def test_a_compile_error_shows_the_compilers_line_the_log_and_how_to_go_on(package):
    package.write("answer.cpp", 'extern "C" int answer() { return nonsense; }\n')
    module = package.module()
    with pytest.raises(NativeBuildError) as caught:
        module.load()
    text = str(caught.value)
    assert "answer.cpp:1:34: error:" in text
    assert "nonsense" in text
    assert "without them: answers are guessed" in text
    log = Path(text.partition("full log: ")[2].splitlines()[0])
    assert "-std=c++20" in log.read_text()
    assert "nonsense" in log.read_text()
    with pytest.raises(NativeBuildError):
        module.load()
    assert package.compilations == 1


@needs_compiler
def test_a_library_that_was_compiled_but_does_not_load_says_why(package):
    package.write("answer.cpp", 'int missing();\nextern "C" int answer() { return missing(); }\n')
    with pytest.raises(NativeBuildError, match=r"does not load: .*undefined symbol.*missing"):
        package.module(headers=()).load()


@needs_compiler
def test_a_fallback_warns_once(package, caplog):
    package.write("answer.cpp", "nonsense\n")
    module = package.module()
    assert not module.try_load()
    assert not module.try_load()
    assert [r.levelname for r in caplog.records if "answer" in r.message] == ["WARNING"]
    assert module.available() is not None


def test_a_missing_compiler_is_named_with_the_package_that_brings_it(package, monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    module = package.module()
    assert "apt install g++" in str(module.available())
    with pytest.raises(NativeBuildError, match=r"no C\+\+ compiler was found(.|\n)*answers are guessed"):
        module.load()


def test_a_wrong_cxx_is_named(package, monkeypatch):
    monkeypatch.setenv("CXX", "no-such-compiler -x")
    assert "no-such-compiler" in str(package.module().available())


def test_a_cxx_that_is_no_command_is_a_reason_like_any_other(package, monkeypatch):
    monkeypatch.setenv("CXX", "g++ '-O2")
    assert "which is no command (No closing quotation)" in package.module().available()


@needs_compiler
def test_a_cached_build_needs_no_compiler(package, monkeypatch, tmp_path):
    package.module().build()
    monkeypatch.delenv("CXX")
    monkeypatch.setenv("PATH", str(tmp_path / "empty"))
    module = package.module()
    assert module.available() is None
    module.load()
    assert module.load_built()


@needs_compiler
@pytest.mark.parametrize("damage", ["truncated", "flipped", "no facts", "replaced"])
def test_a_damaged_library_is_rebuilt(package, damage):
    library = package.module().build()
    content = library.read_bytes()
    facts = library.with_suffix(".json")
    if damage == "truncated":
        library.write_bytes(content[: len(content) // 2])
    elif damage == "flipped":
        library.write_bytes(content[:999] + bytes([content[999] ^ 255]) + content[1000:])
    elif damage == "no facts":
        facts.unlink()
    else:  # the digest fits, and still it is no library
        library.write_bytes(b"not a library")
        facts.write_text(json.dumps({"sha256": digest_of(library)}))
    module = package.module()
    module.load()
    assert package.compilations == 2
    assert call(module.state()["path"]) == 42


@needs_compiler
def test_available_and_state_compile_nothing(package):
    module = package.module()
    assert module.available() is None
    assert module.state() == {"state": "not built", "path": None, "target": "cpu"}
    assert package.compilations == 0


def test_native_code_can_be_switched_off(package, monkeypatch, caplog):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    module = package.module()
    assert "SPLATWIZARD_NATIVE" in str(module.available())
    assert not module.try_load()
    assert not caplog.records  # who switched it off needs no warning
    assert package.compilations == 0


@needs_compiler
def test_a_cache_that_cannot_be_written_is_named(package, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(NativeBuildError, match=r"cannot write .*below.*SPLATWIZARD_CACHE"):
        package.module().load()


def test_a_missing_source_is_named(package):
    with pytest.raises(NativeBuildError, match=r"gone\.cpp"):
        package.module(sources=("gone.cpp",)).load()


HOLD = """
import sys, time
from pathlib import Path
from splatwizard_native.lock import build_lock
with build_lock(Path(sys.argv[1]), timeout=5, say=print):
    print("held", flush=True)
    sys.stdin.read()
"""


def hold_lock(path: Path) -> subprocess.Popen:
    path.parent.mkdir(parents=True, exist_ok=True)
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == "held\n"
    return holder


@needs_compiler
def test_a_lock_that_is_never_released_times_out_and_names_its_process(package, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_BUILD_TIMEOUT", "0.3")
    module = package.module()
    said: list[str] = []
    holder = hold_lock(module._library(module.cache_folder, "native").with_suffix(".lock"))
    try:
        with pytest.raises(NativeBuildError, match=rf"process {holder.pid} has held .*SPLATWIZARD_BUILD_TIMEOUT"):
            module.load(say=said.append)
    finally:
        holder.communicate()
    assert said == [f"waiting for process {holder.pid} that is compiling the same kernels ..."]
    assert package.compilations == 0


@needs_compiler
def test_a_lock_of_a_killed_process_blocks_nobody(package):
    module = package.module()
    lock = module._library(module.cache_folder, "native").with_suffix(".lock")
    holder = hold_lock(lock)
    holder.kill()
    holder.communicate()
    assert lock.read_text() == str(holder.pid)
    said: list[str] = []
    module.load(say=said.append)
    assert not [line for line in said if "waiting" in line]


@needs_compiler
def test_concurrent_builders_compile_once(package):
    results: list[Path] = []
    threads = [threading.Thread(target=lambda: results.append(package.module().build())) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(results) == 4
    assert len(set(results)) == 1
    assert package.compilations == 1


def test_a_lock_is_released_when_its_block_raises(tmp_path):
    with pytest.raises(RuntimeError), build_lock(tmp_path / "lock", timeout=1, say=print):
        raise RuntimeError
    with build_lock(tmp_path / "lock", timeout=0, say=print):
        assert (tmp_path / "lock").read_text() == str(os.getpid())


LEVEL_H = """
#include <splatwizard/dispatch.h>
#define DECLARE(arch) namespace arch { int level(); }
SW_FOR_EACH_ARCH(DECLARE)
"""
LEVEL_CPP = """
#include "level.h"
namespace SW_ARCH {
int level() {
#if defined(__AVX512VL__)
  return 4;
#elif defined(__AVX2__)
  return 3;
#else
  return 2;
#endif
}
}
"""


@needs_compiler
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="the levels are those of x86-64")
def test_a_portable_build_runs_the_best_kernel_that_this_cpu_has(package):
    package.write("level.h", LEVEL_H)
    package.write("level.cpp", LEVEL_CPP)
    package.write("answer.cpp", '#include "level.h"\nextern "C" int answer() { return SW_SELECT(level)(); }\n')
    module = package.module(kernels=("level.cpp",))
    library = module.build(march="portable", folder=module.prebuilt_folder)
    assert package.compilations == 4
    with open("/proc/cpuinfo") as handle:
        flags = next(line for line in handle if line.startswith("flags")).split()
    expected = 4 if {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"} <= set(flags) else 2
    if expected == 2 and {"avx2", "fma", "bmi1", "bmi2"} <= set(flags):
        expected = 3
    assert call(library) == expected
    fresh = package.module(kernels=("level.cpp",))
    fresh.load()
    assert fresh.state()["state"] == "prebuilt"
    assert package.compilations == 4


@needs_compiler
def test_kernels_see_their_namespace_and_no_torch_header(package):
    package.write("level.h", LEVEL_H)
    package.write("level.cpp", "#if __has_include(<torch/library.h>)\n#error torch\n#endif\n" + LEVEL_CPP)
    package.write("answer.cpp", '#include "level.h"\nextern "C" int answer() { return SW_SELECT(level)(); }\n')
    assert call(package.module(kernels=("level.cpp",)).build()) in (2, 3, 4)


CUDA_KERNEL = """
#include "value.h"
#ifndef SW_WITH_CUDA
#error "not told about CUDA"
#endif
__global__ void fill(int* out) { out[threadIdx.x] = VALUE; }
"""


def test_cuda_sources_are_left_out_without_cuda_in_torch(package):
    import torch

    if torch.version.cuda is not None:
        pytest.skip("this torch has CUDA")
    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",))
    assert module.key("native") == package.module().key("native")
    assert module.state()["target"] == "cpu"


@needs_compiler
@pytest.mark.skipif(cuda_toolkit.find_nvcc() is None, reason="no CUDA compiler on this machine")
def test_cuda_sources_are_compiled_for_each_architecture(package, monkeypatch, tmp_path):
    import torch

    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",))
    before = module.key("native")
    monkeypatch.setattr(torch.version, "cuda", torch.version.cuda or "13.0")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0 9.0")
    assert module.state()["target"] == "cuda"
    assert module.key("native") != before
    (job,) = [job for job in module._jobs("native", tmp_path) if job.cuda]
    assert {"-gencode=arch=compute_80,code=sm_80", "-gencode=arch=compute_90,code=sm_90"} <= set(job.flags)
    toolchain.Toolchain().compile([job], tmp_path / "log")
    assert job.output.stat().st_size > 0
    assert (package.folder / "value.h") in toolchain.read_dependencies(Path(f"{job.output}.d"))


@pytest.mark.parametrize(
    ("torchs", "nvcc", "message"),
    [
        (None, (13, 0), "this torch is built without CUDA"),
        ("13.0", None, "no CUDA compiler was found .* install the CUDA 13 toolkit"),
        ("12.8", (13, 0), r"torch is built for CUDA 12.8, .*nvcc is of CUDA 13.0: install a toolkit of CUDA 12"),
        ("13.0", (13, 2), None),
    ],
)
def test_a_cuda_toolkit_that_does_not_fit_torch_is_named(package, monkeypatch, torchs, nvcc, message):
    import torch

    module = package.module(cuda_sources=("fill.cu",))
    monkeypatch.setattr(torch.version, "cuda", torchs)
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: None if nvcc is None else "/opt/cuda/bin/nvcc")
    monkeypatch.setattr(cuda_toolkit, "nvcc_version", lambda _: nvcc)
    package.write("fill.cu", CUDA_KERNEL)
    reason = module.available(cuda=True)
    if message is None:
        assert reason is None
    else:
        assert reason is not None
        assert re.search(message, reason)
    assert module.state()["target"] == ("cpu" if message else "cuda")


@needs_compiler
def test_a_packaged_cuda_library_is_used_without_a_cuda_compiler_if_it_fits_the_gpu(package, monkeypatch):
    import torch

    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",))
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: None)
    library = module._library(module.prebuilt_folder, "portable", True)
    library.parent.mkdir()
    library.write_bytes(b"not looked into")
    facts = {"sha256": digest_of(library), "architectures": ["8.0", "9.0", "12.0a"]}
    library.with_suffix(".json").write_text(json.dumps(facts))
    for gpu, suits in (
        ((9, 0), True),
        ((8, 6), True),
        ((7, 5), False),
        ((10, 0), False),
        ((12, 0), True),
        ((12, 1), False),
    ):
        monkeypatch.setattr(cuda_toolkit, "gpus", lambda gpu=gpu: [gpu])
        assert (library in module._existing()) == suits
        assert (module.available(cuda=True) is None) == suits


def test_an_unknown_march_is_refused(package):
    with pytest.raises(ValueError, match="march is 'fast'"):
        package.module().build(march="fast")


@needs_compiler
def test_build_all_builds_every_target_and_reports_what_fails(package):
    package.write(
        "native.py",
        "from splatwizard_native import NativeModule\n"
        f"GOOD = NativeModule('good', '{package.folder.name}', ('answer.cpp',), ('*.h',))\n"
        f"BAD = NativeModule('bad', '{package.folder.name}', ('bad.cpp',))\n"
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
    monkeypatch.setattr(cuda_toolkit, "mismatch", lambda: "there is none")
    monkeypatch.setenv("CXX", sys.executable)  # there, and not called
    package.write(
        "native.py",
        "from splatwizard_native import NativeModule\n"
        f"GPU = NativeModule('gpu', '{package.folder.name}', ('answer.cpp',), cuda_sources=('fill.cu',))\n",
    )
    (row,) = build_all([f"{package.folder.name}.native:GPU"], cuda=True)
    assert (row.state, row.error) == ("failed", "the CUDA kernels of 'gpu' cannot be built: there is none")
    assert package.compilations == 0


def test_importing_imports_no_torch():
    program = "import sys, splatwizard_native; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=60)


def test_the_cache_follows_the_platforms_convention(monkeypatch, tmp_path):
    monkeypatch.delenv("SPLATWIZARD_CACHE", raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_root() == tmp_path / "splatwizard"
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "mine"))
    assert cache_root() == tmp_path / "mine"


@needs_compiler
def test_load_built_takes_what_is_there_and_compiles_nothing(package):
    assert package.module().load_built() is False
    assert package.compilations == 0
    package.module().build()
    module = package.module()
    assert module.load_built() is True
    assert module.state()["state"] == "cached"
    assert package.compilations == 1


@needs_compiler
def test_a_damaged_build_is_neither_loaded_nor_called_built(package):
    library = package.module().build()
    library.write_bytes(library.read_bytes()[:-1])
    module = package.module()
    assert module.load_built() is False
    assert module.state()["state"] == "damaged"
    assert package.compilations == 1


@needs_compiler
def test_load_built_says_why_a_build_does_not_load(package):
    library = package.module().build()
    library.write_bytes(b"no library")
    facts = json.loads(library.with_suffix(".json").read_text())
    library.with_suffix(".json").write_text(json.dumps({**facts, "sha256": digest_of(library)}))
    with pytest.raises(NativeBuildError, match=f"{library.name} does not load: "):
        package.module().load_built()


def test_a_module_loads_once_native_code_is_switched_on_again(package, monkeypatch):
    module = package.module()
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    with pytest.raises(NativeBuildError, match="SPLATWIZARD_NATIVE=0"):
        module.load()
    assert not module.has_cuda()
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "1")
    assert module.available() is None
    module.load()


def test_load_built_says_that_native_code_is_switched_off(package, monkeypatch):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    with pytest.raises(NativeBuildError, match="SPLATWIZARD_NATIVE=0"):
        package.module().load_built()


def fake_cuda(package, monkeypatch) -> NativeModule:
    """A module with a kernel of every sort, on a machine of which everything that counts is known."""
    import torch

    for name in ("fill.cu", "binding.cpp", "level.cpp"):
        package.write(name, "")
    monkeypatch.setenv("CXX", "g++ -v1")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0 9.0a")
    monkeypatch.setattr(torch, "__version__", "2.99.0")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch._C, "_GLIBCXX_USE_CXX11_ABI", True)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(toolchain, "cpu_identity", lambda: "a CPU")
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: "/opt/cuda/bin/nvcc")
    monkeypatch.setattr(cuda_toolkit, "nvcc_version", lambda _: (13, 2))
    return package.module(
        sources=("answer.cpp", "binding.cpp"), kernels=("level.cpp",), cuda_sources=("fill.cu",), cflags=("-fx", "-fy")
    )


@pytest.mark.parametrize("march", ["native", "portable"])
def test_the_command_lines_of_a_build(package, monkeypatch, tmp_path, march):
    import torch

    module = fake_cuda(package, monkeypatch)
    run: list[list[str]] = []

    def compiler(command, **_):
        if command[1:] != ["-v1", "--version"]:
            run.append(list(command))
        if "-c" in command:
            Path(command[-1]).with_name(f"{Path(command[-1]).name}.d").write_text(f"x: {package.folder}/value.h\n")
        else:
            Path(command[command.index("-o") + 1] if "-o" in command else tmp_path / "asked").write_text("library")
        return subprocess.CompletedProcess(command, 0, b"" if command[-1] != "--version" else "g++ 99\n", "")

    monkeypatch.setattr(toolchain.subprocess, "run", compiler)
    library = module.build(march=march, tools=toolchain.Toolchain(1))
    link = run.pop()
    scratch = Path(link[link.index("-o") + 1]).parent
    lib, include = Path(torch.__file__).parent / "lib", Path(torch.__file__).parent / "include"
    home = cuda_toolkit.root_of("/opt/cuda/bin/nvcc")
    common = "-std=c++20 -O3 -fPIC -D_GLIBCXX_USE_CXX11_ABI=1 -fopenmp -DSW_WITH_CUDA"
    if march == "native":
        levels = {"arch_native": "-march=native -mprefer-vector-width=512"}
    else:
        common += " -DSW_PORTABLE_X86"
        levels = {
            "arch_v2": "-march=x86-64-v2",
            "arch_v3": "-march=x86-64-v3",
            "arch_v4": "-march=x86-64-v4 -mprefer-vector-width=512",
        }
    shared = f"-isystem {toolchain.SHARED_INCLUDE}"
    headers = f"{shared} -isystem {include} -isystem {include}/torch/csrc/api/include -isystem {home}/include"

    def compiled(compiler: str, source: str, name: str) -> str:
        return f"{compiler} -MD -MF {scratch}/{name}.o.d -c {package.folder}/{source} -o {scratch}/{name}.o"

    binding = f"g++ -v1 {common} {next(iter(levels.values()))} {headers} -fx -fy"
    expected = [compiled(binding, "answer.cpp", "0"), compiled(binding, "binding.cpp", "1")]
    for arch, flags in levels.items():
        kernel = f"g++ -v1 {common} {shared} -fx -fy {flags} -DSW_ARCH={arch}"
        expected.append(compiled(kernel, "level.cpp", f"{arch}-0"))
    nvcc = "/opt/cuda/bin/nvcc -std=c++20 -O3 -Xcompiler -fPIC -DSW_WITH_CUDA -gencode=arch=compute_80,code=sm_80"
    expected.append(compiled(f"{nvcc} -gencode=arch=compute_90a,code=sm_90a {shared}", "fill.cu", "cuda-0"))
    assert sorted(map(shlex.join, run)) == sorted(expected)
    objects = " ".join(f"{scratch}/{name}.o" for name in ("0", "1", *(f"{arch}-0" for arch in levels), "cuda-0"))
    runtime = "".join(f"{path} " for path in toolchain.runtime_libraries())
    assert shlex.join(link) == (
        f"g++ -v1 -shared {objects} {runtime}-o {scratch}/{library.name} -fopenmp -L {lib} -ltorch -ltorch_cpu -lc10 "
        f"-ltorch_cuda -lc10_cuda -L {home}/lib64 -lcudart"
    )
    facts = json.loads(library.with_suffix(".json").read_text())
    assert (facts["march"], facts["architectures"], facts["compiler"]) == (march, ["8.0", "9.0a"], "g++ 99")


def test_the_cache_key_is_that_of_every_earlier_release(package, monkeypatch):
    """Else a prebuilt library that ships in a wheel is not found, and every user compiles again."""
    module = fake_cuda(package, monkeypatch)
    common = ("-std=c++20", "-O3", "-fPIC", "-D_GLIBCXX_USE_CXX11_ABI=1", "-fopenmp")
    levels = {"arch_native": ("-march=native", "-mprefer-vector-width=512")}
    facts: list[object] = ["answer", "2.99.0", common, platform.system(), "x86_64", "native", levels, "a CPU"]
    facts += [("-fx", "-fy"), ()]
    for any_gpu, cuda in ((False, True), (True, True), (False, False)):
        files = [package.folder / name for name in ("answer.cpp", "binding.cpp", "level.cpp")]
        files += [package.folder / "fill.cu"] if cuda else []
        files += [package.folder / "value.h", *sorted(toolchain.SHARED_INCLUDE.rglob("*.h"))]
        more = ["13.0", () if any_gpu else ["8.0", "9.0a"], ()] if cuda else []
        digest = hashlib.sha256(repr(facts + more).encode())
        for path in files:
            content = path.read_bytes()
            digest.update(f"\0{path.name}\0{len(content)}\0".encode() + content)
        assert module.key("native", cuda, any_gpu=any_gpu) == digest.hexdigest()[:16]
    for folder, any_gpu in ((module.prebuilt_folder, True), (module.cache_folder, False)):
        key = module.key("native", any_gpu=any_gpu)
        assert module._library(folder, "native", True) == folder / f"answer-{key}.so"


def test_a_lock_that_is_a_link_is_not_followed(tmp_path):
    """Another user of the folder laid it: what it points to must not be emptied, nor get a number written into it."""
    (tmp_path / "precious").write_text("kept")
    (tmp_path / "lock").symlink_to(tmp_path / "precious")
    with (
        pytest.raises(NativeBuildError, match="is a link or no file"),
        build_lock(tmp_path / "lock", timeout=1, say=print),
    ):
        raise AssertionError
    assert (tmp_path / "precious").read_text() == "kept"


def test_a_library_of_another_user_is_compiled_anew(package, monkeypatch, caplog):
    library = package.module().build()
    assert package.compilations == 1
    assert package.module().build() == library
    assert package.compilations == 1
    real = os.stat

    def stat(path, **kwargs):
        found = real(path, **kwargs)
        return SimpleNamespace(st_uid=12345) if path == library and package.compilations == 1 else found

    monkeypatch.setattr(library_module.os, "stat", stat)
    package.module().build()
    assert package.compilations == 2
    assert "belongs to another user (12345): it is not loaded, but compiled anew" in caplog.text


def test_what_a_killed_build_left_is_removed_by_the_next(package):
    module = package.module()
    left = module.cache_folder / f".{module.build().stem}-0123abcd"
    for library in module.cache_folder.glob("*.so"):
        library.unlink()
    left.mkdir()
    (left / "answer.o").write_bytes(b"half")
    module.build()
    assert not left.exists()
