"""Operations of a plain C face: what the header says of them, what a call checks, and what of broken libraries."""

import ctypes
import json
import subprocess
import sys

import pytest
import torch
from native_package import digest_of, needs_compiler

from splatwizard_native import NativeBuildError, find_compiler
from splatwizard_native.face import Field, read_structs
from splatwizard_native.face_operations import operations

HEADER = """
#include <splatwizard/c_face.h>

// One of several.
typedef struct {
  double weight;
  int64_t first;
} part;

typedef struct {
  sw_head head;
  const float* x;       // [rows, columns] numbers
  const int32_t* index;  // [rows] or null: which columns; all
  const sw_real* more;  // [n, 2 * n] or null
  const float* loose;   // [rows, 3] or null strided
  const float* planes[2];  // any
  int64_t rows, columns;
  int32_t real_bytes;
  const part* parts;    // or null
  int64_t numbers[3];
  double factor;
  double* sums;         // [rows]
  int64_t seen;         // out
} sum_call;
SW_OPERATION(answer, sum);
"""
SOURCE = """
#include "face.h"
#include <stdexcept>

SW_OPERATION(answer, sum) {
  return splatwizard::guarded(call, [&](const splatwizard::Parallel& parallel) {
    if (call->factor < 0) splatwizard::refuse("factor is %g", call->factor);
    if (call->factor > 1000) throw std::runtime_error("a factor that is not %d at all");
    parallel(call->rows, 1, [&](int64_t begin, int64_t end) {
      if (call->factor == 7) throw std::runtime_error("thrown by a thread");
      for (int64_t row = begin; row < end; ++row) {
        double sum = 0;
        for (int64_t c = 0; c < call->columns; ++c) sum += call->x[row * call->columns + c];
        call->sums[row] = sum * call->factor;
      }
    });
    call->seen = call->numbers[0] + call->numbers[2] + (call->parts ? int64_t(call->parts[1].weight) : 0) +
                 call->real_bytes + (call->planes[1] ? 1000 : 0);
  });
}
"""


@pytest.fixture(scope="module")
def objects(tmp_path_factory):
    return tmp_path_factory.mktemp("objects")


@pytest.fixture
def module(package, objects, tmp_path):
    """The module; its objects are kept from test to test, so that each links a library and the first alone compiles."""
    (tmp_path / "cache" / "native").mkdir(parents=True)
    (tmp_path / "cache" / "native" / "objects").symlink_to(objects)
    package.write("face.h", HEADER)
    package.write("answer.cpp", SOURCE)
    package.write("offered.py", "")
    return package.module(face="face.h")


@pytest.fixture
def offered(module, package, monkeypatch):
    """The operations as a Python module has them."""
    import importlib

    face = importlib.import_module(f"{package.folder.name}.offered")
    face.__getattr__ = operations(module, face.__name__)
    return face


def arguments(**changes):
    given = {
        "x": torch.arange(6.0).reshape(2, 3), "planes": [], "numbers": [1, 2, 3], "factor": 1.0,
        "sums": torch.zeros(2, dtype=torch.float64),
    }  # fmt: skip
    return {**given, **changes}


def test_a_header_is_read_by_lines():
    structs = read_structs(HEADER)
    assert list(structs) == ["part", "sum_call"]
    by_name = {field.name: field for field in structs["sum_call"]}
    assert by_name["x"] == Field("x", "float", True, None, ("rows", "columns"), False, False, False)
    assert by_name["index"].optional
    assert by_name["loose"].strided
    assert by_name["more"].shape == ("n", "2 * n")
    assert (by_name["planes"].length, by_name["numbers"].length) == (2, 3)
    assert by_name["seen"].out
    with pytest.raises(ValueError, match=r"struct sum_call: 'some_type x;' is no field"):
        read_structs(HEADER.replace("double factor;", "some_type x;"))
    with pytest.raises(ValueError, match=r"struct sum_call: 'size' is a field of the head"):
        read_structs("typedef struct {\n  int64_t size;\n} sum_call;\n")


@needs_compiler
def test_a_call_fills_counts_from_shapes_and_returns_results(offered):
    given = arguments()
    call = offered.sum(**given, index=torch.zeros(2, dtype=torch.int32))
    assert given["sums"].tolist() == [3, 12]
    assert (call.rows, call.columns, call.seen) == (2, 3, 4)
    parts = (offered.part * 2)((0.5, 1), (30.0, 2))
    more = torch.zeros(3, 6, dtype=torch.float64)
    call = offered.sum(**arguments(planes=[None, torch.zeros(1)]), parts=parts, more=more)
    assert call.seen == 4 + 30 + 8 + 1000


@needs_compiler
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"x": torch.zeros(2, 3).double()}, r"sum: x must be a contiguous float32 tensor \[2, 3\] .* torch.float64"),
        ({"x": torch.zeros(3, 2).T}, "x must be a contiguous"),
        ({"x": torch.zeros(6)}, r"x must be .*\[rows, columns\] .* got torch.float32 \[6\]"),
        ({"x": torch.zeros(2, 3, device="meta")}, "on the CPU, got .* on meta"),
        ({"sums": torch.zeros(3, dtype=torch.float64)}, r"sums must be .*float64 tensor \[2\] .* \[3\]"),
        ({"rows": 3}, r"x must be .* \[3, 3\]"),
        ({"index": torch.zeros(2)}, "index must be .* int32"),
        ({"more": torch.zeros(3, 5)}, r"more must be .*\[3, 2 \* n\]"),
        ({"more": torch.zeros(3, 6, dtype=torch.int32)}, "more must be"),
        ({"planes": [torch.zeros(2).double()]}, "planes must be"),
        ({"factor": -1.5}, "^sum: factor is -1.5$"),
        ({"factor": 2000.0}, "^sum: a factor that is not %d at all$"),
        ({"factor": 7.0}, "^sum: thrown by a thread$"),
    ],
)
def test_what_does_not_fit_the_header_is_refused_with_the_reason(offered, changes, said):
    with pytest.raises(RuntimeError, match=said):
        offered.sum(**arguments(**changes))


