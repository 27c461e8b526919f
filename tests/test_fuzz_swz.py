"""No file, however made, does more to a decoder than raise BitstreamError: no crash, no flood, no hang, no open handle.

A few hundred files in the default tests; 100,000 with `python -m pytest -m fuzz tests/test_fuzz_swz.py -s`, which
prints what came of them (SPLATWIZARD_FUZZ_FILES sets another number).
"""

import contextlib
import importlib.util
import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from counted_lines import lines_of
from hypothesis import given, settings
from hypothesis import strategies as st
from sw_kit import hostile_files
from sw_kit.hostile_files import Mutator, Parts, Tally, attempt
from swz_fuzzer import blind, open_handles

from splatwizard_core.base.memory import reset_peak_rss
from splatwizard_core.coding.container import ContainerReader, decoded_limit
from splatwizard_core.errors import BitstreamError, PluginError
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.decode import open_model
from sw_codecs.entropy.exact_tables import exact_tables

TESTS = Path(__file__).parent
CODECS = TESTS.parent / "plugins" / "sw-codecs" / "tests"
CPU = torch.device("cpu")
NOISE = 8 << 20  # bytes of resident set that come and go with the allocator, whatever is decoded
SEEDS = {path.stem: path.read_bytes() for path in sorted((TESTS / "golden").glob("*.swz"))}
FUZZ_FILES = int(os.environ.get("SPLATWIZARD_FUZZ_FILES", "100000"))


def load(path: Path):
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def payloads():
    """Name -> (bytes with CRCs of 0, decoder, what it must give) for each coder and entropy model."""
    exact_tables()  # their file has a CRC-32 of its own
    with blind():
        cases = load(CODECS / "test_golden_codecs.py").CASES
        return {name: (encode(), decode, np.asarray(expected)) for name, (encode, decode, expected) in cases.items()}


@pytest.fixture(scope="module")
def blind_seeds():
    """The golden models encoded with CRCs of 0, but for the largest."""
    exact_tables()  # their file has a CRC-32 of its own
    with blind():
        maker = load(TESTS / "golden" / "make_golden.py")
        return [maker.encoded(name) for name in SEEDS if name != "3dgs_classes_v1"]


def declared_count(static, name: str) -> int:
    """The number of a model's rows as a header has it: by its name, or as the rows of the packets that bring some."""
    return static[name] if name in static else sum(rows for _, kind, rows in static["order"] if kind == "base")


def decode_file(path: Path):
    """What came of a file; an AssertionError if it decodes to nonsense."""
    model, reader = open_model(path, load_plugins(), CPU)
    reader.summary()
    # Fewer than declared where rows mean nothing: those are left out.
    assert all(declared_count(reader.static, name) >= number for name, number in model.counts().items())
    if "quantized" in (reader.static.get("mode"), str(reader.static.get("codec")).removeprefix("gaussians-")):
        assert all(bool(torch.isfinite(parameter).all()) for parameter in model.parameters())
    return "decoded"


def allowed_growth(data: bytes) -> int:
    """4 times the smaller of what the header declares and the cap, and the allocator's noise."""
    declared = len(data)
    with contextlib.suppress(Exception):
        static = Parts.of(data).header["static"]
        if "grid_space" in static:
            count = load_plugins().context_models.load("hash-grid").count
            signs, log2 = static["grid_features"], static["grid_log2"]
            declared += 4 * count(static["grid_space"], static["grid_planes"], features=signs, log2_space=log2[0],
                                  log2_planes=log2[1])  # fmt: skip
            declared += 4 * static["num_anchors"] * (9 + static["feature_dim"] + 4 * static["num_offsets"])
        else:
            degree = static["max_sh_degree"] if "max_sh_degree" in static else static["sh_degree"]
            numbers = 14 + 3 * ((degree + 1) ** 2 - 1) + (200 if "order" in static else 0)  # integers of wisp
            declared = max(declared, declared_count(static, "num_gaussians") * 4 * numbers)
    return int(4 * min(max(declared, 0), decoded_limit(len(data)))) + NOISE


def fuzz_files(seeds: list[bytes], number: int, seed: int, folder: Path, tally: Tally, handles: int) -> None:
    mutator, path = Mutator(seed), folder / "hostile.swz"
    for i in range(number):
        data, kind = mutator.file(seeds)
        path.write_bytes(data)
        attempt(lambda: decode_file(path), f"file {seed}/{i} ({kind})", allowed_growth(data), tally,
                plugins_may_miss=kind.startswith("header"))  # fmt: skip
        if len(tally.problems) > 20:
            break
    assert open_handles() == handles


