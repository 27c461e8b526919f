"""The lock of a build: one process compiles, the others wait, and a dead one blocks nobody."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from native_package import needs_compiler

from splatwizard_native import NativeBuildError
from splatwizard_native.lock import build_lock, read_holder

HOLD = """
import sys, time
from pathlib import Path
from splatwizard_native.lock import build_lock
with build_lock(Path(sys.argv[1]), timeout=300, say=print):
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
        with pytest.raises(NativeBuildError, match=rf"process {holder.pid} on .* has held .*SPLATWIZARD_BUILD_TIMEOUT"):
            module.load(say=said.append)
    finally:
        holder.communicate()
    (line,) = said
    assert line.startswith(f"waiting for process {holder.pid} on ")
    assert line.endswith(" that is compiling the same kernels ...")
    assert package.compilations == 0


@needs_compiler
def test_a_lock_of_a_killed_process_blocks_nobody(package):
    module = package.module()
    lock = module._library(module.cache_folder, "native").with_suffix(".lock")
    holder = hold_lock(lock)
    holder.kill()
    holder.communicate()
    assert read_holder(lock).pid == holder.pid
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
        assert read_holder(tmp_path / "lock").pid == os.getpid()
    assert read_holder(tmp_path / "lock") is None


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
