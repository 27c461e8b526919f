"""The native loader: the first load, what it says when one fails, and how native code is switched off."""

import subprocess
import sys
from pathlib import Path

import pytest
from native_package import answer_of, call, needs_compiler

from splatwizard_native import NativeBuildError


@needs_compiler
def test_the_first_load_compiles_with_a_line_of_progress_and_the_second_finds_the_cache(package):
    said: list[str] = []
    first = package.module()
    assert first.state()["state"] == "reference"
    first.load(say=said.append)
    assert said[0] == "compiling kernels 'answer' (once) ..."
    assert package.compilations == 1
    second = package.module()
    second.load(say=said.append)
    assert package.compilations == 1
    assert len(said) == 2
    assert second.state()["state"] == "built"
    assert call(second.state()["path"]) == 42


@needs_compiler
def test_a_header_that_is_not_declared_is_an_error_that_names_it(package):
    with pytest.raises(NativeBuildError, match=r"answer\.cpp includes value\.h.*add it to headers"):
        package.module(headers=()).build()


@needs_compiler
def test_a_compile_error_shows_the_compilers_line_the_log_and_how_to_go_on(package):
    package.write("answer.cpp", answer_of("nonsense"))
    module = package.module()
    with pytest.raises(NativeBuildError) as caught:
        module.load()
    text = str(caught.value)
    assert "answer.cpp:2:38: error:" in text
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
    package.write("answer.cpp", f"int missing();\n{answer_of('missing()')}")
    with pytest.raises(NativeBuildError, match=r"does not load: .*undefined symbol.*missing"):
        package.module().load()


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


def test_native_code_can_be_switched_off(package, monkeypatch, caplog):
    monkeypatch.setenv("SPLATWIZARD_NATIVE", "0")
    module = package.module()
    assert "SPLATWIZARD_NATIVE" in str(module.available())
    assert not module.try_load()
    assert not caplog.records  # who switched it off needs no warning
    assert package.compilations == 0


def test_a_missing_source_is_named(package):
    with pytest.raises(NativeBuildError, match=r"gone\.cpp"):
        package.module(sources=("gone.cpp",)).load()


def test_an_unknown_march_is_refused(package):
    with pytest.raises(ValueError, match="march is 'fast'"):
        package.module().build(march="fast")


def test_importing_imports_no_torch():
    program = "import sys, splatwizard_native; sys.exit('torch' in sys.modules)"
    subprocess.run([sys.executable, "-c", program], check=True, timeout=300)


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
