"""Which rasterizer serves a request: read off what is asked for, matched with what each one declares."""

from __future__ import annotations

import functools
import importlib
import logging
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from splatwizard_core.errors import CapabilityError, NativeBuildError, PluginError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.plugins.registry import Entry, Registry
from splatwizard_core.rendering.adapters import AdaptedRasterizer, adapted_requirements
from splatwizard_core.rendering.rasterizer import (
    AccumOutput,
    DeviceInfo,
    Feature,
    Rasterizer,
    RasterizerInfo,
    RasterOptions,
    RenderResult,
    feature_names,
    required_features,
)
from splatwizard_core.scene.camera import Camera

log = logging.getLogger(__name__)
T = TypeVar("T")


def declared_info(hook: Callable[[Registry], None], name: str) -> RasterizerInfo:
    """What a plugin's `register_rasterizers` declares of one rasterizer, for the class itself to show."""
    registry = Registry("rasterizer")
    hook(registry)
    return info_from_entry(registry.entry(name))


def info_from_entry(entry: Entry) -> RasterizerInfo:
    """What a registry entry declares. Raises PluginError for an unknown feature or a field of another kind."""
    declared = entry.declared
    features = frozenset(declared.get("features", ()))
    unknown = sorted(features - {f.name for f in Feature})
    per_device = declared.get("on", {})
    if unknown:
        raise PluginError(f"rasterizer '{entry.name}' of {entry.distribution} declares unknown features {unknown}")
    min_cc = declared.get("min_cc")
    try:
        return RasterizerInfo(
            name=entry.name,
            devices=frozenset(declared.get("devices", ("cpu",))),
            dtypes=frozenset(declared.get("dtypes", ("float32",))),
            features=features,
            available=declared.get("available"),
            combos_forbidden=tuple(frozenset(combo) for combo in declared.get("combos_forbidden", ())),
            exactness=declared.get("exactness", "exact"),
            speed=int(declared.get("speed", 0)),
            min_cc=None if min_cc is None else (int(min_cc[0]), int(min_cc[1])),
            needs=frozenset(declared.get("needs", ())),
            per_device={
                device: DeviceInfo(frozenset(there.get("lacks", ())), there.get("available"), there.get("speed"))
                for device, there in per_device.items()
            },
        )
    except (TypeError, ValueError, IndexError, AttributeError) as error:
        raise PluginError(f"rasterizer '{entry.name}' of {entry.distribution} is declared wrongly: {error}") from error


def obstacle(info: RasterizerInfo, device: torch.device) -> str | None:
    """Why a rasterizer cannot run on `device`, as its own probe says, or None; compiles nothing.

    Raises what the probe raises.
    """
    if info.min_cc is not None and device.type == "cuda":
        capability = torch.cuda.get_device_capability(device)
        if capability < info.min_cc:
            return f"it needs compute capability {info.min_cc}, this GPU has {capability}"
    if info.available is None:
        return None
    module, _, function = info.available.partition(":")
    probe: Callable[[], str | None] = getattr(importlib.import_module(module), function)
    return probe()


def why_not(entry: Entry, device: torch.device | str) -> str | None:
    """Why the rasterizer of a registry entry cannot run on `device`, or None; compiles nothing.

    Raises PluginError for an entry that makes no sense, and what the rasterizer's own probe raises.
    """
    device = torch.device(device)
    return obstacle(info_from_entry(entry).on(device.type), device)


@dataclass(frozen=True)
class _Candidate:
    """A rasterizer that can serve a request if `adapted` features are composed for it."""

    entry: Entry
    info: RasterizerInfo
    adapted: frozenset[str]
    rank: tuple[int, ...]


