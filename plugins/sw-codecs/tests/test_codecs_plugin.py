"""Entries of the package can be listed without torch, loaded by name and constructed without arguments."""

import subprocess
import sys

import pytest

from splatwizard_core.plugins import load_plugins

NAMES = {
    "quantizers": {
        "uniform",
        "ste-round",
        "ste-binary",
        "ste-mask",
        "fake-quant",
        "vq",
        "residual-vq",
    },
    "entropy_models": {
        "columns",
        "categorical",
        "bernoulli",
        "gaussian-exact",
        "conditional-gaussian",
        "conditional-mixture",
    },
    "context_models": {"integer-mlp"},
    "coders": {
        "range",
        "rans",
        "huffman",
        "octree",
        "byte-planes",
        "float-delta",
        "packed-bits",
    },
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in NAMES.items() for name in sorted(names)])
def test_every_entry_loads_by_name(kind, name):
    made = getattr(load_plugins(), kind).load(name)
    methods = {"quantizers": ("forward", "encode", "decode"), "entropy_models": ("bits", "encode", "decode"),
               "context_models": ("__call__",), "coders": ("encode", "decode")}[kind]  # fmt: skip
    thing = made if kind == "context_models" else made()
    assert all(callable(getattr(thing, method)) for method in methods)


def test_listing_imports_neither_torch_nor_the_coding_library():
    code = "import sys, sw_codecs.plugin; print(sorted({'torch', 'constriction', 'numpy'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"
