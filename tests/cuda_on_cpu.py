"""A plugin of pytest that lets tests of CUDA run without a GPU: kernels run on the CPU, tensors only say "cuda".

    python -m pytest -p cuda_on_cpu -m cuda plugins/sw-hac/tests/fast

A tensor is on the "GPU" if its memory was asked for there, or is of an operation with such a tensor. Its numbers are on
the CPU, where torch computes with them as ever; new memory holds NaN. Kernels are the .cu files themselves, against the
headers of `cuda_headers`: what they compute is seen, how fast they are is not, nor what only happens between streams.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import re
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from splatwizard_native import NativeModule, toolchain

HEADERS = Path(__file__).with_name("cuda_headers")
FLAGS = ("-std=c++20", "-O2", "-fPIC", "-w", "-fno-strict-aliasing", "-ffp-contract=off", "-fvisibility=hidden")
ON_DEVICE = ("-x", "c++", "-D__CUDACC__", "-D__CUDA_ARCH__=900", "-include", "cuda_runtime_api.h")
STREAM = 4711
LAUNCH = re.compile(r"(\w+(?:<[^<>;]*>)?)<<<(.*?)>>>\(", re.DOTALL)
DYNAMIC = re.compile(r"extern __shared__ (?:__align__\(\d+\) )?(\w+) (\w+)\[\];")
ASSEMBLY = re.compile(r'asm(?: volatile)?\(\s*"(\S+) (.*?)\);', re.DOTALL)
OPERAND = re.compile(r'"[+=]?[rf]"\(\s*(\w+(?:\[\w+\])?|unsigned\(\w+\(\w+\)\))\)')


def as_cpp(source: str) -> str:
    """Return a .cu file as C++."""
    source = LAUNCH.sub(r"cuda_on_cpu::launch(\1, \2)(", source)
    source = DYNAMIC.sub(r"\1* const \2 = reinterpret_cast<\1*>(cuda_on_cpu::state.shared);", source)
    called = lambda found: f"cuda_on_cpu::{re.sub('[.]', '_', found[1])}({', '.join(OPERAND.findall(found[2]))});"  # noqa: E731
    return ASSEMBLY.sub(called, source)


def library_of(module: NativeModule) -> Path:
    """Compile a module for GPUs to a library for this CPU, or take that of an earlier run."""
    root = module._root()
    texts = [as_cpp((root / name).read_text("utf-8")) for name in (*module.sources, *module.cuda_sources)]
    facts = [module.source_hash(), FLAGS, ON_DEVICE, texts, [path.read_text() for path in sorted(HEADERS.iterdir())]]
    key = hashlib.sha256(repr(facts).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / "cuda_on_cpu"
    library = folder / f"{module.name}-{key}.so"
    if library.exists():
        return library
    folder.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        include = [f"-I{HEADERS}", "-isystem", str(toolchain.SHARED_INCLUDE)]
        objects, jobs = [], []
        for number, (name, text) in enumerate(zip((*module.sources, *module.cuda_sources), texts, strict=True)):
            source, on_device = root / name, name.endswith(".cu")
            if number == 0:
                text += f'\nSW_FACE({module.name}, "{module.source_hash()}")\n'
            (written := Path(scratch) / f"{number}.cpp").write_text(f'#line 1 "{source}"\n{text}', "utf-8")
            objects.append(f"{scratch}/{number}.o")
            beside = [f"-I{source.parent}", *include, *(ON_DEVICE if on_device else ())]
            jobs.append(["g++", *FLAGS, *beside, "-c", str(written), "-o", objects[-1]])
        for job in [*jobs, ["g++", "-shared", *objects, "-o", f"{scratch}/made.so"]]:
            subprocess.run(job, check=True)
        Path(scratch, "made.so").replace(library)
    return library


def load(module: NativeModule, say: Any, *, ordinary: Callable[..., None]) -> None:
    """Stand for `NativeModule._load`."""
    if not module.cuda_sources:
        ordinary(module, say)
    elif (problem := module._open(library_of(module))) is not None:
        raise module._failure(problem)
    else:
        module._session.library = Recorded(module._session.library)


class Recorded:
    """A library whose calls a graph records."""

    def __init__(self, library: Any) -> None:
        self._library = library

    def __getattr__(self, name: str) -> Any:
        function = getattr(self._library, name)
        if name.endswith("_last_error"):
            return function

        def call(reference: Any) -> int:
            again = type(reference._obj).from_buffer_copy(reference._obj)
            Graph.record(lambda: function(ctypes.byref(again)))
            return function(reference)

        return call


class Graph:
    """A graph of CUDA: what was recorded of the process, done anew; all memory stays with it."""

    recording: Graph | None = None

    def __init__(self) -> None:
        self._calls: list[Callable[[], object]] = []

    @classmethod
    def record(cls, call: Callable[[], object]) -> None:
        if cls.recording is not None:
            cls.recording._calls.append(call)

    def capture_begin(self, *args: Any, **kwargs: Any) -> None:
        Graph.recording = self

    def capture_end(self) -> None:
        Graph.recording = None

    @torch.no_grad()
    def replay(self) -> None:
        for call in self._calls:
            call()


class Places:
    """Memory that is said to be on the GPU."""

    def __init__(self) -> None:
        self._kept: dict[int, Any] = {}  # address of a storage -> weak reference, which keeps the address from others
        self._room = 1000
        self.spread = True

    def put(self, found: Any) -> Any:
        if isinstance(found, torch.Tensor):
            storage = found.untyped_storage()
            self._kept.setdefault(storage._cdata, torch.multiprocessing.reductions.StorageWeakRef(storage))
            if len(self._kept) > self._room:
                self._kept = {key: ref for key, ref in self._kept.items() if not ref.expired()}
                self._room = 2 * len(self._kept) + 1000
        elif isinstance(found, (tuple, list)):
            for each in found:
                self.put(each)
        return found

    def has(self, x: torch.Tensor) -> bool:
        try:
            return x.untyped_storage()._cdata in self._kept
        except (NotImplementedError, RuntimeError):  # of tensors without memory
            return False

    @contextlib.contextmanager
    def apart(self) -> Iterator[None]:
        """Let results of operations be on the CPU."""
        before, self.spread = self.spread, False
        try:
            yield
        finally:
            self.spread = before


PLACES = Places()
EMPTY = {"empty", "new_empty", "empty_like", "empty_strided", "new_empty_strided"}
GPU = torch.device("cuda", 0)


def tensors_in(values: Any) -> Iterator[torch.Tensor]:
    for value in values:
        if isinstance(value, torch.Tensor):
            yield value
        elif isinstance(value, (tuple, list)):
            yield from tensors_in(value)


class Spreading(TorchDispatchMode):
    """Results of an operation are where its tensors are; new memory holds what nobody would want to compute with."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        given, kwargs = list(tensors_in(args)), kwargs or {}
        on_gpu = any(map(PLACES.has, given))
        if on_gpu and Graph.recording is not None and func is torch.ops.aten._local_scalar_dense.default:
            raise RuntimeError("operation not permitted when stream is capturing")
        found = func(*args, **kwargs)
        if func.overloadpacket.__name__ in EMPTY and found.numel():
            poison(found)
        if PLACES.spread and on_gpu:
            PLACES.put(found)
        if Graph.recording is not None and (on_gpu or not given):
            Graph.record(functools.partial(repeat, func, args, kwargs, found, {storage_of(x) for x in given}))
        return found