@needs_compiler
def test_a_field_that_is_missing_or_unknown_is_an_error(offered):
    with pytest.raises(TypeError, match="factor"):
        offered.sum(**{k: v for k, v in arguments().items() if k != "factor"})
    with pytest.raises(TypeError, match="nonsense"):
        offered.sum(**arguments(nonsense=1))
    with pytest.raises(AttributeError, match="'answer' has no operation 'nonsense'"):
        offered.nonsense  # noqa: B018


@needs_compiler
def test_a_call_of_another_abi_or_size_is_refused_by_the_library(module):
    head = ctypes.c_uint32 * 100
    assert module.library.answer_sum(head(8, 1)) != 0
    assert module.library.answer_last_error().startswith(b"the caller has ABI 1 and 8 bytes, the library ABI 1 and ")


@needs_compiler
def test_strided_rows_are_taken_where_the_header_says_so(offered):
    offered.sum(**arguments(), loose=torch.zeros(2, 6)[:, :3])
    with pytest.raises(RuntimeError, match=r"loose must be a float32 tensor \[2, 3\]"):
        offered.sum(**arguments(), loose=torch.zeros(2, 4))


OF_ANOTHER_ABI = """
unsigned answer_abi(void) { return 2; }
const char* answer_hash(void) { return "%s"; }
const char* answer_last_error(void) { return ""; }
int answer_sum(void* call) { return 0; }
"""


def broken(library, damage: str) -> None:
    """Break a library so that its digest still fits, as a wheel of another platform or release has it."""
    content = library.read_bytes()
    if damage == "another platform":
        content = content[:18] + bytes([content[18] ^ 0xFF]) + content[19:]  # e_machine
    elif damage == "truncated":
        content = content[: len(content) // 2]
    elif damage == "missing symbol":
        content = content.replace(b"answer_sum", b"answer_som")
    elif damage == "other sources":
        content = content.replace(b"answer_hash", b"answer_hush")
    library.write_bytes(content)
    if damage == "another ABI":
        source = library.with_suffix(".c")
        source.write_text(OF_ANOTHER_ABI % library.stem.rpartition("-")[2])
        subprocess.run([*find_compiler(), "-x", "c", "-shared", "-fPIC", source, "-o", library], check=True)
    if damage != "truncated":
        facts = library.with_suffix(".json")
        facts.write_text(json.dumps({**json.loads(facts.read_text()), "sha256": digest_of(library)}))


@needs_compiler
@pytest.mark.parametrize("damage", ["another platform", "another ABI", "truncated", "missing symbol", "other sources"])
def test_a_broken_prebuilt_library_costs_one_line_and_the_next_one_is_taken(module, package, caplog, damage):
    prebuilt = module.build(folder=module.prebuilt_folder)
    cached = module.build()
    broken(prebuilt, damage)
    fresh = package.module(face="face.h")
    assert fresh.load_built()
    assert fresh.state()["path"] == str(cached)
    assert [record.levelname for record in caplog.records] == ["WARNING"]
    assert str(prebuilt) in caplog.text
    assert damage != "another ABI" or "it is of ABI 2 and sources" in caplog.text


@needs_compiler
def test_a_broken_prebuilt_library_is_compiled_anew_and_without_a_compiler_left_to_the_reference(
    module, package, caplog, monkeypatch, tmp_path
):
    broken(module.build(folder=module.prebuilt_folder), "missing symbol")
    with monkeypatch.context() as patch:
        patch.setenv("CXX", "no-such-compiler")
        assert not package.module(face="face.h").try_load()
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
    assert "answers are guessed" in caplog.text
    caplog.clear()
    assert package.module(face="face.h").try_load()
    assert [record.levelname for record in caplog.records] == ["WARNING"]


@needs_compiler
def test_a_key_depends_on_no_torch(module, monkeypatch):
    key = module.key("native")
    monkeypatch.setattr(torch, "__version__", "99.0")
    assert module.key("native") == key
    log = module.build().with_suffix(".log").read_text()
    assert not any(torchs in log for torchs in ("/torch/", "-ltorch", "-lc10"))


@needs_compiler
@pytest.mark.skipif(sys.platform != "linux", reason="linkers of other systems do so anyway")
def test_a_library_for_others_that_lacks_a_symbol_is_not_built(module, package, tmp_path):
    package.write("answer.cpp", SOURCE + 'extern "C" int nowhere();\nint somewhere() { return nowhere(); }\n')
    with pytest.raises(NativeBuildError, match="nowhere"):
        module.build(march="portable", folder=tmp_path)


@needs_compiler
def test_one_changed_file_is_compiled_alone(package):
    package.write("other.cpp", "int other() { return 1; }\n")
    package.module(sources=("answer.cpp", "other.cpp")).build()
    assert package.compilations == 2
    package.write("other.cpp", "int other() { return 2; }\n")
    package.module(sources=("answer.cpp", "other.cpp")).build()
    assert package.compilations == 3
    package.module(sources=("answer.cpp", "other.cpp"), cflags=("-DX",)).build()
    assert package.compilations == 5
