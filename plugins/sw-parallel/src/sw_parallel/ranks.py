"""The processes of one training, and what they tell each other: sums and maxima of tensors, equal bits in all."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor

from splatwizard_core.api import SplatwizardError

PATIENCE = timedelta(minutes=30)
"""How long a process waits for another one, which may be evaluating or writing a checkpoint."""


@dataclass(frozen=True)
class Ranks:
    """One of the processes of a training.

    rank    0: the process of the run, which logs, evaluates and writes checkpoints
    count   processes of the training; 1: there are no others, and nothing is exchanged
    """

    rank: int = 0
    count: int = 1

    def add_up(self, tensors: Sequence[Tensor]) -> None:
        """Replace each tensor by its sum over all processes. Raises SplatwizardError if another one has ended.

        tensors     contiguous, of one dtype and device, of the same shapes in every process
        """
        self._reduce(tensors, dist.ReduceOp.SUM)

    def keep_largest(self, tensors: Sequence[Tensor]) -> None:
        """Replace each number by the largest one that a process has there; else as `add_up`."""
        self._reduce(tensors, dist.ReduceOp.MAX)

    def _reduce(self, tensors: Sequence[Tensor], operation: dist.ReduceOp.RedOpType) -> None:
        if self.count == 1 or not tensors:
            return
        group, options = dist.group.WORLD, dist.AllreduceCoalescedOptions()
        assert group is not None
        options.reduceOp = dist.ReduceOp(operation)
        try:  # one call for all: each of its own would cost the host, and the device, tens of microseconds
            group.allreduce_coalesced(list(tensors), options).wait()
        except RuntimeError as error:
            raise SplatwizardError(
                f"process {self.rank} of {self.count} of this training has lost another one, which tells why above"
            ) from error


@contextlib.contextmanager
def joined(ranks: Ranks, device: torch.device, meeting: Path) -> Iterator[Ranks]:
    """Meet the other processes, and part from them after the block: by NCCL on CUDA, else by Gloo.

    meeting     file through which they find each other, not there before
    """
    dist.init_process_group(
        "nccl" if device.type == "cuda" else "gloo",
        store=dist.FileStore(str(meeting), ranks.count),
        rank=ranks.rank,
        world_size=ranks.count,
        timeout=PATIENCE,
        device_id=torch.device("cuda", torch.cuda.current_device()) if device.type == "cuda" else None,
    )
    try:
        ranks.add_up([torch.zeros(1, device=device)])  # opens the connections
        yield ranks
    except BaseException:
        give_up()  # else the end would wait for sums that the others never make
        with contextlib.suppress(Exception):  # of what was given up; the first error is the one to tell
            dist.destroy_process_group()
        raise
    else:
        dist.destroy_process_group()


def give_up() -> None:
    """End all exchange of this process at once; what waits for it raises."""
    with contextlib.suppress(Exception):  # Gloo has no `abort`: it notices by itself that a process is gone
        assert dist.group.WORLD is not None
        dist.group.WORLD.abort()
