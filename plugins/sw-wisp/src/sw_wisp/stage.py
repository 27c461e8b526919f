"""The training stage: from a trained scene to integers, with the bits of the whole file in the loss."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from sw_gaussians.density.mcmc import pixels_of
from sw_gaussians.removal import removal_costs
from torch import Tensor

from splatwizard_core.api import (
    CameraIterator,
    ContainerWriter,
    EmptyModel,
    GaussianModel,
    LossPack,
    OptimizationParams,
    ParamGroup,
    PipelineParams,
    Rasterizer,
    RenderResult,
    Scene,
    Scheduler,
    SplatModel,
    SplatOptimizer,
    Stage,
    StageContext,
    TaskLog,
    View,
    photometric_loss,
    stream,
)
from sw_wisp.config import WispConfig
from sw_wisp.conversion import converted
from sw_wisp.cube import Cube
from sw_wisp.fast.replay import release
from sw_wisp.file import encode
from sw_wisp.layers import Layers, split
from sw_wisp.model import WispModel
from sw_wisp.numbers import GROUPS, LATENTS
from sw_wisp.positions import MARGIN, levels_by_cost, middle_scales
from sw_wisp.prefixes import chosen_order, fitted_swell, packet_bits, psnr_of_prefixes
from sw_wisp.removal import copy_some, unworthy
from sw_wisp.rounding import FINAL, HARD, NOISE, SOFT
from sw_wisp.worth import loss_of_error, slopes, worth

NETWORKS = ("network", "rate")
NETWORK_EPS = 1e-8
FITS = 2
"""Times that the networks are fitted before the first bits are counted, each to what the one before left."""
SENSITIVE_VIEWS = 64
"""Most views that squared slopes are measured over inside a training."""


class WispStage(Stage):
    """Trains a WispModel out of a trained 3DGS scene.

    1. SETTLE   the scene as 22 numbers a splat
    2. NOISE    uniform noise in place of rounding; lambda rises; splats that cost more than they are worth go
    3. PLACE    positions become cell centres
    4. ROUND    noise becomes soft rounding, soft rounding hard rounding
    5. FREEZE   the integers are fixed; the appearance network learns on

    With `layers.progressive` splats get subsets, some steps draw the first packets alone from then on. The order of
    packets is chosen then, and for good before FREEZE.
    """

    name = "wisp"
    starts_from = "3dgs"
    leading: Any = None  # task `lead-to-size` of a training to a size, by whose `factor` bits cost more

    def __init__(self, opt: WispConfig) -> None:
        super().__init__(opt)
        self.config = opt
        self._pixels = 1.0  # of all training pictures over 100

    # Bounds of this run

    def step_of(self, step: int) -> int:
        """Scale a step of the full run to this run."""
        found = self.when(step)
        assert isinstance(found, int)
        return found

    @property
    def removals(self) -> range:
        """Steps of this run that remove splats."""
        prune = self.config.prune
        found = self.when(range(prune.start, prune.stop, prune.every) if prune.rd else range(0))
        assert isinstance(found, range)
        return found

    def price(self, step: int | None = None) -> float:
        """Loss of one bit at a step of this run; None: once lambda has risen."""
        rate = self.config.rate_term
        full = rate.lambda_ / self._pixels * (1.0 if self.leading is None else self.leading.factor)
        if step is None:
            return full
        start, ramp = self.step_of(rate.start), self.step_of(rate.ramp)
        return full * min(max((step - start) / ramp, 0.0), 1.0)

    # Set-up

    def begin(self, context: StageContext) -> SplatModel:
        model, scene = context.model, context.scene
        self._rasterizer = context.rasterizer
        views = scene.train
        self._pixels = priced_pixels(views)
        if not isinstance(model, GaussianModel):
            raise TypeError(f"wisp starts from explicit Gaussians, not from a {type(model).__name__}")
        background = scene.background.to(model.device)
        found = converted(model, views, context.rasterizer, background, self.config, context.generator("method"))
        found.split_seed = context.generator("split").initial_seed()
        self.tidy(found)
        with still(found):  # a step that is replayed leaves its gradients at the parameters, for the optimizer
            self.set_levels(found, views, context.rasterizer, background, "begin")
            if self.config.appearance.steps == "sensitivity":
                self.set_latent_steps(found, views, context.rasterizer, background)
        found.begin_rate()
        return found

    def create_optimizer(self, model: SplatModel, scene: Scene) -> SplatOptimizer:
        assert isinstance(model, WispModel)
        rates = self.rates(0, scene.extent)
        eps = dict.fromkeys(NETWORKS, NETWORK_EPS)
        if not list(model.rate.parameters()):
            del rates["rate"]
        return SplatOptimizer(model, [ParamGroup(name, rate, eps.get(name, 1e-15)) for name, rate in rates.items()])

    def rates(self, step: int, extent: float) -> dict[str, float]:
        """Learning rate of each parameter group at a step of this run; means: world units."""
        lr, share = self.config.lr, min(step / max(self.iterations, 1), 1.0)
        plans = {
            "means": lr.means, "opacity": lr.opacity, "shape": lr.shape, "size": lr.shape, "colour": lr.colour,
            "latents": lr.latents, "network": lr.networks, "rate": lr.networks,
        }  # fmt: skip
        rates = {k: math.exp((1 - share) * math.log(p.first) + share * math.log(p.last)) for k, p in plans.items()}
        rates["means"] *= extent
        if step >= self.step_of(self.config.phases.place):
            rates["means"] = 0.0
        if step >= self.step_of(self.config.phases.freeze):
            rates |= dict.fromkeys((*WispModel.NUMBERS, "rate"), 0.0)
        return rates

    # Schedule

    def register_pre_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        phases, rebuild = self.config.phases, self.config.context.rebuild
        scheduler.register_task(range(self.iterations + 1), self.update_lr, name="update lr")
        scheduler.register_task(range(self.iterations + 1), self.count_bits, name="count bits")
        scheduler.register_task(self.when(phases.noise), self.begin_noise, name="begin noise")
        rate = self.config.rate_term
        if self.adaptive:
            scheduler.register_task(self.when(rate.start + rate.ramp), self.adapt, name="steps follow the networks")
        scheduler.register_task(self.when(list(phases.levels)), self.fix_levels, name="fix levels")
        scheduler.register_task(self.when(phases.cells), self.begin_jitter, name="draw positions anywhere in cells")
        if self.config.layers.progressive:
            scheduler.register_task(self.when(phases.subsets), self.form_subsets, name="form subsets")
        scheduler.register_task(self.when(phases.place), self.place, name="place splats in cells")
        soft = self.when(range(phases.soft, phases.hard))
        scheduler.register_task(soft, self.soften, name="soft rounding")
        scheduler.register_task(self.when(phases.soft), self.round_networks, name="eight bits in networks")
        scheduler.register_task(self.when(phases.hard), self.harden, name="hard rounding")
        for measured in (
            range(phases.noise + rebuild, phases.hard, rebuild),
            range(phases.hard, phases.freeze, max(rebuild // 2, 1)),
        ):
            scheduler.register_task(self.when(measured), self.measure, name="measure rate model")
        if self.config.layers.progressive:
            first = min(max(phases.subsets, phases.prefixes), phases.order)  # so that steps draw prefixes of a file
            ordered = self.when(sorted({first, phases.order}))
            scheduler.register_task(ordered, self.order_packets, name="order packets")
        scheduler.register_task(self.when(phases.freeze), self.freeze, name="fix integers")
        if self.config.layers.progressive and self.config.layers.train:
            if self.config.layers.swell and self.config.layers.every:
                fits = self.when(range(phases.prefixes, phases.freeze, self.config.layers.every))
                scheduler.register_task(fits, self.fit_swell, name="swell subsets")
            drawn = self.when(range(phases.prefixes, self.config.FULL_ITERATIONS + 1))
            scheduler.register_task(drawn, self.draw_prefix, name="draw some packets alone")

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        if self.config.prune.rd:
            scheduler.register_task(self.removals, self.prune, name="remove by rate and distortion")

    def update_lr(self, optimizer: SplatOptimizer, scene: Scene, step: int) -> None:
        """Set the step sizes."""
        for name, rate in self.rates(step, scene.extent).items():
            if name in optimizer.groups:
                optimizer.set_lr(name, rate)

    def count_bits(self, model: WispModel, step: int) -> None:
        """Let the bits of some splats be counted at a step where they have a price."""
        priced = self.price(step) > 0 and step < self.step_of(self.config.phases.freeze)
        model.counted = self.config.rate_term.sample if priced else 0.0
        model.packets = None

    def draw_prefix(self, model: WispModel) -> None:
        """Draw some of the packets alone at this step, or all."""
        if len(model.layers.order) > 1 and float(torch.rand(())) < self.config.layers.train:
            model.packets = int(torch.randint(1, len(model.layers.order), ()))
            model.counted = 0.0  # bits are counted when all is drawn

    def order_packets(
        self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene, log: TaskLog
    ) -> None:
        """Choose the order of packets by what each is worth to some training views."""
        views = some_views(cameras, stream(model.split_seed, "order"))[: self.config.layers.views]
        self.measure(model)
        with still(model):
            order = chosen_order(model, views, rasterizer, scene.background.to(model.device))
        model.layers = replace(model.layers, order=order)
        self.measure(model)
        log.say("packets: " + " ".join(f"{subset + 1}{kind[0]}" for subset, kind in order))

    def begin_noise(self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene) -> None:
        """Draw numbers with uniform noise from here on; the rate model learns what they are like as they stand."""
        model.begin_rate()
        model.phase = NOISE
        self.fit(model, cameras, rasterizer, scene.background.to(model.device), "noise")

    def adapt(self, model: WispModel) -> None:
        """Let gradients move the steps, now that bits have their full price."""
        model.adapt()

    def begin_jitter(self, model: WispModel) -> None:
        """Draw positions anywhere in a cell around them from here on."""
        model.jitters = True

    def soften(self, model: WispModel, step: int) -> None:
        """Draw numbers softly rounded, more sharply with each step."""
        phases = self.config.phases
        first, last = self.step_of(phases.soft), self.step_of(phases.hard)
        model.phase = SOFT
        model.sharpness = 1 + (phases.sharpness - 1) * (step - first) / max(last - 1 - first, 1)

    def round_networks(self, model: WispModel) -> None:
        """Compute with the networks of the file from here on."""
        model.network.rounds = True
        model.rate.round_weights()

    def harden(self, model: WispModel) -> None:
        """Draw rounded numbers from here on."""
        model.phase = HARD

    def measure(self, model: WispModel) -> None:
        """Bring the rate model up to date."""
        model.measure()

    def fix_levels(
        self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene, step: int
    ) -> None:
        """Set the level of every splat by the rule."""
        with still(model):
            self.set_levels(model, cameras, rasterizer, scene.background.to(model.device), str(step))
        self.measure(model)

    def place(self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene, step: int) -> None:
        """Put every splat at the centre of its cell for good."""
        self.tidy(model)
        model.cube = Cube.around(model.means)
        with still(model):
            self.set_levels(model, cameras, rasterizer, scene.background.to(model.device), str(step))
        model.levels, cells = model.cube.settled(model.means, model.levels, model.opacity)
        model.means.copy_(model.cube.centres(model.levels, cells))
        model.jitters = False
        self.measure(model)
        self.fit(model, cameras, rasterizer, scene.background.to(model.device), "place")

    def freeze(self, model: WispModel, optimizer: SplatOptimizer, log: TaskLog) -> None:
        """Fix all integers as an encoder does; splats take the order of the file, which decides at equal depths."""
        self.measure(model)
        encoded = encode(model.coded(), ContainerWriter("wisp", 1))
        optimizer.keep_rows(model, torch.from_numpy(encoded.rows).to(model.device))
        model.set_numbers(encoded.decoded.values().to(model.device))
        model.phase = FINAL
        self.measure(model)
        with still(model):
            bits = model.bits().mean(0)
        parts = {"place": model.place_bits().mean()} | {group.name: bits[group.columns].sum() for group in GROUPS}
        told = ", ".join(f"{name} {part.item():.1f}" for name, part in parts.items())
        log.say(f"{model.num_rows:,} splats; bits of each: {told}")

    def prune(
        self, model: WispModel, optimizer: SplatOptimizer, cameras: CameraIterator, rasterizer: Rasterizer,
        scene: Scene, step: int, log: TaskLog,
    ) -> None:  # fmt: skip
        """Remove what costs more bits than it is worth, and copy others in place of some."""
        if step >= self.iterations:
            return
        before, prune = model.num_rows, self.config.prune
        background = scene.background.to(model.device)
        with still(model):
            found = worth(model, cameras, rasterizer, background, lambda_dssim=self.config.loss.lambda_dssim)
            bits = model.bits().sum(1) + model.place_bits()
        doomed = unworthy(found.loss_rise, bits, self.price(), prune.share)
        if len(doomed) == before:
            raise EmptyModel(step)
        kept = torch.ones(before, dtype=torch.bool, device=model.device)
        kept[doomed] = False
        optimizer.keep_rows(model, kept)
        copies = int(prune.respawn * len(doomed)) if step < self.step_of(prune.respawn_stop) else 0
        added = copy_some(model, optimizer, copies, step)
        self.tidy(model)
        if step < self.step_of(self.config.phases.levels[0]):
            model.cube = Cube.around(model.means, margin=MARGIN)
            with still(model):
                self.set_levels(model, cameras, rasterizer, background, str(step))
        self.measure(model)
        limited = " (as many as may go: budget.cap is high)" if len(doomed) == int(prune.share * before) else ""
        each = f"{bits.mean().item():.1f} bits each"
        log.say(f"removed {len(doomed):,} of {before:,} splats{limited}, {added:,} copies, {each}")
        log.scalar("pruned", len(doomed))
        log.scalar("added", added)

    def form_subsets(self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene) -> None:
        """Put splats into the subsets of the file, those worth most for their bits into the first."""
        layers = self.config.layers
        with still(model):
            forecast, drawn = model.predicted()
            bits = packet_bits(drawn, forecast, model.place_bits().float(), layers.planes)
            every = model.gaussians(cameras[0].camera, rasterizer)  # the same whatever the camera

            def costs(there: Tensor) -> Tensor:
                seen = replace(every, visible=there)
                return removal_costs(lambda camera: seen, cameras, rasterizer, scene.background.to(model.device)).cost

            model.subsets = split(costs, sum(bits.values()), bits["base"], layers.shares)
        model.layers = Layers.of_subsets(len(layers.shares), layers.planes)
        self.measure(model)

    def fit_swell(
        self, model: WispModel, cameras: CameraIterator, rasterizer: Rasterizer, scene: Scene, step: int
    ) -> None:
        """Find what size and opacity of subsets become while others are missing, as the splats stand."""
        draws, background = stream(model.split_seed, f"swell/{step}"), scene.background.to(model.device)
        with still(model):
            swell = fitted_swell(model, cameras, rasterizer, background, self.config.layers.swell, draws)
        model.layers = replace(model.layers, swell=swell)

    # Parts

    def loss_of_error(self, model: SplatModel, views: list[View], rasterizer: Rasterizer, background: Tensor) -> float:
        """Return how much the loss of all training views rises with their squared error."""
        return loss_of_error(model, views, rasterizer, background, lambda_dssim=self.config.loss.lambda_dssim)

    def tidy(self, model: WispModel) -> None:
        """Bring all numbers into the ranges that are kept."""
        for name, values in model.tidied().items():
            model.get_parameter(name).data.copy_(values)

    def set_levels(
        self, model: WispModel, views: list[View], rasterizer: Rasterizer, background: Tensor, stream_name: str
    ) -> None:
        """Set the level of every splat by `positions.rule`."""
        rule, cube = self.config.positions, model.cube
        if rule.rule == "mid":
            levels = cube.levels(middle_scales(model.shape.detach(), model.size.detach()), rule.eta)
        else:
            draws = stream(model.split_seed, f"levels/{stream_name}")
            some = some_views(views, draws)
            squared = slopes(model, ["means"], some, rasterizer, background, draws)["means"].sum(1)
            scale = self.loss_of_error(model, views, rasterizer, background) * len(views) / len(some)
            levels = levels_by_cost(squared.double() * scale, self.price(), cube.edge, rule.eta)
        model.levels = levels.clamp(rule.level_min, rule.level_max)

    @property
    def adaptive(self) -> bool:
        """Whether steps follow the networks."""
        return self.config.context.kind == "pyramid" and self.config.steps.adaptive

    def fit(
        self, model: WispModel, views: list[View], rasterizer: Rasterizer, background: Tensor, stream_name: str
    ) -> None:
        """Let the networks learn from the splats as they stand, steps by what the pictures lose and bits cost."""
        if self.config.context.kind != "pyramid":
            return
        weights = None
        if self.adaptive and self.price():
            with still(model):
                weights = self.weights(model, views, rasterizer, background, f"steps/{stream_name}").float()
            weights = weights / self.price()
        for _ in range(FITS):
            model.fit_rate(self.config.context.fit // FITS, weights)
            model.measure()

    def weights(
        self, model: WispModel, views: list[View], rasterizer: Rasterizer, background: Tensor, stream_name: str
    ) -> Tensor:
        """Return the rise of the loss [N,22] float64 for each squared unit that a number is off."""
        draws = stream(model.split_seed, stream_name)
        squared = slopes(model, WispModel.NUMBERS, views, rasterizer, background, draws)
        table = torch.cat([squared[name].reshape(model.num_rows, -1) for name in WispModel.NUMBERS], dim=1)
        return table.double() * self.loss_of_error(model, views, rasterizer, background)

    def set_latent_steps(self, model: WispModel, views: list[View], rasterizer: Rasterizer, background: Tensor) -> None:
        """Give each latent the step that makes its error in the pictures as large as that of the others."""
        draws, spread = stream(model.split_seed, "latents"), self.config.appearance.spread
        some = some_views(views, draws)
        weights = slopes(model, ["latents"], some, rasterizer, background, draws)["latents"].double().sum(0)
        logs = weights.clamp_min(1e-30).log()
        factors = ((logs.mean() - logs) / 2).exp().clamp(1 / spread, spread)
        model.rate.base_steps[LATENTS.columns] *= factors

    def loss(self, model: SplatModel, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        """The photometric loss, the bits of the file at their price, the mean opacity."""
        assert isinstance(model, WispModel)
        config = self.config
        truth = view.image(background, result.image.device)
        pack = photometric_loss(result.image, truth, lambda_dssim=config.loss.lambda_dssim)
        total, parts = pack.total, dict(pack.parts)
        if config.loss.opacity and step < self.step_of(config.loss.opacity_stop):
            total = total + config.loss.opacity * result.inputs.opacities.mean()
        if model.packets is not None:
            total = total * config.layers.weight
        if "bits" in result.extras:
            bits = result.extras["bits"]
            parts["bits"] = bits.detach()  # of a splat's 22 numbers
            total = total + self.price(step) * model.num_rows * bits
        return LossPack(total, parts)

    def finish(self, model: SplatModel, scene: Scene) -> SplatModel:
        """Measure what each prefix of the file shows, if it has layers."""
        assert isinstance(model, WispModel)
        model.packets = None
        release(model)
        if model.layers.order:
            background = scene.background.to(model.device)
            if self.config.layers.swell:
                self.fit_swell(model, CameraIterator(scene.train), self._rasterizer, scene, self.iterations)
            with still(model):
                psnr = psnr_of_prefixes(model, scene.train, self._rasterizer, background)
            model.layers = replace(model.layers, psnr=psnr)
        return model


def priced_pixels(views: Sequence[View]) -> float:
    """Return the pixels that bits are paid by: of all training pictures over 100; lambda is that of a hundred."""
    return pixels_of(views) / 100


def some_views(views: list[View], draws: torch.Generator) -> list[View]:
    """Draw the views that squared slopes are measured over."""
    return [views[i] for i in torch.randperm(len(views), generator=draws)[:SENSITIVE_VIEWS].tolist()]


@contextmanager
def still(model: SplatModel) -> Iterator[None]:
    """Draw without noise inside."""
    was = model.training
    model.eval()
    try:
        yield
    finally:
        model.train(was)
