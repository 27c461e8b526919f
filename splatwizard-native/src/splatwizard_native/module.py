"""Native modules: C++ and CUDA sources that ship with a package, found prebuilt, cached, or compiled on first use.

A module has a plain C face (docs/native.md): one binary for any torch and any Python.
Environment: SPLATWIZARD_CACHE (where builds go), SPLATWIZARD_NATIVE=0 (do without native code),
SPLATWIZARD_BUILD_TIMEOUT (seconds to wait for another process's build), CXX, CUDA_HOME, TORCH_CUDA_ARCH_LIST (compute
capabilities to build for, as "8.0;9.0"; without it those of the GPUs here), MAX_JOBS.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import importlib.util
import itertools
import logging
import os
import platform
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from splatwizard_native import cuda_toolkit, toolchain
from splatwizard_native.errors import NativeBuildError
from splatwizard_native.face import ABI, OPERATION
from splatwizard_native.library import architectures_of, fetch, install, is_intact, keep, open_face
from splatwizard_native.lock import build_lock
from splatwizard_native.settings import SWITCHED_OFF, build_timeout, cache_root, switched_off
from splatwizard_native.toolchain import Job, Toolchain
from splatwizard_native.work_clock import loading

log = logging.getLogger(__name__)

MARCHES = ("native", "portable")

Say = Callable[[str], None]


@dataclass
class _Session:
    """State of a module in this process, shared by all: a loaded library cannot be unloaded.

    library what was loaded
    cuda    whether its module for GPUs is loaded; None: nobody has asked yet
    """

    loaded: Path | None = None
    library: ctypes.CDLL | None = None
    error: NativeBuildError | None = None
    warned: bool = False
    cuda: bool | None = None


@dataclass(frozen=True)
class NativeModule:
    """One shared library, described by its sources.

    name            of the library's file; what C functions of a face begin with
    package         import package whose folder the paths below are relative to
    face            header of its plain C face (<splatwizard/c_face.h>)
    sources         C++ files compiled once: what stands behind the face
    kernels         C++ files compiled once per instruction set, in `namespace SW_ARCH` (<splatwizard/dispatch.h>)
    headers         every header that the files above include from the package; globs are allowed
    cuda            the same for tensors on a GPU, as a library of its own
    cuda_sources    .cu files: this is a module for GPUs, compiled only where torch has CUDA
    cflags          more flags for sources and kernels
    without         what happens without this module, told to the user when it cannot be built
    """

    name: str
    package: str
    face: str
    sources: tuple[str, ...]
    headers: tuple[str, ...] = ()
    cuda_sources: tuple[str, ...] = ()
    cflags: tuple[str, ...] = ()
    kernels: tuple[str, ...] = ()
    without: str = ""
    cuda: NativeModule | None = None
    _session: _Session = field(default_factory=_Session, init=False, repr=False, compare=False)

    def load(self, *, say: Say | None = None) -> None:
        """Make the operations usable: prebuilt, cached, or compiled now with a line of progress through `say`.

        Raises NativeBuildError with the reason and what to do; a second call raises it again without compiling.
        """
        session = self._session
        if session.loaded is not None:
            return
        if session.error is not None:
            raise session.error
        try:
            with loading():
                self._load(say)
        except NativeBuildError as error:
            if not switched_off():  # the environment is asked anew each time
                session.error = error
            raise

    def try_load(self) -> bool:
        """Load, and say whether it worked; if not, warn once in this process. For code that has a torch fallback."""
        try:
            self.load()
        except NativeBuildError as error:
            if not self._session.warned and not switched_off():
                log.warning("%s", error)
            self._session.warned = True
            return False
        return True

    def has_cuda(self) -> bool:
        """Load the module for GPUs, and say whether there is one; if not, warn once. For code with a torch fallback."""
        session = self._session
        if session.cuda is None and self.cuda is not None and not switched_off():
            missing = self.cuda.available()  # asked first: nothing is compiled for nothing
            session.cuda = missing is None and self.cuda.try_load()
            if missing is not None:
                log.warning("kernels '%s' have no CUDA part: %s; %s", self.name, missing, self.cuda.without)
        return bool(session.cuda)

    def load_built(self) -> bool:
        """Load a build that is there already, and say whether there was one; compiles nothing.

        Raises NativeBuildError if native code is switched off, or if what is there does not load.
        """
        if self._session.loaded is None:
            if switched_off():
                raise NativeBuildError(SWITCHED_OFF)
            problems: list[str] = []
            for library in self._existing():
                problem = self._open(library)
                if problem is None:
                    for each in problems:
                        _warn_once(f"{each}; another one is loaded")
                    return True
                problems.append(f"{library} does not load: {problem}")
            if problems:
                raise NativeBuildError("; ".join(problems))
        return self._session.loaded is not None

    @property
    def library(self) -> ctypes.CDLL:
        """Return the library, loaded now if it is not yet. Raises NativeBuildError."""
        self.load()
        assert self._session.library is not None
        return self._session.library

    @property
    def face_header(self) -> str:
        """Return the text of the header that C and Python read, with that of the package's own that it includes."""
        path = self._root() / self.face
        included = lambda found: (path.parent / found[1]).read_text("utf-8")  # noqa: E731
        return re.sub(r'^#include "(.+)"$', included, path.read_text("utf-8"), flags=re.MULTILINE)

    def available(self, *, cuda: bool = False) -> str | None:
        """The reason why `load` would fail, or with `cuda` that of its module for GPUs; or None.

        Compiles nothing: a compiler that is there is taken to work.
        """
        session = self._session
        if cuda:
            return f"module '{self.name}' has no CUDA kernels" if self.cuda is None else self.cuda.available()
        if session.error is not None:
            return str(session.error)
        try:
            if session.loaded is None and switched_off():
                return SWITCHED_OFF
            if session.loaded is None and next(self._existing(), None) is None:
                self._find_compilers()
        except NativeBuildError as error:
            return str(error)
        return None

    def state(self) -> dict[str, Any]:
        """Facts for `sw doctor`: state (prebuilt, built, damaged, reference), path, target (cpu, cuda).

        damaged: there is a library for this machine and these sources, but not the one that the build wrote.
        """
        path = self._session.loaded or next(self._existing(), None)
        if path is not None:
            state = "built" if path.parent == self.cache_folder else "prebuilt"
        else:
            state = "damaged" if any(library.exists() for library in self._places()) else "reference"
        target = "cuda" if self.cuda_sources else "cpu"
        return {"state": state, "path": None if path is None else str(path), "target": target}

    def is_built(self, march: str, folder: Path | None = None) -> bool:
        """Whether `build` with these arguments would find the library there and undamaged."""
        return is_intact(self._library(folder or self.cache_folder, march))

    def build(
        self,
        *,
        march: str = "native",
        folder: Path | None = None,
        force: bool = False,
        tools: Toolchain | None = None,
        say: Say | None = None,
    ) -> Path:
        """Compile ahead of time and return the library's path; if it is there already and `force` is False, that one.

        march       "native": for this machine's CPU. "portable": for any, with run-time dispatch on x86-64
        folder      where it goes; None: this user's cache. `prebuilt_folder` ships with the package
        tools       shares its limit on concurrent compilers between modules
        Raises NativeBuildError.
        """
        folder = folder or self.cache_folder
        library = self._library(folder, march)
        try:
            folder.mkdir(parents=True, exist_ok=True)
            with build_lock(library.with_suffix(".lock"), timeout=build_timeout(), say=say or _say):
                if force or not is_intact(library):
                    self._compile(library, march, tools or Toolchain(), say or _say, force)
        except NativeBuildError as error:
            raise self._failure(error) from error
        except OSError as error:
            advice = "set SPLATWIZARD_CACHE to a writable folder"
            raise self._failure(f"cannot write {folder} ({error.strerror}): {advice}") from error
        return library

    @property
    def prebuilt_folder(self) -> Path:
        """Folder where a wheel, or `sw build-kernels --portable`, puts the library."""
        return self._root() / "prebuilt"

    @property
    def cache_folder(self) -> Path:
        """Folder of builds for this user."""
        return cache_root() / "native"

    def key(self, march: str) -> str:
        """Digest of all that the binary depends on: flags, sources, the CPU if native, the GPUs if it is for these."""
        # What is empty belonged to linker, nvcc and torch: modules had some, and older builds stay valid.
        facts: list[object] = [
            self.name, f"ABI {ABI}", toolchain.COMMON_FLAGS, platform.system(), platform.machine(), march,
            toolchain.arch_variants(march), toolchain.cpu_identity() if march == "native" else "", self.cflags, (),
        ]  # fmt: skip
        if self.cuda_sources:
            facts += [None, cuda_toolkit.architectures(), ()]
        return self._digest(facts, self._files())

    def source_hash(self) -> str:
        """Digest of sources and flags, whatever compiles them: a library tells it."""
        return self._digest([self.name, ABI, self.cflags], self._files())

    def _digest(self, facts: list[object], files: Sequence[Path]) -> str:
        digest = hashlib.sha256(repr(facts).encode())
        for path in files:
            try:
                content = path.read_bytes()
            except OSError as error:
                raise NativeBuildError(f"kernel source {path} of '{self.name}' cannot be read: {error}") from error
            digest.update(f"\0{path.name}\0{len(content)}\0".encode() + content)
        return digest.hexdigest()[:16]

    def _load(self, say: Say | None) -> None:
        if switched_off():
            raise self._failure(SWITCHED_OFF)
        try:
            if self.load_built():
                return
        except NativeBuildError as error:
            log.warning("%s; it is compiled anew", error)
        library = self.build(force=self.is_built("native"), say=say)
        problem = self._open(library)
        if problem is not None:
            raise self._failure(f"{library} was compiled but does not load: {problem}")

    def _open(self, library: Path) -> str | None:
        """Load a library; the reason if that fails."""
        symbols = [f"{module}_{op}" for module, op in OPERATION.findall(self.face_header) if module == self.name]
        try:
            self._session.library = open_face(library, self.name, self.source_hash(), symbols)
        except OSError as error:
            return str(error)
        self._session.loaded = library
        return None

    def _existing(self) -> Iterator[Path]:
        """Undamaged libraries for this machine and these sources, best first."""
        for library in self._places():
            if is_intact(library):
                held = architectures_of(library)
                if not held or all(any(cuda_toolkit.runs_on(a, gpu) for a in held) for gpu in cuda_toolkit.gpus()):
                    yield library
            elif library.exists():
                _warn_once(f"{library} is damaged, and not loaded")

    def _places(self) -> Iterator[Path]:
        """Places of a library for this machine and these sources, best first."""
        shipped = cuda_toolkit.distributed() if self.cuda_sources else []
        for folder, march in itertools.product((*shipped, self.prebuilt_folder, self.cache_folder), MARCHES):
            yield self._library(folder, march)

    def prebuilt_name(self, march: str) -> str:
        """File name in a wheel, which tells for which machine it is."""
        return f"{self.name}-{march}-{self.source_hash()}.so"

    def _library(self, folder: Path, march: str) -> Path:
        shipped = folder.name == "prebuilt"
        return folder / (self.prebuilt_name(march) if shipped else f"{self.name}-{self.key(march)}.so")

    def _root(self) -> Path:
        spec = importlib.util.find_spec(self.package)
        if spec is None or not spec.submodule_search_locations:
            raise NativeBuildError(f"native module '{self.name}': package '{self.package}' is not a folder on disk")
        return Path(next(iter(spec.submodule_search_locations)))

    def _files(self) -> list[Path]:
        """All files that the binary is made from, in a fixed order."""
        root = self._root()
        headers = [p for pattern in self.headers for p in (sorted(root.glob(pattern)) or [root / pattern])]
        shared = sorted(toolchain.SHARED_INCLUDE.rglob("*.h"))
        return [*(root / s for s in (*self.sources, *self.kernels, *self.cuda_sources)), *headers, *shared]

    def _find_compilers(self, *, for_torch: bool = True) -> None:
        """Raise NativeBuildError where a compiler that this module needs is not there, for this torch or for any."""
        if self.cuda_sources and for_torch and (missing := cuda_toolkit.toolkit_mismatch()) is not None:
            raise NativeBuildError(missing)
        toolchain.find_compiler()

    def _jobs(self, march: str, objects: Path) -> list[Job]:
        root, cuda = self._root(), bool(self.cuda_sources)
        variants = toolchain.arch_variants(march)
        shared = [*toolchain.COMMON_FLAGS, *(["-DSW_PORTABLE_X86"] if "arch_v2" in variants else [])]
        # What calls the kernels runs on every machine that the binary is for, so it gets the lowest of the variants.
        lowest = next(iter(variants.values()))
        include = toolchain.SHARED_INCLUDE_FLAGS
        theirs = toolchain.cuda_flags("-isystem", "include") if cuda else ()
        sources = [*(root / s for s in self.sources), objects / f"{self.name}.cpp"]
        tells = f'#include <splatwizard/c_face.h>\nSW_FACE({self.name}, "{self.source_hash()}")\n'
        sources[-1].write_text(tells, "utf-8")
        behind = (*shared, *lowest, *include, *theirs, *self.cflags)
        jobs = [Job(source, objects / f"{i}.o", behind) for i, source in enumerate(sources)]
        # Lowest level first: of inline functions that several objects emit the linker keeps the first, and that
        # one must run on every machine.
        for arch, flags in variants.items():
            kernel = (*shared, *include, *self.cflags, *flags, f"-DSW_ARCH={arch}")
            jobs += [Job(root / s, objects / f"{arch}-{i}.o", kernel) for i, s in enumerate(self.kernels)]
        if cuda:
            asked = [a.replace(".", "").partition("+") for a in cuda_toolkit.architectures()]
            code = [(a, kind) for a, ptx, _ in asked for kind in (("sm", "compute") if ptx else ("sm",))]
            gencode = [f"-gencode=arch=compute_{a},code={kind}_{a}" for a, kind in code]
            flags = ("-std=c++20", "-O3", "-Xcompiler", "-fPIC", *gencode, *include)
            jobs += [Job(root / s, objects / f"cuda-{i}.o", flags, cuda=True) for i, s in enumerate(self.cuda_sources)]
        return jobs

    def _kept(self, jobs: Sequence[Job], compiler: str) -> list[Path]:
        """Places of objects, by all that they depend on, so that one changed file is compiled alone."""
        headers = [path for path in self._files() if path.suffix == ".h"]
        nvcc = self.cuda_sources and cuda_toolkit.nvcc_version(cuda_toolkit.find_nvcc() or "nvcc")
        places = []
        for job in jobs:
            facts: list[object] = [compiler, "", [f for f in job.flags if f != str(toolchain.SHARED_INCLUDE)]]
            facts += [nvcc, os.environ.get("NVCC_APPEND_FLAGS")] if job.cuda else []
            name = f"{job.source.stem}-{self._digest(facts, [job.source, *headers])}.o"
            places.append(self.cache_folder / "objects" / name)
        return places

    def _compile(self, library: Path, march: str, tools: Toolchain, say: Say, force: bool) -> None:
        self._find_compilers(for_torch=march == "native")
        say(f"compiling kernels '{self.name}' (once) ...")
        started, cuda = time.monotonic(), bool(self.cuda_sources)
        build_log = library.with_suffix(".log")
        build_log.unlink(missing_ok=True)
        prefix = f".{library.stem}-"
        for left in library.parent.glob(f"{prefix}*"):  # by a killed build: whoever lives would hold the lock
            shutil.rmtree(left, ignore_errors=True)
        with tempfile.TemporaryDirectory(dir=library.parent, prefix=prefix) as scratch:
            jobs = self._jobs(march, Path(scratch))
            kept = dict(zip(jobs, self._kept(jobs, tools.version()), strict=True))
            missing = [job for job, place in kept.items() if force or not fetch(place, job.output)]
            built, shown = Path(scratch) / library.name, Path(scratch) / "shown"
            shown.write_text(f"{{ global: {self.name}_*; local: *; }};\n", "utf-8")
            try:
                tools.compile(missing, build_log)
                self._check_headers(missing)
                libraries = toolchain.libraries(march, shown, cuda=cuda)
                tools.link([j.output for j in jobs], built, build_log, libraries)
            except NativeBuildError as error:
                raise NativeBuildError(f"\n{error}\nfull log: {build_log}") from error
            for job in missing:
                keep(job.output, kept[job])
            seconds = round(time.monotonic() - started, 1)
            facts = {"seconds": seconds, "compiler": tools.version(), "march": march}
            install(built, library, {**facts, "architectures": cuda_toolkit.architectures() if cuda else []})
        say(f"compiled kernels '{self.name}' in {seconds:.0f} s")

    def _check_headers(self, jobs: list[Job]) -> None:
        """A header of the package that is not declared would let a stale build pass for a fresh one."""
        root = self._root().resolve()
        known = {p.resolve() for p in self._files()}
        for job in jobs:
            for path in toolchain.read_dependencies(Path(f"{job.output}.d")):
                resolved = path.resolve()
                if resolved.is_relative_to(root) and resolved not in known and path != job.source:
                    raise NativeBuildError(
                        f"{job.source.name} includes {resolved.relative_to(root)}, which the module does not declare: "
                        "add it to headers"
                    )

    def _failure(self, reason: object) -> NativeBuildError:
        without = f"\nwithout them: {self.without}" if self.without else ""
        return NativeBuildError(f"kernels '{self.name}' are not available: {reason}{without}")


@functools.cache
def _warn_once(message: str) -> None:
    log.warning("%s", message)


def _say(message: str) -> None:
    """Progress to whoever sits at the terminal; logging would hide it unless configured."""
    print(message, file=sys.stderr, flush=True)
