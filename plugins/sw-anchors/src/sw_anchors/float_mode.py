"""Coder mode `float`: networks are evaluated in float, so a file decodes only on the same kind of machine.

Encoder and decoder must get the very same floats. The other mode, `exact`, evaluates the networks in integers and
decodes anywhere (docs/bitstream.md); methods offer `float` for comparison with published sizes.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Literal

import torch

from splatwizard_core.api import BitstreamError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader, ContainerWriter

Mode = Literal["exact", "float"]
MODES: tuple[Mode, ...] = ("exact", "float")


def this_machine() -> dict[str, str]:
    """CPU capability and torch version, on which floats of a network depend; files are coded on the CPU."""
    return {"device": f"cpu {torch.backends.cpu.get_cpu_capability()}", "torch": str(torch.__version__)}


def add_machine(writer: ContainerWriter, mode: Mode) -> None:
    """Note in the header (`made_on`) which machine a file of mode `float` is bound to."""
    if mode == "float":
        writer.static["made_on"] = this_machine()


def read_mode(reader: ContainerReader) -> Mode:
    """The header value `mode`. Raises BitstreamError if it is unknown, or `float` and the file was made elsewhere."""
    if reader.text("mode", choices=MODES) == "exact":
        return "exact"
    theirs, ours = reader.static.get("made_on"), this_machine()
    if theirs != ours:
        shown = " with torch ".join(str(v)[:40] for v in theirs.values()) if isinstance(theirs, dict) else "unknown"
        raise BitstreamError(
            f"{reader.name}: mode 'float' decodes only where it was encoded ({shown}), this is {ours['device']} with "
            f"torch {ours['torch']}: encode with codec.settings.mode=exact",
            section="header",
        )
    return "float"


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute a block without gradients in one thread: products of float matrices may depend on their number."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)