def storage_of(x: torch.Tensor) -> int:
    return x.untyped_storage()._cdata


def repeat(func: Any, args: Any, kwargs: Any, found: Any, given: set[int]) -> None:
    """Do an operation again, with its results where they were."""
    if func.overloadpacket.__name__ in EMPTY:
        return poison(found)
    again = func(*args, **kwargs)
    for old, new in zip(tensors_in([found]), tensors_in([again]), strict=True):
        if storage_of(old) not in given:  # else it is a view, or was written in place
            old.copy_(new)
    return None


def poison(x: torch.Tensor) -> None:
    if x.dtype.is_floating_point:
        x.fill_(float("nan"))
    elif x.dtype is not torch.bool and not x.dtype.is_complex:
        x.fill_(torch.iinfo(x.dtype).max)


class Move(torch.autograd.Function):
    """Copy a tensor to the GPU or from there."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, to_gpu: bool) -> torch.Tensor:
        ctx.from_gpu = PLACES.has(x)
        with PLACES.apart():
            found = x.detach().clone()
        return PLACES.put(found) if to_gpu else found

    @staticmethod
    def backward(ctx: Any, slope: torch.Tensor) -> tuple[torch.Tensor, None]:
        return Move.apply(slope, ctx.from_gpu), None


def moved(x: torch.Tensor, device: Any, copy: bool = False) -> torch.Tensor:
    to_gpu = torch.device(device).type == "cuda"
    return Move.apply(x, to_gpu) if copy or to_gpu != PLACES.has(x) else x


def patched_to(ordinary: Any) -> Any:
    def to(self: torch.Tensor, *args: Any, **kwargs: Any) -> torch.Tensor:
        device = kwargs.pop("device", None)
        dtype = next((each for each in args if isinstance(each, torch.dtype)), kwargs.pop("dtype", None))
        for each in args[:1]:
            if isinstance(each, torch.Tensor):
                device, dtype = each.device, each.dtype
            elif isinstance(each, (str, int, torch.device)):
                device = each
        here = self if dtype is None else ordinary(self, dtype)
        return here if device is None else moved(here, device, kwargs.get("copy", False) and here is self)

    return to


def patched_factory(ordinary: Any) -> Any:
    """Let what makes a tensor make it on the "GPU"."""

    @functools.wraps(ordinary)
    def make(*args: Any, **kwargs: Any) -> Any:
        device, _ = kwargs.pop("device", None), kwargs.pop("pin_memory", None)
        if device is None or torch.device(device).type not in ("cpu", "cuda"):
            return ordinary(*args, **kwargs, **({} if device is None else {"device": device}))
        with PLACES.apart():
            found = ordinary(*args, **kwargs)
        return PLACES.put(found) if torch.device(device).type == "cuda" else found

    return make


FACTORIES = (
    "tensor", "as_tensor", "asarray", "zeros", "ones", "empty", "full", "arange", "linspace", "logspace", "eye",
    "rand", "randn", "randint", "randperm", "zeros_like", "ones_like", "empty_like", "full_like", "rand_like",
    "randn_like", "randint_like", "empty_strided", "normal", "tril_indices", "triu_indices", "scalar_tensor",
)  # fmt: skip
METHODS = ("new_zeros", "new_ones", "new_empty", "new_full", "new_tensor", "new_empty_strided")


class Generator(torch.Generator):
    def __new__(cls, device: Any = "cpu") -> Any:
        return super().__new__(cls, "cpu")

    def __init__(self, device: Any = "cpu") -> None:
        self.said = GPU if torch.device(device).type == "cuda" else torch.device("cpu")

    device = property(lambda self: self.said)


class Nothing:
    """A stream, an event, a device of torch.cuda: nothing is to be waited for."""

    cuda_stream, device_index = STREAM, 0

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        pass

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *args: object) -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        return lambda *args, **kwargs: None


def install() -> None:
    """Let this process have a "GPU"."""
    tensor = torch.Tensor
    device = tensor.device
    has = PLACES.has
    tensor.is_cuda = property(has)
    tensor.is_cpu = property(lambda self: not has(self))
    tensor.device = property(lambda self: GPU if has(self) else device.__get__(self))
    tensor.get_device = lambda self: 0 if has(self) else -1
    tensor.to = patched_to(tensor.to)
    tensor.cuda = lambda self, *args, **kwargs: moved(self, "cuda")
    tensor.cpu = lambda self, *args, **kwargs: moved(self, "cpu")
    tensor.__deepcopy__ = patched_deepcopy(tensor.__deepcopy__)
    tensor.numpy = patched_numpy(tensor.numpy)
    for name in FACTORIES:
        setattr(torch, name, patched_factory(getattr(torch, name)))
    for name in METHODS:
        setattr(tensor, name, patched_method(getattr(tensor, name)))
    torch.Generator = Generator
    torch._C._cuda_getCurrentRawStream = lambda device: STREAM
    torch.cuda.CUDAGraph = Graph
    torch.cuda.Stream = torch.cuda.Event = torch.cuda.device = torch.cuda.stream = Nothing
    told = {
        "is_available": True, "device_count": 1, "current_device": 0, "get_device_capability": (9, 0),
        "get_device_name": "CUDA on a CPU", "synchronize": None, "current_stream": Nothing(),
        "is_current_stream_capturing": False, "graph_pool_handle": (0, 0), "empty_cache": None,
        "set_sync_debug_mode": None,
        "get_sync_debug_mode": 0, "max_memory_allocated": 0, "memory_allocated": 0, "reset_peak_memory_stats": None,
        "max_memory_reserved": 0, "memory_reserved": 0, "mem_get_info": (1 << 36, 1 << 37), "_sleep": None,
        "get_device_properties": SimpleNamespace(multi_processor_count=2, total_memory=1 << 37, name="CUDA on a CPU",
            shared_memory_per_block_optin=232_448),
    }  # fmt: skip
    for name, value in told.items():
        setattr(torch.cuda, name, lambda *args, value=value, **kwargs: value)
    NativeModule._load = functools.partialmethod(load, ordinary=NativeModule._load)
    find = NativeModule._find_compilers
    NativeModule._find_compilers = lambda self, **how: None if self.cuda_sources else find(self, **how)


def patched_method(ordinary: Any) -> Any:
    make = patched_factory(ordinary)
    return lambda self, *args, **kwargs: make(self, *args, **{"device": self.device, **kwargs})


def patched_deepcopy(ordinary: Any) -> Any:
    def copied(self: torch.Tensor, memo: Any) -> torch.Tensor:
        found = ordinary(self, memo)
        return PLACES.put(found) if PLACES.has(self) else found

    return copied


def patched_numpy(ordinary: Any) -> Any:
    def numpy(self: torch.Tensor, **how: Any) -> Any:
        if PLACES.has(self):
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        return ordinary(self, **how)

    return numpy


def pytest_configure() -> None:
    install()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    with Spreading():
        return (yield)
