"""The named random streams of a stage."""

from __future__ import annotations

import torch

from splatwizard_core.streams import stream


class Streams:
    """Independent generators by name, each made on first use; their states are part of a checkpoint.

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