def fuzz_payloads(payloads, number: int, seed: int, tally: Tally) -> None:
    mutator, names = Mutator(seed), list(payloads)
    with blind():
        for i in range(number):
            name = mutator.pick(names)
            data, decode, expected = payloads[name]
            hostile = mutator.bytes_(data, payloads[mutator.pick(names)][0])

            def run(decode=decode, expected=expected, hostile=hostile, name=name):
                found = decode(hostile)
                # How many points there are, a position codec has from its bytes alone.
                positions = name.startswith("octree")
                assert found.shape[1:] == expected.shape[1:]
                assert positions or len(found) == len(expected)
                return "decoded"

            points = 24 * max(1 << 16, 64 * len(hostile)) if expected.shape[1:] == (3,) else expected.nbytes
            attempt(run, f"payload {seed}/{i} ({name})", 4 * points + NOISE, tally)
            if len(tally.problems) > 20:
                break


def test_a_few_hundred_hostile_files(tmp_path, blind_seeds, payloads):
    tally, handles = Tally(), open_handles()
    fuzz_files(list(SEEDS.values()), 75, 1, tmp_path, tally, handles)
    with blind():
        fuzz_files(blind_seeds, 125, 2, tmp_path, tally, handles)
    fuzz_payloads(payloads, 150, 3, tally)
    assert tally.problems == []
    assert tally.outcomes["refused"] > 150
    assert tally.outcomes["decoded"] > 5  # the mutations are not all caught at the door


def test_the_harness_sees_what_it_looks_for(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(hostile_files, "time", SimpleNamespace(process_time=lambda: now[0]))

    def crash():
        raise KeyError("section")

    def flood():
        return "decoded" if np.ones(5 << 20).all() else ""  # 40 MB

    def hang():
        now[0] += hostile_files.PATIENCE + 1
        return "decoded"

    def miss():
        raise PluginError("no plugin")

    tally = Tally()
    faults = [crash, *([flood] if reset_peak_rss() else []), hang, miss]  # not every system tells a peak of memory
    for number, fault in enumerate(faults, 1):
        attempt(fault, fault.__name__, 4 << 20, tally)
        assert [problem.partition(":")[0] for problem in tally.problems[number - 1 :]] == [fault.__name__]
    attempt(miss, "miss", 4 << 20, tally, plugins_may_miss=True)
    assert len(tally.problems) == len(faults)


@pytest.mark.slow
@pytest.mark.fuzz
@pytest.mark.timeout(4 * 3600)
def test_a_hundred_thousand_hostile_files(tmp_path, blind_seeds, payloads):
    tally, handles, part = Tally(), open_handles(), max(FUZZ_FILES // 100, 1)
    for round_ in range(FUZZ_FILES // part):
        seed = 1000 + round_
        # 4 tenths with checksums repaired, 4 tenths without checksums, 2 tenths bare payloads of each coder.
        if round_ % 10 < 4:
            fuzz_files(list(SEEDS.values()), part, seed, tmp_path, tally, handles)
        elif round_ % 10 < 8:
            with blind():
                fuzz_files(blind_seeds, part, seed, tmp_path, tally, handles)
        else:
            fuzz_payloads(payloads, part, seed, tally)
        if len(tally.problems) > 20:
            break
    print(
        f"\n{sum(tally.outcomes.values()):,} files: {dict(tally.outcomes)}; slowest {tally.slowest_s:.3f} s of CPU; "
        f"largest growth {tally.largest_growth / 1e6:.1f} MB, at most {tally.worst_ratio:.0%} of what was allowed"
    )
    assert tally.problems == []


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(SEEDS)), st.data())
def test_damage_without_repair_is_refused_or_harmless(name, data):
    original = SEEDS[name]
    at = data.draw(st.integers(0, len(original) - 1))
    changed = bytearray(original)
    changed[at : at + data.draw(st.integers(0, 4))] = data.draw(st.binary(max_size=6))
    if bytes(changed) == original:
        return
    with pytest.raises(BitstreamError):
        ContainerReader(bytes(changed))


json_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**65), 2**65) | st.floats() | st.text(max_size=6),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=30, deadline=None)
@given(name=st.sampled_from(sorted(SEEDS)), data=st.data(), value=json_values)
def test_any_value_in_a_header_gives_a_model_or_a_bitstream_error(tmp_path_factory, name, data, value):
    parts = Parts.of(SEEDS[name])
    key = data.draw(st.sampled_from([*parts.header["static"], "raster", "method_version", "requires", "surprise"]))
    (parts.header if key in ("raster", "method_version", "requires") else parts.header["static"])[key] = value
    path = tmp_path_factory.getbasetemp() / "header.swz"
    path.write_bytes(parts.join())
    with contextlib.suppress(BitstreamError):
        decode_file(path)


