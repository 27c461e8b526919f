"""Independent random streams from one seed: adding a draw to one never moves another."""

from __future__ import annotations

import hashlib

import torch


def stream(seed: int, name: str, device: torch.device | str = "cpu") -> torch.Generator:
    """Return a generator for the stream called `name` ("init", "sampler", "split", "background", "method", ...)."""
    digest = hashlib.sha256(f"{seed}/{name}".encode()).digest()
    return torch.Generator(device).manual_seed(int.from_bytes(digest[:8], "little") >> 1)


class Streams:
    """The generators of a stage by name, each made on first use; their states are part of a checkpoint.

    prefix  keeps the streams of a later stage apart from those of the first, which has ""
    """

    def __init__(self, seed: int, prefix: str = "") -> None:
        self.seed, self.prefix = seed, prefix
        self._made: dict[str, torch.Generator] = {}

    def __call__(self, name: str) -> torch.Generator:
        """Return the generator of this stream; the same object each time."""
        if name not in self._made:
            self._made[name] = stream(self.seed, self.prefix + name)
        return self._made[name]

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Stream name -> uint8 state."""
        return {name: generator.get_state() for name, generator in self._made.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Inverse of `state_dict`; generators that were handed out already are set in place."""
        for name, value in state.items():
            self(name).set_state(value)
