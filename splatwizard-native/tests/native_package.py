"""A package with C++ sources of a few lines, which compile in a moment."""

import ctypes
import hashlib
import itertools
import re
import shutil
from pathlib import Path

import pytest

from splatwizard_native import NativeModule, toolchain

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
        self.write("face.h", "#pragma once\n#include <splatwizard/c_face.h>\n")
        self.write("answer.cpp", f'#include "value.h"\n{answer_of("VALUE + 1")}')

    def write(self, name: str, text: str) -> None:
        (self.folder / name).write_text(text)

    def module(self, **changes) -> NativeModule:
        """A new object each time, as a new process would have."""
        fields = {"face": "face.h", "sources": ("answer.cpp",), "headers": ("*.h",), "without": "answers are guessed"}
        return NativeModule(name="answer", package=self.folder.name, **{**fields, **changes})

    @property
    def compilations(self) -> int:
        """Compilations of files of the package, not of the one that each build makes: it tells the sources' hash."""
        asked = re.findall(r" -c (\S+)/\S+ ", self.calls.read_text()) if self.calls.exists() else []
        return asked.count(str(self.folder))

    @property
    def links(self) -> int:
        return self.calls.read_text().count("-shared ") if self.calls.exists() else 0


def digest_of(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def answer_of(value: str) -> str:
    return f'#include "face.h"\nSW_EXPORT int answer_told() {{ return {value}; }}\n'


def call(library: Path | str | None, function: str = "answer_told") -> int:
    # A copy: the dynamic linker would hand out the library that is already open under this path.
    assert library is not None
    copy = Path(library).with_name(f"copy-{next(packages)}.so")
    shutil.copy(library, copy)
    return getattr(ctypes.CDLL(str(copy)), function)()