@settings(max_examples=60, deadline=None)
@given(
    section=st.sampled_from(["color", "opacity", "scales", "quats", "sh1"]),
    values=st.lists(st.integers(-(2**60), 2**60) | st.integers(-300, 300), min_size=1, max_size=9),
)
def test_any_well_coded_integers_give_a_model_or_a_bitstream_error(tmp_path_factory, section, values):
    """What no encoder would put there, but coded as it should be: it reaches the arithmetic behind the coders."""
    parts = Parts.of(SEEDS["3dgs_r3_v1"])
    width = {"opacity": 1, "sh1": 9}.get(section, 3)
    n = parts.header["static"]["num_gaussians"]
    matrix = np.resize(np.array(values, np.int64), (n, width))
    coded = load_plugins().entropy_models.load("columns")().encode(matrix)
    forged = len(coded).to_bytes(4, "little") + coded if section == "sh1" else coded
    parts.sections = [(name, forged if name == section else content) for name, content in parts.sections]
    path = tmp_path_factory.getbasetemp() / "integers.swz"
    path.write_bytes(parts.join())
    if max(map(abs, values[: n * width])) > 2**30:
        with pytest.raises(BitstreamError, match=rf"section '{section}'.*beyond"):
            decode_file(path)
    else:
        with contextlib.suppress(BitstreamError):  # finite integers may still overflow 32-bit floats
            decode_file(path)


def alike(n: int) -> bytes:
    """A file of n equal Gaussians, which the encoder would refuse to write if n is large."""
    parts = Parts.of(SEEDS["3dgs_r3_v1"])
    octree, columns = load_plugins().coders.load("octree"), load_plugins().entropy_models.load("columns")()
    static = parts.header["static"]
    static.update(num_gaussians=n, active_sh_degree=0)
    points = np.full((n, 3), 5)
    sections = {name: columns.encode(np.zeros((n, width), np.int64))
                for name, width in (("color", 3), ("opacity", 1), ("scales", 3), ("quats", 3))}  # fmt: skip
    parts.sections = [("positions", octree().encode(points, static["position_bits"])), *sections.items()]
    return parts.join()


def test_the_largest_model_that_few_bytes_may_claim_stays_within_memory(tmp_path):
    n = 1 << 16  # above it, each 64 points need a byte
    data = alike(n)
    assert len(data) < 2000
    path, tally = tmp_path / "alike.swz", Tally()
    path.write_bytes(data)
    attempt(lambda: decode_file(path), "65,536 equal Gaussians", allowed_growth(data), tally)
    assert tally.problems == []
    assert tally.outcomes["decoded"] == 1
    declared = 236 * n
    assert allowed_growth(data) == 4 * declared + NOISE


FILLERS = {
    "lists": b"[]", "objects": b"{}", "zeros": b"0", "floats": b"1e5", "strings": b'"a"', "nulls": b"null",
    "nests": b"[[[[[[[[]]]]]]]]",
}  # fmt: skip
every_filler = pytest.mark.parametrize("filler", FILLERS.values(), ids=FILLERS)


def full_header(path: Path, size: int, filler: bytes) -> int:
    """Write a file whose header is filled up to `size` bytes; the number of fillers."""
    parts = Parts.of(SEEDS["3dgs_empty_v1"])
    parts.header["static"] = {"filler": "@"}
    number = (size - 2000) // (len(filler) + 1)
    path.write_bytes(parts.join(raw=lambda raw: raw.replace(b'"@"', b"[" + b",".join([filler] * number) + b"]")))
    return number


def attempt_header(path: Path) -> float:
    """CPU seconds of reading its header, within the bound of memory."""
    tally, size = Tally(), path.stat().st_size
    attempt(lambda: ContainerReader.open(path).method, f"a header of {size:,} bytes", 4 * 64 * size + NOISE, tally)
    assert tally.problems == []
    assert tally.outcomes["3dgs"] == 1
    return tally.slowest_s


@every_filler
def test_a_header_of_the_largest_size_is_read_within_memory(tmp_path, filler):
    full_header(tmp_path / "header.swz", 1 << 19, filler)
    attempt_header(tmp_path / "header.swz")


@every_filler
def test_each_value_of_a_header_costs_the_same_number_of_lines(tmp_path, filler):
    """However many there are: what looks at all of them for each would execute quadratically many."""
    path = tmp_path / "header.swz"

    def lines(size: int) -> tuple[int, int]:
        return full_header(path, size, filler), lines_of(lambda: ContainerReader.open(path))

    few, many = lines(1 << 13), lines(1 << 16)
    a_value = (many[1] - few[1]) / (many[0] - few[0])
    assert a_value <= few[1] / few[0]  # which has its part of what every file costs
    assert a_value <= 150  # nests, of eight lists


@pytest.mark.slow
@every_filler
def test_a_header_of_the_largest_size_is_read_in_linear_time(tmp_path, filler):
    def seconds(size: int) -> float:
        full_header(tmp_path / "header.swz", size, filler)
        return min(attempt_header(tmp_path / "header.swz") for _ in range(3))

    # 8 times the bytes take 8 times as long, 25 times with the garbage collector at work; in quadratic time, 64 times.
    assert seconds(1 << 19) < 5 * 8 * seconds(1 << 16)
