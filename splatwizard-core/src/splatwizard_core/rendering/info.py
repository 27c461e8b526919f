"""The declaration of a rasterizer in its registry entry, and the checks that hold a request against it."""

from __future__ import annotations

import functools
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from pydantic import TypeAdapter, ValidationError

from splatwizard_core.errors import CapabilityError, ConfigError, PluginError, ShapeError
from splatwizard_core.plugins.registry import Entry, Registry
from splatwizard_core.rendering.features import Feature

if TYPE_CHECKING:
    from splatwizard_core.gaussians.inputs import GaussianInputs, Layout
    from splatwizard_core.rendering.rasterizer import RasterOptions


@dataclass(frozen=True)
class DeviceInfo:
    """Differences of a rasterizer on one device: features it lacks there, another probe."""

    lacks: frozenset[str] = frozenset()
    available: str | None = None


@dataclass(frozen=True)
class RasterizerInfo:
    """Declaration of one rasterizer: where it runs, which features it offers, how exact and how fast it is.

    available       "module:function" of a cheap probe () -> str | None, the reason why it cannot run here;
                    it must not compile anything. None: always available
    exactness       "exact", "tight" (differs only by the classic clipping), "approx-fp16", "approx-uint8"
    speed           rank within a device, higher is faster; 0: an oracle, which serves where nothing else can
    min_cc          lowest CUDA compute capability
    needs           features that every request must hold: a rasterizer of surfels draws nothing else
    profiles        sets of constants and quirks that `RasterOptions.profile` may name
    kernels         name of the rasterizer whose kernels draw; empty: its own
    per_device      device -> what is different there; see `on`
    """

    name: str
    devices: frozenset[str] = frozenset({"cpu"})
    dtypes: frozenset[str] = frozenset({"float32"})
    features: frozenset[str] = frozenset()
    available: str | None = None
    combos_forbidden: tuple[frozenset[str], ...] = ()
    exactness: str = "exact"
    speed: int = 0
    min_cc: tuple[int, int] | None = None
    needs: frozenset[str] = frozenset()
    profiles: tuple[str, ...] = ()
    kernels: str = ""
    per_device: Mapping[str, DeviceInfo] = field(default_factory=dict)

    @classmethod
    def declared(cls, hook: Callable[[Registry], None], name: str) -> RasterizerInfo:
        """The declaration of one rasterizer in a plugin's `register_rasterizers`, for its class to show."""
        registry: Registry = Registry("rasterizer")
        hook(registry)
        return cls.from_entry(registry.entry(name))

    @classmethod
    def from_entry(cls, entry: Entry) -> RasterizerInfo:
        """The declaration in a registry entry. Raises PluginError for an unknown feature or a field of another kind."""
        whose = f"rasterizer '{entry.name}' of {entry.distribution}"
        try:
            info = _adapter().validate_python(
                {**entry.declared, "name": entry.name, "per_device": entry.declared.get("on", {})}
            )
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise PluginError(f"{whose} is declared wrongly: {where}: {first['msg']}") from error
        unknown = sorted(info.features - {f.name for f in Feature})
        if unknown:
            raise PluginError(f"{whose} declares unknown features {unknown}")
        return info

    @cached_property
    def _on(self) -> dict[str, RasterizerInfo]:
        return {
            device: replace(
                self, features=self.features - here.lacks, available=here.available or self.available, per_device={}
            )
            for device, here in self.per_device.items()
        }

    def on(self, device: str) -> RasterizerInfo:
        """The declaration for one kind of device ("cpu", "cuda")."""
        return self._on.get(device, self)

    def obstacle(self, device: torch.device | str) -> str | None:
        """The reason why it cannot run on `device`, as its own probe says, or None; compiles nothing.

        Raises what the probe raises.
        """
        device = torch.device(device)
        here = self.on(device.type)
        if here.min_cc is not None and device.type == "cuda":
            capability = torch.cuda.get_device_capability(device)
            if capability < here.min_cc:
                return f"it needs compute capability {here.min_cc}, this GPU has {capability}"
        if here.available is None:
            return None
        return pkgutil.resolve_name(here.available)()  # type: ignore[no-any-return]

    def check_request(self, g: GaussianInputs, opt: RasterOptions) -> None:
        """Hold a request to draw `g` with `opt` against the declaration; every rasterizer calls it first.

        Raises ShapeError for inputs that do not fit together, CapabilityError for a feature or a device, ConfigError
        for a profile or another option.
        """
        layout = g.validate()
        self.on(g.means.device.type).check_offered(Feature.asked_by(opt, g))
        if opt.profile and opt.profile not in self.profiles:
            raise ConfigError(
                f"rasterizer '{self.name}' knows no profile '{opt.profile}'; one of "
                f"{', '.join(self.profiles) or 'none'}",
                key="raster.profile",
            )
        if opt.clamp_grad not in ("exact", "pass"):
            raise ConfigError(f"clamp_grad is '{opt.clamp_grad}', must be 'exact' or 'pass'")
        self._check_placement(layout)

    def check_geometry(self, g: GaussianInputs) -> None:
        """Hold a request for `visible_filter` against the declaration: as `check_request`, of shapes alone."""
        layout = g.validate()
        self.on(g.means.device.type).check_offered(Feature.VISIBLE_FILTER | Feature.geometry_of(g))
        self._check_placement(layout)

    def check_offered(self, asked: Feature) -> None:
        """Raise CapabilityError unless everything in `asked` is declared, together and with what `needs` names."""
        wanted = asked.names
        missing = wanted - self.features
        if missing:
            raise CapabilityError(
                f"rasterizer '{self.name}' does not offer {', '.join(sorted(missing))}; "
                "`sw list-plugins` shows which one does",
                missing=missing,
            )
        if not self.needs <= wanted:
            raise CapabilityError(
                f"rasterizer '{self.name}' draws nothing without {', '.join(sorted(self.needs - wanted))}; "
                "`sw list-plugins` shows which one draws the rest",
                missing=frozenset(),
            )
        for combo in self.combos_forbidden:
            if combo <= wanted:
                raise CapabilityError(
                    f"rasterizer '{self.name}' does not offer {' and '.join(sorted(combo))} together", missing=combo
                )

    def _check_placement(self, layout: Layout) -> None:
        """All tensors share a kind of device and a dtype that are declared (GaussianInputs.validate: one device)."""
        _, _, first, device = layout[0]  # of means
        if device.type not in self.devices:
            raise CapabilityError(
                f"rasterizer '{self.name}' draws on {', '.join(sorted(self.devices))}, the Gaussians are on {device}",
                missing=(),
            )
        declared = _dtype_name(first) in self.dtypes
        for name, _, dtype, _ in layout:
            if dtype.is_floating_point and not (declared and dtype == first):
                raise ShapeError(
                    f"rasterizer '{self.name}' needs all tensors in one dtype of {', '.join(sorted(self.dtypes))}: "
                    f"{name} is {_dtype_name(dtype)}" + (f", means {_dtype_name(first)}" if name != "means" else "")
                )


@functools.cache
def _adapter() -> TypeAdapter[RasterizerInfo]:
    return TypeAdapter(RasterizerInfo)


@functools.cache
def _dtype_name(dtype: torch.dtype) -> str:
    """As declared: "float32", ..."""
    return str(dtype).removeprefix("torch.")
