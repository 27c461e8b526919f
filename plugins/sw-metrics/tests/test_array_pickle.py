"""Pickles of arrays from anybody: read where they are such, refused in one line where not, and never run."""

import contextlib
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sw_metrics.array_pickle import read_arrays

from splatwizard_core.errors import UserInputError


def refused(content: bytes, reason: str = "") -> None:
    with pytest.raises(UserInputError, match=f"^w.ckpt is no pickle of arrays: .*{reason}") as told:
        read_arrays(content, "w.ckpt")
    assert "\n" not in str(told.value)


@pytest.mark.parametrize("protocol", [3, 4])
@pytest.mark.parametrize("dtype", ["<f4", ">f4", "<f8"])
def test_arrays_come_back_by_their_path(protocol: int, dtype: str):
    generator = np.random.default_rng(0)
    kernel, bias = generator.normal(size=(3, 2, 4, 5)).astype(dtype), np.zeros(0, dtype)
    tree = {"net": {"conv": {"kernel": kernel, "bias": bias, "fortran": np.asfortranarray(kernel)}, "steps": 3}}
    found = read_arrays(pickle.dumps(tree, protocol), "w.ckpt")
    assert set(found) == {("net", "conv", "kernel"), ("net", "conv", "bias"), ("net", "conv", "fortran")}
    for name, wanted in tree["net"]["conv"].items():
        np.testing.assert_array_equal(found["net", "conv", name], wanted)
        assert found["net", "conv", name].dtype == np.dtype(dtype)


class Evil:
    """Would create a folder when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.mkdir, (str(self.path),)


def test_nothing_in_a_file_is_run(tmp_path: Path):
    for content in (
        pickle.dumps({"a": Evil(tmp_path / "run")}),
        pickle.dumps(np.array([Evil(tmp_path / "run")], dtype=object)),
        b"cos\nsystem\n(S'mkdir " + str(tmp_path / "run").encode() + b"'\ntR.",
        b"(S'mkdir'\nios\nsystem\n.",
    ):
        refused(content)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "name",
    ["numpy\nload", "numpy\nfromfile", "numpy.core.multiarray\nfromfile", "builtins\ngetattr", "_codecs\nencode"],
)
def test_no_other_name_is_known_numpys_neither(name: str):
    refused(b"c" + name.encode() + b"\n.", "which is no part of an array")


@pytest.mark.parametrize(
    ("tree", "reason"),
    [
        ({"a": np.arange(3)}, "'i8' is none of floating-point numbers"),
        ({"a": np.array([None, {}], dtype=object)}, "'O8' is none of floating-point"),
        ({"a": np.zeros(2, "V9")}, "'V9' is none of floating-point"),
        ({"a": np.float32(3)}, "scalar, which is no part of an array"),
    ],
)
def test_other_types_of_numbers_are_refused(tree: Any, reason: str):
    refused(pickle.dumps(tree, 3), reason)


def test_an_array_that_claims_more_than_it_has_is_refused():
    content = pickle.dumps({"a": np.zeros(200, "<f4")}, 3)
    assert b"K\xc8\x85" in content  # BININT1 200, TUPLE1: the shape
    refused(content.replace(b"K\xc8\x85", b"J" + struct.pack("<i", 1 << 30) + b"\x85"), r"1073741824,\) has 800 bytes")
    refused(content.replace(b"K\xc8\x85", b"J" + struct.pack("<i", -8) + b"\x85"), "without shape")


def test_claims_of_memory_take_none():
    # A place in the memo that numbers 2^31 - 1, and a text of 2^62 bytes: both are claims of a few bytes.
    assert read_arrays(b"\x80\x02}r" + struct.pack("<I", (1 << 31) - 1) + b".", "w.ckpt") == {}
    refused(b"\x80\x04\x8e" + struct.pack("<Q", 1 << 62) + b"x.")


def test_a_tree_that_unfolds_without_end_is_refused():
    tree: dict[str, Any] = {}
    for _ in range(6):  # 12^6 paths out of a few hundred bytes
        tree = {str(i): tree for i in range(12)}
    refused(pickle.dumps(tree), "too many, or too deep")
    endless: dict[str, Any] = {}
    endless["a"] = endless
    refused(pickle.dumps(endless), "too many, or too deep")


def test_damage_anywhere_is_one_line():
    whole = pickle.dumps({"a": {"kernel": np.ones((2, 3), "<f4")}}, 3)
    for cut in range(len(whole)):
        refused(whole[:cut])
    generator = np.random.default_rng(0)
    refusals = 0
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[generator.integers(len(whole))] = generator.integers(256)
        with contextlib.suppress(UserInputError):
            refusals += 1
            read_arrays(bytes(damaged), "w.ckpt")
            refusals -= 1
    assert refusals > 100  # the others have other numbers or names
