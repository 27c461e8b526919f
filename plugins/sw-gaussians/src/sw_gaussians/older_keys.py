"""Translation of configuration keys up to 0.2, when all density controls shared one block."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from splatwizard_core.api import ConfigError
from sw_gaussians.density.choice import DensityChoice
from sw_gaussians.named_blocks import Moved

_SHARED = (
    "start", "stop", "interval", "grad_threshold", "percent_dense", "min_opacity", "reset_interval", "reset_opacity",
    "white_reset",
)  # fmt: skip
_ADAPTIVE = ("world_prune", "prune_screen_px", "absgrad", "revised_opacity")
_MCMC = (
    "cap", "start", "stop", "interval", "growth", "min_opacity", "noise", "opacity_weight", "scale_weight",
    "init_opacity", "init_scale",
)  # fmt: skip
_BUDGET = ("score", "cap", "growth", "opacity", "morton")
_ON = ("true", "1", "yes", "on")
_SWITCH = (*_ON, "false", "0", "no", "off")  # values of `mcmc.enabled`
_WAYS = ("threshold", "budget")  # values of `fast.densify`


def _settings(block: str, names: tuple[str, ...], *providers: str) -> dict[str, Moved]:
    return {f"{block}.{name}": Moved((f"density.settings.{name}",), None, providers) for name in names}


DENSIFY: Mapping[str, Moved] = {
    **_settings("densify", _SHARED, "adc", "budget"),
    **_settings("densify", _ADAPTIVE, "adc"),
    "densify.pause_after_reset": Moved((), 0),
}
"""Keys of the old block `densify`, which several methods had."""

OLDER: Mapping[str, Moved] = {
    **DENSIFY,
    **_settings("mcmc", _MCMC, "mcmc"),
    **_settings("fast", _BUDGET, "budget"),
    "fast.resolution": Moved(("pictures.schedule",)),
    "fast.resolution_start": Moved(("pictures.start",)),
    "fast.resolution_rounding": Moved(("pictures.rounding",)),
    "fast.resolution_hold": Moved((), False),
    "fast.sh_every": Moved((), 1),
    "fast.settle": Moved((), 1.0),
    "fast.veto_views": Moved((), 0),
    "fast.veto_pixels": Moved((), 5.0),
    "fast.late_prune": Moved((), False),
}


def translated(values: dict[str, Any], density: DensityChoice) -> dict[str, Any]:
    """Return values by dotted key, with the density control's name added that the older keys imply.

    density     as it stands without these values

    Raises ConfigError for what no control does any more.
    """
    chain, way = values.pop("mcmc.enabled", None), values.pop("fast.densify", None)
    sparse = values.get("sparse_adam")
    if sparse == "per_row":
        raise ConfigError(
            "sparse_adam=per_row is gone since 0.3: sparse_adam=true updates without bias correction, as published",
            key="sparse_adam",
        )
    if sparse in ("off", "none"):
        values["sparse_adam"] = sparse == "none"
    if chain is not None or way is not None:
        now = density.name
        for key, value, known in (("mcmc.enabled", chain, _SWITCH), ("fast.densify", way, _WAYS)):
            if value is not None and str(value).lower() not in known:
                raise ConfigError(f"bad value '{value}' for '{key}', which is density=NAME since 0.3", key=key)
        if str(chain).lower() in _ON:
            name = "mcmc"
        elif way is None:
            name = "adc" if now == "mcmc" else now
        else:
            name = "budget" if way == "budget" else "adc"
        values.setdefault("density.name", name)
        if {name, now} == {"adc", "budget"}:  # both had these keys in common
            kept = {key: density.settings[key] for key in _SHARED if key in density.settings}
            values = {**{f"density.settings.{key}": value for key, value in kept.items()}, **values}
    if values.get("fast.opacity") == "halve" and values.get("density.name", density.name) == "adc":
        raise ConfigError(
            "fast.opacity=halve is a setting of density=budget since 0.3: leave it out, or set density=budget",
            key="fast.opacity",
        )
    return values


def within(values: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return values by dotted key, translating density-control keys in a nested block of another method.

    prefix  of the block, such as "base."; a table that stands there whole is flattened, a name alone gets its key
    """
    found: dict[str, Any] = {}
    for key, value in values.items():
        if f"{key}." == prefix and isinstance(value, Mapping):
            found |= flattened(value, prefix)
        else:
            found[key] = value
    return {_today(key, prefix): value for key, value in found.items()}


def flattened(table: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the values of a table of tables by dotted key, each with the prefix before it."""
    found: dict[str, Any] = {}
    for name, value in table.items():
        found |= flattened(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {prefix + name: value}
    return found


def _today(key: str, prefix: str) -> str:
    if key == f"{prefix}density":
        return f"{key}.name"
    moved = DENSIFY.get(key.removeprefix(prefix)) if key.startswith(prefix) else None
    return f"{prefix}{moved.keys[0]}" if moved is not None and moved.keys else key