class NegotiatedRasterizer:
    """A rasterizer that finds, for each request, the one to delegate to.

    plugins     where rasterizers are registered
    device      where the tensors will be
    prefer      names to take first if they can serve, best first (the user's choice)
    forbid      names never to take
    exactness   which kinds of result are acceptable from one that nobody prefers by name
    suggested   further names to prefer, after `prefer`, ignored where not installed (a method's or a file's own choice)

    Order: preferred ones; then fast ones that serve directly; then fast ones behind an adapter; then those of speed
    0, the oracle. Within each, the higher speed. A rasterizer whose native module cannot be built is left out with
    one warning, and so is one whose entry cannot be read (it may know features of a newer core), unless it was asked
    for by name. SW_RASTERIZER=name (for debugging) takes that one or fails.
    Raises PluginError for a name that is not installed.
    """

    def __init__(
        self,
        plugins: PluginManager,
        *,
        device: torch.device | str,
        prefer: Iterable[str] = (),
        forbid: Iterable[str] = (),
        exactness: Iterable[str] = ("exact", "tight"),
        suggested: Iterable[str] = (),
    ) -> None:
        self.device = torch.device(device)
        self.choices: dict[str, str] = {}
        """What was asked for (feature names joined by "+", "plain" for none) -> who served it."""
        self.served: set[str] = set()
        """Names of those that did something since somebody cleared this."""
        self._registry = plugins.registries["rasterizer"]
        self._prefer = [self._registry.entry(name).name for name in prefer]
        self._prefer += [name for name in suggested if name in self._registry and name not in self._prefer]
        self._forbid = {self._registry.entry(name).name for name in forbid}
        self._forced = os.environ.get("SW_RASTERIZER") or None
        if self._forced is not None:
            self._registry.entry(self._forced)
        self._exactness = frozenset(exactness)
        self._chosen: dict[frozenset[str], Rasterizer] = {}
        self._failed: dict[str, str] = {}
        self._readable = self._read_entries()
        infos = [info for _, info in self._installed()]
        self.info = RasterizerInfo(
            name="negotiated",
            devices=frozenset({self.device.type}),
            dtypes=frozenset().union(*(i.dtypes for i in infos)),
            features=frozenset().union(*(i.features for i in infos)),
        )

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view with whatever serves it best. Raises CapabilityError if nothing does."""
        return self._delegate(required_features(g, opt), lambda r: r.render(g, cam, opt))

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from geometry alone; 0 = culled."""
        geometry = replace(g, sh=None, colors=g.means, features=None)  # any three numbers: colours are not looked at
        with torch.no_grad():
            required = required_features(geometry, RasterOptions()) | Feature.VISIBLE_FILTER
            return self._delegate(required, lambda r: r.visible_filter(geometry, cam))

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum the scores that `opt` asks for over several views; no gradient."""
        cams = list(cams)  # a second attempt after a failed build must see them again
        with torch.no_grad():
            return self._delegate(required_features(g, opt), lambda r: r.accumulate(g, cams, opt))

    def select(self, required: Iterable[str]) -> Rasterizer:
        """The rasterizer for these features, loaded.

        Raises CapabilityError that names what is missing and who comes near.
        """
        wanted = frozenset(required)
        if wanted in self._chosen:
            return self._chosen[wanted]
        while True:
            best, passed_over = self._best(wanted)
            try:
                rasterizer: Rasterizer = best.entry.load()()
            except (NativeBuildError, PluginError) as error:
                self._fail(best.entry.name, error)
                continue
            break
        if best.adapted:
            rasterizer = AdaptedRasterizer(rasterizer, best.adapted)
        if passed_over is not None:
            _warn_once(f"{passed_over}; rendering with '{best.entry.name}' instead")
        asked = "+".join(sorted(wanted)) or "plain"
        adapted = f", composing {', '.join(sorted(best.adapted))}" if best.adapted else ""
        log.info("%s on %s: rasterizer '%s' (%s)%s", asked, self.device, best.entry.name, best.info.exactness, adapted)
        self.choices[asked] = best.entry.name
        self._chosen[wanted] = rasterizer
        return rasterizer

    def _delegate(self, required: Feature, call: Callable[[Rasterizer], T]) -> T:
        wanted = feature_names(required)
        while True:
            rasterizer = self.select(wanted)
            try:
                result = call(rasterizer)
            except NativeBuildError as error:  # kernels may be built by the first call
                self._fail(rasterizer.info.name, error)
            else:
                self.served.add(rasterizer.info.name)
                return result

    def _fail(self, name: str, error: Exception) -> None:
        if self._forced is not None:
            raise error
        module = self._registry.entry(name).declared.get("native", name)
        # Whoever shares the kernel module is spared the same attempt.
        failed = {e.name for e in self._registry if e.declared.get("native", e.name) == module}
        self._failed |= dict.fromkeys(failed, str(error))
        self._chosen = {k: r for k, r in self._chosen.items() if r.info.name not in failed}

    def _read_entries(self) -> list[tuple[Entry, RasterizerInfo]]:
        """Every registered rasterizer whose entry makes sense."""
        found = []
        for entry in self._registry:
            try:
                found.append((entry, info_from_entry(entry)))
            except PluginError as error:
                if entry.name in (self._forced, *self._prefer):
                    raise
                _warn_once(f"{error}: it is not used")
        return found

    def _installed(self) -> list[tuple[Entry, RasterizerInfo]]:
        """What this device, the user's lists and the accepted exactness leave."""
        if self._forced is not None:
            return [(entry, info.on(self.device.type)) for entry, info in self._readable if entry.name == self._forced]
        return [
            (entry, info.on(self.device.type))
            for entry, info in self._readable
            if self.device.type in info.devices
            and entry.name not in self._forbid
            and (info.exactness in self._exactness or entry.name in self._prefer)
        ]

    def _best(self, wanted: frozenset[str]) -> tuple[_Candidate, str | None]:
        """(the best that can run, why a better one cannot if the user should know)."""
        candidates = [c for pair in self._installed() if (c := self._candidate(*pair, wanted)) is not None]
        passed_over: list[tuple[str, str]] = []
        for candidate in sorted(candidates, key=lambda c: (c.rank, c.entry.name), reverse=True):
            reason = self._unavailable(candidate)
            if reason is None:
                # A failed build is news; what cannot run here by nature only if the slow oracle is all that remains.
                news = [why for name, why in passed_over if name in self._failed or candidate.info.speed <= 0]
                return candidate, news[0] if news else None
            passed_over.append((candidate.entry.name, reason))
        raise self._nothing(wanted, passed_over)

    def _candidate(self, entry: Entry, info: RasterizerInfo, wanted: frozenset[str]) -> _Candidate | None:
        missing = wanted - info.features
        needs = adapted_requirements(wanted, missing) if missing else wanted
        if needs is None or not needs <= info.features:
            return None
        if not info.needs <= needs or any(combo <= needs for combo in info.combos_forbidden):
            return None
        preferred = len(self._prefer) - self._prefer.index(entry.name) if entry.name in self._prefer else 0
        fast = info.speed > 0
        return _Candidate(entry, info, missing, (preferred, int(fast), -len(missing), info.speed))

    def _unavailable(self, candidate: _Candidate) -> str | None:
        """Why it cannot run here, or None; compiles nothing."""
        if candidate.entry.name in self._failed:
            return self._failed[candidate.entry.name]
        try:
            return obstacle(candidate.info, self.device)
        except Exception as error:
            return f"its probe {candidate.info.available} failed: {type(error).__name__}: {error}"

    def _nothing(self, wanted: frozenset[str], unavailable: list[tuple[str, str]]) -> CapabilityError:
        asked = " + ".join(sorted(wanted)) or "plain rendering"
        message = f"no rasterizer offers {asked} on {self.device.type}"
        infos = [i.on(self.device.type) if self.device.type in i.devices else i for _, i in self._readable]
        near = sorted(infos, key=lambda i: (len(wanted - i.features), -i.speed, i.name))[:3]
        lacks = [
            f"{i.name} ({'/'.join(sorted(i.devices))})"
            + (f" lacks {', '.join(sorted(wanted - i.features))}" if wanted - i.features else "")
            + (f" draws nothing without {', '.join(sorted(i.needs - wanted))}" if i.needs - wanted else "")
            + (" is forbidden" if i.name in self._forbid else "")
            + (f" is {i.exactness}" if i.exactness not in self._exactness and i.name not in self._prefer else "")
            for i in near
        ]
        reasons = [f"{name}: {reason}" for name, reason in unavailable]
        message += f"; nearest: {'; '.join(lacks) or 'none is installed'}"
        if reasons:
            message += f". Not usable here: {'; '.join(reasons)}"
        missing = min((wanted - i.features for i in infos), key=len, default=wanted)
        return CapabilityError(message, missing=missing)


@functools.cache
def _warn_once(message: str) -> None:
    """Once per process: several rasterizers may share one kernel module."""
    log.warning("%s", message)
