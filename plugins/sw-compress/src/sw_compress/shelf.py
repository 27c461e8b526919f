"""Numbers in a file without a name, which is gone with the process, however that ends."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Place:
    """Start and shape of numbers on a shelf."""

    start: int
    shape: tuple[int, ...]


class Shelf:
    """Holds float32 tensors in a file beside a result.

    folder  that it lies in
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder, prefix=".sw-compress-")  # noqa: SIM115  # closed with the shelf
        self._end = 0

    @property
    def bytes(self) -> int:
        """All that was ever put there."""
        return self._end

    def put(self, values: Tensor) -> Place:
        """Write numbers at the end. Raises OSError where there is no room for them."""
        data = np.ascontiguousarray(values.detach().cpu().numpy(), np.float32)
        place = Place(self._end, tuple(values.shape))
        self._file.seek(self._end)
        self._file.write(data.data)
        self._end += data.nbytes
        return place

    def get(self, place: Place) -> Tensor:
        """Read them again."""
        found = np.empty(place.shape, np.float32)
        self._file.seek(place.start)
        if found.size and self._file.readinto(found.reshape(-1).view(np.uint8)) != found.nbytes:
            raise OSError("a temporary file is shorter than what was written to it")
        return torch.from_numpy(found)

    def close(self) -> None:
        """Give its room back."""
        self._file.close()
