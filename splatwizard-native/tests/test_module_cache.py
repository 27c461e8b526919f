"""The cache of compiled libraries: what makes a new one, what is found again, what is damaged or foreign."""

import errno
import json
import os
import sys
from types import SimpleNamespace

import pytest
from native_package import call, digest_of, needs_compiler

from splatwizard_native import NativeBuildError, cache_root, toolchain
from splatwizard_native import library as library_module


@needs_compiler
@pytest.mark.parametrize("name", ["answer.cpp", "value.h"])
def test_a_changed_source_or_header_recompiles(package, name):
    package.module().build()
    text = (package.folder / name).read_text()
    package.write(name, text.replace("41", "50").replace("VALUE + 1", "VALUE + 10"))
    assert call(package.module().build()) == 51
    assert package.compilations == 2


def test_the_cache_key_names_flags_and_cpu(package, monkeypatch):
    module = package.module()
    keys = {module.key("native"), module.key("portable"), package.module(cflags=("-DX",)).key("native")}
    with monkeypatch.context() as patch:
        patch.setattr(toolchain, "cpu_identity", lambda: "another CPU")
        keys.add(module.key("native"))
        assert module.key("portable") in keys
    assert len(keys) == 4
    assert module.key("native") in keys


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
    assert package.links == 2
    assert call(module.state()["path"]) == 42


@needs_compiler
def test_available_and_state_compile_nothing(package):
    module = package.module()
    assert module.available() is None
    assert module.state() == {"state": "reference", "path": None, "target": "cpu"}
    assert package.compilations == 0


@needs_compiler
def test_a_cache_that_cannot_be_written_is_named_and_left_to_the_fallback(package, monkeypatch, caplog, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SPLATWIZARD_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(NativeBuildError, match=r"cannot write .*below.*SPLATWIZARD_CACHE"):
        package.module().load()
    assert not package.module().try_load()
    (message,) = caplog.messages
    assert "answers are guessed" in message


@needs_compiler
def test_a_full_disk_is_named_and_left_to_the_fallback(package, monkeypatch, caplog):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(library_module.os, "replace", full)
    assert not package.module().try_load()
    (record,) = caplog.records
    assert "cannot write" in record.message
    assert "No space left on device" in record.message
    assert "answers are guessed" in record.message


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
    assert module.state()["state"] == "built"
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


def test_a_library_of_another_user_is_compiled_anew(package, monkeypatch, caplog):
    library = package.module().build()
    kept = list((library.parent / "objects").iterdir())
    assert package.module().build() == library
    assert package.links == 1
    real = os.stat

    def stat(path, **kwargs):
        found = real(path, **kwargs)
        return SimpleNamespace(st_uid=12345) if path in (library, *kept) and package.links == 1 else found

    monkeypatch.setattr(library_module.os, "stat", stat)
    package.module().build()
    assert (package.links, package.compilations) == (2, 2)
    assert f"{library} belongs to another user (12345): it is not loaded, but compiled anew" in caplog.text
    assert all(f"{each} belongs to another user" in caplog.text for each in kept)


def test_what_a_killed_build_left_is_removed_by_the_next(package):
    module = package.module()
    left = module.cache_folder / f".{module.build().stem}-0123abcd"
    for library in module.cache_folder.glob("*.so"):
        library.unlink()
    left.mkdir()
    (left / "answer.o").write_bytes(b"half")
    module.build()
    assert not left.exists()
