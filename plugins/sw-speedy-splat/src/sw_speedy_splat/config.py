"""Hyper-parameters of Speedy-Splat: when and how much it prunes. All the rest is 3DGS', under `base`."""

from collections.abc import Mapping
from typing import Any, ClassVar

from pydantic import Field
from sw_gaussians.choices import Choosing, CodecChoice, Moved, PrunerChoice
from sw_gaussians.older_keys import within
from sw_gaussians.sized import FILLING, CappedBase


class Prune(PrunerChoice):
    """Removals while the scene densifies ("soft": it grows back) and after that ("hard": it does not)."""

    pruner: str = Field("speedy-splat", description="whose scores; any registered pruner")
    soft: float = Field(0.80, ge=0, lt=1, description="share that goes each time before `base.density.settings.stop`")
    hard: float = Field(0.30, ge=0, lt=1, description="share that goes each time from `base.density.settings.stop` on")
    start: int = Field(6_000, ge=1, description="first removal")
    stop: int = Field(30_000, ge=0, description="no removal from this step on, nor at the last step of a run")
    interval: int = Field(3_000, ge=1, description="steps between removals")


class SpeedySplatConfig(CappedBase, Choosing):
    """Everything that can be set for Speedy-Splat."""

    FILLED_BY: ClassVar[str] = FILLING
    OLDER: ClassVar[Mapping[str, Moved]] = {
        "codec": Moved(("codec.name",)),
        "prune.channel_mode": Moved(("prune.settings.channel_mode",), "sum", "speedy-splat"),
    }

    prune: Prune = Field(Prune(), description="what is removed when")
    base: dict[str, Any] = Field(
        {},
        description="values of 3dgs by its keys (base.density.settings.start=600), its preset (base.preset=inria)",
    )
    codec: CodecChoice = Field(CodecChoice(name="gaussians-exact"), description="what writes the file")

    def translated(self, values: dict[str, Any]) -> dict[str, Any]:
        return within(values, "base.")
