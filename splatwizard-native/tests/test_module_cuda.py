"""CUDA sources: when they are compiled, for which GPUs, and what is said where they cannot be."""

import importlib
import json
import re
import subprocess
from pathlib import Path

import pytest
from native_package import digest_of, needs_compiler

from splatwizard_native import NativeBuildError, cuda_toolkit, find_compiler, toolchain

CUDA_KERNEL = """
#include "value.h"
__global__ void fill(int* out) { out[threadIdx.x] = VALUE; }
"""


def test_nothing_is_compiled_for_a_gpu_where_no_cuda_kernels_can_be_built(package, monkeypatch, caplog):
    package.write("fill.cu", CUDA_KERNEL)
    monkeypatch.setattr(cuda_toolkit, "toolkit_mismatch", lambda: "there is no toolkit")
    of_gpu = package.module(cuda_sources=("fill.cu",))
    module = package.module(cuda=of_gpu)
    assert not module.has_cuda()
    assert not module.has_cuda()
    assert caplog.messages == ["kernels 'answer' have no CUDA part: there is no toolkit; answers are guessed"]
    with pytest.raises(NativeBuildError, match="there is no toolkit"):
        of_gpu.load()
    assert package.compilations == 0
    assert package.module().available(cuda=True) == "module 'answer' has no CUDA kernels"
    assert not package.module().has_cuda()


@needs_compiler
@pytest.mark.skipif(cuda_toolkit.find_nvcc() is None, reason="no CUDA compiler on this machine")
def test_cuda_sources_are_compiled_for_each_architecture(package, monkeypatch, tmp_path):
    import torch

    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",))
    monkeypatch.setattr(torch.version, "cuda", torch.version.cuda or "13.0")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    before = module.key("native")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "8.0 9.0+PTX")
    assert module.state()["target"] == "cuda"
    assert module.key("native") != before
    (job,) = [job for job in module._jobs("native", tmp_path) if job.cuda]
    assert {"-gencode=arch=compute_80,code=sm_80", "-gencode=arch=compute_90,code=compute_90"} <= set(job.flags)
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

    module = package.module(cuda=package.module(cuda_sources=("fill.cu",)))
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


GPU_FACE = """
#include <splatwizard/c_face.h>
typedef struct {
  sw_head head;
  const float* x;  // [count]
  int64_t count;
  int64_t refused;
} look_call;
SW_OPERATION(answer, look);
"""
GPU_SOURCE = """
#include "face.h"
#include <splatwizard/cuda_face.h>
void look(const float* x, int count, cudaStream_t stream);
SW_OPERATION(answer, look) {
  return splatwizard::guarded_on_gpu(call, [&](cudaStream_t stream) {
    if (call->refused) splatwizard::refuse("%lld is refused", (long long)call->refused);
    look(call->x, int(call->count), stream);
  });
}
"""
GPU_KERNEL = """
#include <cuda_runtime_api.h>
__global__ void kernel(const float* x) {}
void look(const float* x, int count, cudaStream_t stream) { kernel<<<count, 1, 0, stream>>>(x); }
"""


@needs_compiler
@pytest.mark.skipif(cuda_toolkit.find_nvcc() is None, reason="no CUDA compiler on this machine")
def test_a_face_for_gpus_is_built_without_torch_and_tells_cudas_errors(package, monkeypatch):
    import torch

    from splatwizard_native.face_operations import operations

    package.write("face.h", GPU_FACE)
    package.write("answer.cpp", GPU_SOURCE)
    package.write("kernel.cu", GPU_KERNEL)
    package.write("offered.py", "")
    monkeypatch.setattr(torch.version, "cuda", torch.version.cuda or "13.0")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda device: 0, raising=False)
    module = package.module(cuda_sources=("kernel.cu",), face="face.h")
    module.load()
    assert module.state()["state"] == "built"
    log = module.build().with_suffix(".log").read_text()
    assert "/torch/" not in log
    assert "-lcudart_static" in log
    offered = importlib.import_module(f"{package.folder.name}.offered")
    offered.__getattr__ = operations(module, offered.__name__)
    with pytest.raises(RuntimeError, match=r"look: x must be .* on the GPU, got .* on cpu"):
        offered.look(x=torch.zeros(3), refused=0)
    with pytest.raises(RuntimeError, match=r"look: x must be .* on the GPU, got .* on cpu"):
        offered.look(x=torch.zeros(3), refused=0, device=0)
    with pytest.raises(RuntimeError, match=r"^look: CUDA: \w+|^look: 1 is refused$"):  # there may be a GPU
        offered.look(x=0, count=1, refused=1, device=0)


