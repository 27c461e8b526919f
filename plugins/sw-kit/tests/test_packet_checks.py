"""The check of cuts can fail: on codecs whose prefixes are not exact."""

from __future__ import annotations

import pytest
import torch
from sw_kit.checks.coding import hold_cuts
from sw_kit.finding import BrokenContractError
from sw_kit.samples import some_gaussians

from splatwizard_core.api import (
    BitstreamError,
)
from splatwizard_core.tooling import load_plugins

PLUGINS = load_plugins()


class Halves:
    """A codec of Gaussians in two packets."""

    cuts = True

    def __init__(self, plugins):
        pass

    def encode(self, model, writer):
        table = torch.cat([each.detach().flatten(1) for each in model.parameters() if each.ndim > 1], 1).numpy()
        for number, rows in enumerate((table[: len(table) // 2], table[len(table) // 2 :])):
            writer.add_array(f"part{number}", rows)
            if self.cuts:
                writer.cut()

    def rows(self, reader):
        return sum(len(reader.array(name, dtype="f4")) for name in list(reader.sections))

    def decode(self, reader):
        found = some_gaussians()
        mask = torch.arange(found.num_rows) < self.rows(reader)
        return type(found)(**{name: each.detach()[mask] for name, each in found.named_parameters()})


class Undeclared(Halves):
    """It has cuts whatever its entry says."""


class Whole(Halves):
    """It has none."""

    cuts = False


class Peeping(Halves):
    """Its decoder makes something of the file's name."""

    def rows(self, reader):
        return super().rows(reader) - (reader.name == "cut file" and reader.packets < 2)


class Shrinking(Halves):
    """Its second packet takes away what the first one brought."""

    def rows(self, reader):
        return super().rows(reader) // reader.packets**2


class Careless(Halves):
    """It asks for the first section alone."""

    def rows(self, reader):
        return len(reader.array("part0", dtype="f4"))


@pytest.mark.parametrize(
    ("codec", "declared", "said"),
    [
        (Undeclared, {}, "file has cuts, which its entry does not say"),
        (Whole, {"prefixes": ""}, "has 0 cuts with the setting"),
        (Peeping, {"prefixes": ""}, "after packet 1 decodes to another model"),
        (Shrinking, {"prefixes": ""}, "packets take away"),
        (Careless, {"prefixes": ""}, "section 'part1': method 'check' knows no such section"),
    ],
)
def test_cuts_that_are_no_exact_prefixes_are_told(entry_of, codec, declared, said):
    entry = entry_of("coder", codec, codes="gaussians", **declared)
    with pytest.raises((BrokenContractError, BitstreamError), match=said):
        hold_cuts(entry, codec, PLUGINS)


def test_exact_prefixes_are_counted(entry_of):
    n = some_gaussians().num_rows
    told = hold_cuts(entry_of("coder", Halves, codes="gaussians", prefixes=""), Halves, PLUGINS)
    assert told == f"2 prefixes of {n // 2} to {n} rows are exact"
