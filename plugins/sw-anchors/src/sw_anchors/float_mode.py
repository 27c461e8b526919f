"""What a file is tied to whose decoder must get the very floats of its encoder: networks evaluated as trained.

The other way, exact integers (docs/bitstream.md), decodes anywhere; methods offer this one for comparison.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import torch

from splatwizard_core.api import BitstreamError

if TYPE_CHECKING:
    from splatwizard_core.api import ContainerReader


def this_machine() -> dict[str, str]:
    """Files are always encoded and decoded on the CPU."""
    return {"device": f"cpu {torch.backends.cpu.get_cpu_capability()}", "torch": str(torch.__version__)}


def is_device_bound(reader: ContainerReader) -> bool:
    """Whether a file decodes on the machine alone that made it."""
    return "made_on" in reader.static


def check_machine(reader: ContainerReader) -> None:
    """Raise BitstreamError if a file of mode `float` was made elsewhere."""
    theirs, ours = reader.static.get("made_on"), this_machine()
    if theirs != ours:
        shown = " with torch ".join(str(v)[:40] for v in theirs.values()) if isinstance(theirs, dict) else "unknown"
        raise BitstreamError(
            f"{reader.name}: mode 'float' decodes only where it was encoded ({shown}), this is {ours['device']} with "
            f"torch {ours['torch']}: encode with codec.mode=exact",
            section="header",
        )


@contextmanager
def one_thread() -> Iterator[None]:
    """Matrix products of floats may depend on the number of threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.no_grad():
            yield
    finally:
        torch.set_num_threads(threads)