def test_an_object_of_one_cuda_compiler_or_of_its_flags_is_not_taken_for_that_of_another(
    package, monkeypatch, tmp_path
):
    package.write("face.h", GPU_FACE)
    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",), face="face.h")
    monkeypatch.setenv("TORCH_CUDA_ARCH_LIST", "9.0")
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: "nvcc")
    jobs = module._jobs("portable", tmp_path)

    def kept(release: tuple[int, int], flags: str) -> list[Path]:
        monkeypatch.setattr(cuda_toolkit, "nvcc_version", lambda nvcc: release)
        monkeypatch.setenv("NVCC_APPEND_FLAGS", flags)
        return module._kept(jobs, "g++ 12")

    for other in (kept((12, 9), "-G"), kept((13, 0), "")):
        equal = [a == b for a, b in zip(kept((12, 9), ""), other, strict=True)]
        assert equal == [not job.cuda for job in jobs]
        assert not all(equal)


@needs_compiler
@pytest.mark.parametrize(("cuda", "other"), [("12.4", "13.0"), ("13.0", "12.4")])
def test_a_distributed_cuda_library_is_used_without_a_cuda_compiler_if_it_fits_the_gpu(
    package, monkeypatch, tmp_path, cuda, other
):
    """It was made for torch's CUDA or an older one; one of another version of the sources has another name."""
    import torch

    package.write("face.h", GPU_FACE)
    package.write("fill.cu", CUDA_KERNEL)
    module = package.module(cuda_sources=("fill.cu",), face="face.h")
    monkeypatch.setattr(torch.version, "cuda", cuda)
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: None)
    shipped = tmp_path / f"shipped_{cuda[:2]}" / f"splatwizard_cuda{cuda[:2]}" / "prebuilt"
    shipped.mkdir(parents=True)
    (shipped.parent / "__init__.py").write_text("")
    monkeypatch.syspath_prepend(str(shipped.parent.parent))
    library = shipped / module.prebuilt_name("portable")
    library.write_bytes(b"not looked into")
    facts = {"sha256": digest_of(library), "architectures": ["8.0", "9.0", "12.0a", "12.5+PTX"]}
    library.with_suffix(".json").write_text(json.dumps(facts))
    for gpu, suits in (
        ((9, 0), True),
        ((8, 6), True),
        ((7, 5), False),
        ((10, 0), False),
        ((12, 0), True),
        ((12, 1), False),
        ((12, 8), True),
        ((13, 0), True),
    ):
        monkeypatch.setattr(cuda_toolkit, "gpus", lambda gpu=gpu: [gpu])
        assert (library in module._existing()) == suits
        assert (module.available() is None) == suits
    assert module.state()["state"] == "prebuilt"
    monkeypatch.setattr(torch.version, "cuda", other)
    assert (library in module._existing()) == (other > cuda)
    monkeypatch.setattr(torch.version, "cuda", None)
    assert not list(module._existing())
    monkeypatch.setattr(torch.version, "cuda", cuda)
    package.write("fill.cu", CUDA_KERNEL + "// changed\n")
    assert not list(module._existing())


def of_another_abi(library: Path) -> None:
    source = library.with_suffix(".c")
    told = 'const char* answer_hash(void) { return ""; } const char* answer_last_error(void) { return ""; }'
    source.write_text(f"unsigned answer_abi(void) {{ return 2; }} {told} int answer_look(void* c) {{ return 0; }}")
    subprocess.run([*find_compiler(), "-x", "c", "-shared", "-fPIC", source, "-o", library], check=True)


@needs_compiler
@pytest.mark.parametrize("damage", ["of another ABI", "for another platform", "truncated"])
def test_a_broken_distributed_cuda_library_costs_one_line_and_is_left_to_the_reference(
    package, monkeypatch, caplog, tmp_path, damage
):
    import torch

    package.write("face.h", GPU_FACE)
    package.write("fill.cu", CUDA_KERNEL)
    of_gpu = package.module(cuda_sources=("fill.cu",), face="face.h")
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(cuda_toolkit, "find_nvcc", lambda: None)
    monkeypatch.setattr(cuda_toolkit, "gpus", lambda: [(9, 0)])
    shipped = tmp_path / damage.replace(" ", "_")
    monkeypatch.setattr(cuda_toolkit, "distributed", lambda: [shipped / "prebuilt"])
    library = shipped / "prebuilt" / of_gpu.prebuilt_name("portable")
    library.parent.mkdir(parents=True)
    of_another_abi(library)
    content = library.read_bytes()
    if damage == "for another platform":
        library.write_bytes(content[:18] + bytes([content[18] ^ 0xFF]) + content[19:])
    facts = {"sha256": digest_of(library), "architectures": ["9.0"]}
    library.with_suffix(".json").write_text(json.dumps(facts))
    if damage == "truncated":
        library.write_bytes(content[: len(content) // 2])
    assert not package.module(cuda=of_gpu).has_cuda()
    said = [message for message in caplog.messages if str(library) in message]
    assert len(said) == 1
    assert ("damaged" if damage == "truncated" else "does not load") in said[0]
    assert "answers are guessed" in caplog.messages[-1]
    assert len(caplog.messages) == 2
