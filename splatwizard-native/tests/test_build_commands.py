"""The command lines of a build, the levels of a portable one, and the key under which every release finds it."""

import hashlib
import json
import platform
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from native_package import answer_of, call, needs_compiler

from splatwizard_native import NativeModule, cuda_toolkit, toolchain

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
    package.write("answer.cpp", f'#include "level.h"\n{answer_of("SW_SELECT(level)()")}')
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
def test_no_file_sees_a_torch_header(package):
    no_torch = "#if __has_include(<torch/library.h>)\n#error torch\n#endif\n"
    package.write("level.h", LEVEL_H)
    package.write("level.cpp", no_torch + LEVEL_CPP)
    package.write("answer.cpp", f'{no_torch}#include "level.h"\n{answer_of("SW_SELECT(level)()")}')
    assert call(package.module(kernels=("level.cpp",)).build()) in (2, 3, 4)


def fake_cuda(package, monkeypatch) -> NativeModule:
    """A module with a kernel of every sort, on a machine of which everything that counts is known."""
    import torch

    for name in ("fill.cu", "second.cpp", "level.cpp"):
        package.write(name, "")
    monkeypatch.setenv("CXX", "g++ -v1")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0 9.0a")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(platform, "machine", lambda: "x86_64")
    monkeypatch.setattr(toolchain, "cpu_identity", lambda: "a CPU")
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: "/opt/cuda/bin/nvcc")
    monkeypatch.setattr(cuda_toolkit, "nvcc_version", lambda _: (13, 2))
    return package.module(
        sources=("answer.cpp", "second.cpp"), kernels=("level.cpp",), cuda_sources=("fill.cu",), cflags=("-fx", "-fy")
    )


@pytest.mark.parametrize("march", ["native", "portable"])
def test_the_command_lines_of_a_build(package, monkeypatch, tmp_path, march):
    module = fake_cuda(package, monkeypatch)
    run: list[list[str]] = []

    def compiler(command, **_):
        if command[1:] != ["-v1", "--version"]:
            run.append(list(command))
        if "-c" in command:
            Path(command[-1]).with_name(f"{Path(command[-1]).name}.d").write_text(f"x: {package.folder}/value.h\n")
        else:
            Path(command[command.index("-o") + 1] if "-o" in command else tmp_path / "asked").write_text("library")
        return subprocess.CompletedProcess(command, 0, "g++ 99\n", "")

    monkeypatch.setattr(toolchain.subprocess, "run", compiler)
    monkeypatch.setattr(toolchain.Compilers, "run", lambda _, command, log: compiler(command))
    library = module.build(march=march, tools=toolchain.Toolchain(1))
    link = run.pop()
    scratch = Path(link[link.index("-o") + 1]).parent
    home = cuda_toolkit.root_of("/opt/cuda/bin/nvcc")
    common = "-std=c++20 -O3 -fPIC -fvisibility=hidden -fopenmp-simd -pthread"
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

    def compiled(compiler: str, source: str, name: str, folder: Path = package.folder) -> str:
        return f"{compiler} -MD -MF {scratch}/{name}.o.d -c {folder}/{source} -o {scratch}/{name}.o"

    behind = f"g++ -v1 {common} {next(iter(levels.values()))} {shared} -isystem {home}/include -fx -fy"
    expected = [compiled(behind, "answer.cpp", "0"), compiled(behind, "second.cpp", "1")]
    expected.append(compiled(behind, "answer.cpp", "2", scratch))  # what the library tells of itself
    for arch, flags in levels.items():
        kernel = f"g++ -v1 {common} {shared} -fx -fy {flags} -DSW_ARCH={arch}"
        expected.append(compiled(kernel, "level.cpp", f"{arch}-0"))
    nvcc = "/opt/cuda/bin/nvcc -std=c++20 -O3 -Xcompiler -fPIC -gencode=arch=compute_80,code=sm_80"
    expected.append(compiled(f"{nvcc} -gencode=arch=compute_90a,code=sm_90a {shared}", "fill.cu", "cuda-0"))
    assert sorted(map(shlex.join, run)) == sorted(expected)
    objects = " ".join(f"{scratch}/{name}.o" for name in ("0", "1", "2", *(f"{arch}-0" for arch in levels), "cuda-0"))
    cuda = f"-L {home}/lib64 -lcudart_static -ldl -lrt"
    shows = f"-Wl,--version-script={scratch}/shown"
    runtime = "".join(f"{path} " for path in toolchain.runtime_libraries())
    portable = f"-pthread {cuda} -static-libstdc++ -static-libgcc {shows} -Wl,-s,-z,defs"
    linked = f"{runtime}-pthread {cuda} {shows}" if march == "native" else portable
    assert shlex.join(link) == f"g++ -v1 -shared {objects} -o {scratch}/{library.name} {linked}"
    facts = json.loads(library.with_suffix(".json").read_text())
    assert (facts["march"], facts["architectures"], facts["compiler"]) == (march, ["8.0", "9.0a"], "g++ 99")


def test_the_cache_key_is_that_of_earlier_releases(package, monkeypatch):
    """Else every user compiles again."""
    module = fake_cuda(package, monkeypatch)
    common = ("-std=c++20", "-O3", "-fPIC", "-fvisibility=hidden", "-fopenmp-simd", "-pthread")
    levels = {"arch_native": ("-march=native", "-mprefer-vector-width=512")}
    facts: list[object] = ["answer", "ABI 1", common, platform.system(), "x86_64", "native", levels, "a CPU"]
    facts += [("-fx", "-fy"), (), None, ["8.0", "9.0a"], ()]
    files = [package.folder / name for name in ("answer.cpp", "second.cpp", "level.cpp", "fill.cu", "face.h")]
    digest = hashlib.sha256(repr(facts).encode())
    for path in [*files, package.folder / "value.h", *sorted(toolchain.SHARED_INCLUDE.rglob("*.h"))]:
        content = path.read_bytes()
        digest.update(f"\0{path.name}\0{len(content)}\0".encode() + content)
    assert module.key("native") == digest.hexdigest()[:16]
    assert module._library(module.cache_folder, "native").name == f"answer-{module.key('native')}.so"
    assert module._library(module.prebuilt_folder, "portable").name == f"answer-portable-{module.source_hash()}.so"
