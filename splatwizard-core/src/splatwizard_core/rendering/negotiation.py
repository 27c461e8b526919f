"""The choice of a rasterizer for each request: features that it needs, matched with those that each one declares."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, TypeVar

import torch
from torch import Tensor

from splatwizard_core.base.warned import warn_once
from splatwizard_core.errors import CapabilityError, ConfigError, PluginError
from splatwizard_core.gaussians.inputs import GaussianInputs
from splatwizard_core.plugins.catalogue import catalogue, package_of
from splatwizard_core.plugins.guards import one_line
from splatwizard_core.plugins.manager import PluginManager
from splatwizard_core.plugins.registry import Entry
from splatwizard_core.rendering.adapters import AdaptedRasterizer, adapted_requirements
from splatwizard_core.rendering.features import Feature
from splatwizard_core.rendering.info import RasterizerInfo
from splatwizard_core.rendering.rasterizer import AccumOutput, Rasterizer, RasterOptions, RenderResult
from splatwizard_core.rendering.result_checks import faults
from splatwizard_core.scene.camera import Camera
from splatwizard_native import ForeseenError, NativeBuildError

log = logging.getLogger(__name__)
T = TypeVar("T")
_PROFILE = "profile "  # before the name of a profile that is asked for like a feature


class NegotiatedRasterizer:
    """A rasterizer that finds, for each request, the one to delegate to.

    plugins     where rasterizers are registered
    device      where the tensors will be
    prefer      names to take first if they can serve, best first (the user's choice)
    forbid      names never to take; an alias stands for the rasterizer that it names, here and everywhere
    exactness   which kinds of result are acceptable from one that nobody prefers by name
    suggested   further names to prefer, after `prefer`, ignored where not installed (a method's or a file's own choice)
    options     values of RasterOptions that hold in place of each request's own (the user's choice)

    Order: preferred ones; then fast ones that serve directly; then fast ones behind an adapter; then those of speed
    0, the oracles. Within each, the higher speed. A rasterizer whose native module cannot be built is left out with
    one warning, and so is one whose entry cannot be read (it may know features of a newer core), unless it was asked
    for by name. One that is none of ours is taken only where it is preferred. SW_RASTERIZER=name (for debugging) takes
    that one or fails.
    Raises PluginError for a name that is not installed, ConfigError for a profile that none of them knows.
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
        options: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.device = torch.device(device)
        self.choices: dict[str, str] = {}
        """Request (feature names joined by "+", "plain" for none) -> the rasterizer that was chosen for it."""
        self.served: set[str] = set()
        """Names of the rasterizers that served a request; clear it to learn which ones serve from then on."""
        self._registry = plugins.rasterizers
        self._prefer = [self._registry.entry(name).name for name in prefer]
        self._wanted = tuple(self._prefer)
        self._prefer += [self._registry.entry(name).name for name in suggested if name in self._registry]
        self._forbid = {self._registry.entry(name).name for name in forbid}
        forced = os.environ.get("SW_RASTERIZER")
        self._forced = self._registry.entry(forced).name if forced else None
        self._exactness = frozenset(exactness)
        self._chosen: dict[frozenset[str], Rasterizer] = {}
        self._failed: dict[str, str] = {}
        self._readable = [info for entry in self._registry if (info := self._read(entry)) is not None]
        self._usable = [info for info in self._readable if self._may_serve(info)]
        self._options = dict(options)
        for info in self._readable:
            if info.name in self._wanted and self.device.type not in info.devices:
                warn_once(f"'{info.name}', which raster.prefer names, does not draw on {self.device.type}")
        self._check_profile(self._options.get("profile"))
        self.info = RasterizerInfo(
            name="negotiated",
            devices=frozenset({self.device.type}),
            dtypes=frozenset().union(*(i.dtypes for i in self._usable)),
            features=frozenset().union(*(i.features for i in self._usable)) & Feature.__members__.keys(),
            profiles=tuple(sorted({profile for i in self._usable for profile in i.profiles})),
        )

    @property
    def drawn_by(self) -> dict[str, str]:
        """Names in `served` -> the rasterizer whose kernels each one draws with."""
        return {name: self._registry.entry(name).declared.get("kernels") or name for name in sorted(self.served)}

    def decided(self, opt: RasterOptions) -> RasterOptions:
        """The options that are drawn with where `opt` is asked for: the user's values in place of its own."""
        return replace(opt, **self._options) if self._options else opt

    def render(self, g: GaussianInputs, cam: Camera, opt: RasterOptions) -> RenderResult:
        """Draw one view with the rasterizer that serves it best. Raises CapabilityError if none does."""
        opt, learns = self.decided(opt), torch.is_grad_enabled()
        result = self._delegate(Feature.asked_by(opt, g), lambda r: r.render(g, cam, opt), opt.profile)
        self._hold(faults(result, g, cam, opt, learns=learns) if self._strangers else ())
        return result

    def look(self, result: RenderResult) -> None:
        """Raise PluginError if a stranger's rasterizer served and the picture holds values that are not finite."""
        if self._strangers and not bool(result.image.isfinite().all()):
            self._hold(["its picture holds values that are not finite"])

    @property
    def _strangers(self) -> list[Entry]:
        return [entry for entry in self._registry if entry.foreign and entry.name in self.served]

    def _hold(self, found: Iterable[str]) -> None:
        for fault in found:
            whose = " or ".join(entry.whose for entry in self._strangers)
            raise PluginError(f"{whose} breaks its contract: {fault}; raster.prefer names another one")

    def visible_filter(self, g: GaussianInputs, cam: Camera) -> Tensor:
        """Radii [N] int32 from geometry alone; 0 = culled."""
        geometry = replace(g, sh=None, colors=g.means, features=None)  # any three numbers: colours are not looked at
        with torch.no_grad():
            asked = Feature.VISIBLE_FILTER | Feature.geometry_of(geometry)
            return self._delegate(asked, lambda r: r.visible_filter(geometry, cam))

    def accumulate(self, g: GaussianInputs, cams: Iterable[Camera], opt: RasterOptions) -> AccumOutput:
        """Sum the scores that `opt` asks for over several views; no gradient."""
        cams, opt = list(cams), self.decided(opt)  # a second attempt after a failed build must see the cameras again
        with torch.no_grad():
            return self._delegate(Feature.asked_by(opt, g), lambda r: r.accumulate(g, cams, opt), opt.profile)

    def select(self, required: Iterable[str]) -> Rasterizer:
        """The rasterizer for these features ("profile NAME" is one), loaded.

        Raises CapabilityError that names what is missing and who comes near.
        """
        wanted = frozenset(required)
        if wanted in self._chosen:
            return self._chosen[wanted]
        while True:
            best, passed_over = self._best(wanted)
            try:
                rasterizer = self._make(best.name)
                break
            except ForeseenError as error:
                self._fail(best.name, error)
        asked, composing = "+".join(sorted(wanted)) or "plain", ""
        if missing := wanted - best.features:
            rasterizer = AdaptedRasterizer(rasterizer, missing)
            composing = f", composing {', '.join(sorted(missing))}"
        if passed_over is not None:
            warn_once(f"{passed_over}; rendering with '{best.name}' instead")
        log.info("%s on %s: rasterizer '%s' (%s)%s", asked, self.device, best.name, best.exactness, composing)
        self.choices[asked] = best.name
        self._chosen[wanted] = rasterizer
        return rasterizer

    def _delegate(self, asked: Feature, call: Callable[[Rasterizer], T], profile: str = "") -> T:
        wanted = asked.names | {_PROFILE + profile} if profile else asked.names
        while True:
            rasterizer = self.select(wanted)
            try:
                result = call(rasterizer)
            except NativeBuildError as error:  # kernels may be built by the first call
                self._fail(rasterizer.info.name, error)
            else:
                self.served.add(rasterizer.info.name)
                return result

    def _make(self, name: str) -> Rasterizer:
        """Import and construct one; whatever a broken package raises becomes a PluginError."""
        entry = self._registry.entry(name)
        try:
            target = entry.load()
            with entry.held():
                made: Rasterizer = target()
            if entry.foreign and made.info.name != name:
                raise TypeError(f"its info.name is '{made.info.name}'")
        except ForeseenError:
            raise
        except (Exception, SystemExit) as error:
            raise PluginError(f"{entry.whose} cannot be made: {one_line(error)}") from error
        return made

    def _fail(self, name: str, error: Exception) -> None:
        if self._forced is not None:
            raise error
        module = self._registry.entry(name).declared.get("native", name)
        # Whoever shares the kernel module is spared the same attempt.
        failed = {e.name for e in self._registry if e.declared.get("native", e.name) == module}
        self._failed |= dict.fromkeys(failed, str(error))
        self._chosen = {k: r for k, r in self._chosen.items() if r.info.name not in failed}

    def _read(self, entry: Entry) -> RasterizerInfo | None:
        """The declaration for this device, profiles among its features; None, with a warning, if it makes no sense."""
        try:
            info = RasterizerInfo.from_entry(entry).on(self.device.type)
            return replace(info, features=info.features | {_PROFILE + name for name in info.profiles})
        except PluginError as error:
            if entry.name in (self._forced, *self._prefer):
                raise
            warn_once(f"{error}: it is not used")
            return None

    def _check_profile(self, name: str | None) -> None:
        known = {profile for info in self._readable for profile in info.profiles}
        if name and known and name not in known:  # with none installed, what to install is told at the first request
            raise ConfigError(
                f"no rasterizer knows the profile '{name}': raster.profile is one of {', '.join(sorted(known))}",
                key="raster.profile",
            )

    def _accepts(self, info: RasterizerInfo) -> bool:
        return info.exactness in self._exactness or info.name in self._prefer

    def _may_serve(self, info: RasterizerInfo) -> bool:
        """Whether device, the user's lists and the accepted exactness leave it."""
        if self._forced is not None:
            return info.name == self._forced
        is_barred = info.name in self._forbid or self._is_uninvited(info)
        return self.device.type in info.devices and not is_barred and self._accepts(info)

    def _is_uninvited(self, info: RasterizerInfo) -> bool:
        """Whether a stranger's rasterizer stands aside: how fast it says it is would take it into everybody's runs."""
        return info.name not in self._prefer and self._registry.entry(info.name).foreign

    def _best(self, wanted: frozenset[str]) -> tuple[RasterizerInfo, str | None]:
        """(the best that can run, why a better one cannot if the user should know)."""

        def rank(info: RasterizerInfo) -> tuple[int, bool, int, int, str]:
            preferred = len(self._prefer) - self._prefer.index(info.name) if info.name in self._prefer else 0
            return preferred, info.speed > 0, -len(wanted - info.features), info.speed, info.name

        passed_over: dict[str, str] = {}
        for info in sorted((i for i in self._usable if _can_serve(i, wanted)), key=rank, reverse=True):
            reason = self._unavailable(info)
            if reason is None:
                # A failed build is news, and so is what the user named; what cannot run here by nature only if a slow
                # oracle is all that remains.
                told = {*self._failed, *self._wanted}
                news = [w for name, w in passed_over.items() if name in told or info.speed <= 0]
                return info, news[0] if news else None
            passed_over[info.name] = reason
        raise self._nothing(wanted, passed_over)

    def _unavailable(self, info: RasterizerInfo) -> str | None:
        """The reason why it cannot run here, or None; compiles nothing."""
        if info.name in self._failed:
            return self._failed[info.name]
        try:
            return info.obstacle(self.device)
        except (Exception, SystemExit) as error:
            return f"its probe {info.available} failed: {type(error).__name__}: {error}"

    def _nothing(self, wanted: frozenset[str], unavailable: dict[str, str]) -> CapabilityError:
        """The error that says what comes near and what it lacks, or what to install."""
        if not self._readable:
            return CapabilityError(f"no rasterizer is installed: {_how_to_get_one()}", missing=wanted)

        def shortcomings(info: RasterizerInfo) -> str:
            lacks, needs = wanted - info.features, info.needs - wanted
            return (
                f"{info.name} ({'/'.join(sorted(info.devices))})"
                + (f" lacks {', '.join(sorted(lacks))}" if lacks else "")
                + (f" draws nothing without {', '.join(sorted(needs))}" if needs else "")
                + (" serves only where raster.prefer names it" if self._is_uninvited(info) else "")
                + "".join(f" has no {' with '.join(sorted(c))}" for c in info.combos_forbidden if c <= wanted)
                + (" is forbidden" if info.name in self._forbid else "")
                + ("" if self._accepts(info) else f" is {info.exactness}")
            )

        near = sorted(self._readable, key=lambda i: (len(wanted - i.features), -i.speed, i.name))[:3]
        message = f"no rasterizer offers {' + '.join(sorted(wanted)) or 'plain rendering'} on {self.device.type}"
        message += f"; nearest: {'; '.join(map(shortcomings, near))}"
        if unavailable:
            message += f". Not usable here: {'; '.join(f'{name}: {why}' for name, why in unavailable.items())}"
        return CapabilityError(message, missing=wanted - near[0].features)


def _can_serve(info: RasterizerInfo, wanted: frozenset[str]) -> bool:
    """Whether it draws what is wanted, itself or with what it lacks composed from other features."""
    needs = adapted_requirements(wanted, wanted - info.features)
    if needs is None or any(combo <= needs for combo in info.combos_forbidden):
        return False
    return info.needs <= needs <= info.features


def _how_to_get_one() -> str:
    packages = sorted({p for name in catalogue().get("rasterizer", ()) if (p := package_of("rasterizer", name))})
    if not packages:
        return "`sw list-plugins` shows whether one is broken or left out"
    return f"pip install {packages[0]}" if len(packages) == 1 else f"install one of {', '.join(packages)} with pip"
