"""Checks of files with cuts: each cut ends a whole file, which decodes to what the first packets of the long one do."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from splatwizard_core.api import ContainerReader
from splatwizard_core.tooling import Prefix
from sw_kit.finding import hold

if TYPE_CHECKING:
    from splatwizard_core.api import SplatModel
    from splatwizard_core.tooling import Entry

FEWEST = 2
"""Packets of a file that its entry calls progressive."""


def check_no_cuts(data: bytes, entry: Entry) -> None:
    """Hold a file to having no cuts, where its entry declares no `prefixes`."""
    hold(
        not ContainerReader(data).cuts or "prefixes" in entry.declared,
        "its file has cuts, which its entry does not say",
        'registry.add(..., prefixes="KEY=VALUE"): the setting with which it has them, "" if always',
    )


def check_prefixes(data: bytes, decode: Callable[[ContainerReader], SplatModel]) -> str:
    """Hold a file with cuts to prefix exactness: at each cut it decodes, to the model of so many packets, to the bit.

    decode  the decoder of a file, made anew for each
    """
    whole = ContainerReader(data)
    packets = len(whole.cuts)
    hold(
        packets >= FEWEST,
        f"its file has {packets} cuts with the setting that its entry declares as `prefixes`",
        "writer.cut() after the sections of each packet",
    )
    counts: list[int] = []
    for number in range(1, packets + 1):
        part = ContainerReader(data, "first packets", Prefix(number))
        short = ContainerReader(data[: part.size], "cut file")
        models = [decode(short), decode(part)]
        short.finish()
        hold(
            models[0].digest() == models[1].digest(),
            f"a file that ends after packet {number} decodes to another model than packet 1 to {number} of the whole",
            "decode() looks at the packets that are there, `reader.packets`, and depends on nothing else",
        )
        hold(
            not models[0].check_finite(),
            f"of packet 1 to {number} alone some rows are not finite",
            "every prefix is a scene: it must be drawable",
        )
        counts.append(sum(models[0].counts().values()))
    hold(
        counts == sorted(counts),
        f"packets take away what earlier ones brought: {', '.join(map(str, counts))} rows",
        "a packet adds rows, or refines those that are there",
    )
    return f"{packets} prefixes of {counts[0]:,} to {counts[-1]:,} rows are exact"
