"""The anchor method: Scaffold-GS in miniature, with a file whose features a context network predicts."""

from collections.abc import Sequence

import numpy as np
import torch
from pydantic import Field
from sw_anchors.anchors import AnchorModel
from sw_anchors.growth import accumulate_anchor_statistics, adjust_anchors
from torch import Tensor

from splatwizard_core.api import (
    ContainerReader,
    ContainerWriter,
    LossPack,
    Method,
    OptimizationParams,
    ParamGroup,
    PipelineParams,
    RasterOptions,
    RenderResult,
    Scene,
    SceneError,
    Scheduler,
    SplatOptimizer,
    Stage,
    StageContext,
    View,
    photometric_loss,
)
from sw_codecs.context.integer_mlp import IntegerMlp
from sw_codecs.entropy.gaussian_exact import GaussianExact, IntegerContext
from sw_test_anchors.model import POSITION_BITS, ContextAnchors, context_inputs

NETWORKS = ("mlp_opacity", "mlp_cov", "mlp_color")
LIMITS = {"num_offsets": 64, "feature_dim": 256, "hidden": 256}


class TestAnchorsConfig(OptimizationParams):
    iterations: int = Field(50, ge=1, description="steps")
    voxel_size: float = Field(0.08, gt=0, description="edge of an anchor's cell, world units")
    num_offsets: int = Field(4, ge=1, le=LIMITS["num_offsets"], description="Gaussians per anchor")
    feature_dim: int = Field(8, ge=1, le=LIMITS["feature_dim"], description="numbers in an anchor's feature")
    hidden: int = Field(24, ge=1, le=LIMITS["hidden"], description="width of the networks")
    feature_step: float = Field(0.02, gt=0, description="quantiser step of the features")
    rate_weight: float = Field(1e-3, ge=0, description="weight of the bits per feature in the loss")
    volume_weight: float = Field(0.01, ge=0, description="weight of the mean volume of a drawn Gaussian in the loss")
    adjust_interval: int = Field(20, ge=1, description="steps between changes of the anchors")
    grad_threshold: float = Field(2e-4, gt=0, description="mean gradient of an offset that grows an anchor, NDC units")
    min_opacity: float = Field(0.005, ge=0, description="anchors whose offsets sum to less go, mean over views")
    attribute_bits: int = Field(10, ge=1, le=16, description="bits of an offset's or a log scale's range")


class AnchorStage(Stage):
    """One stage: photometric loss, rate of the features, volume; anchors grow and go."""

    name = "anchors"
    opt: TestAnchorsConfig

    def begin(self, context: StageContext) -> ContextAnchors:
        context.model.noise = context.generator("noise")
        self.growth = context.generator("growth")
        return context.model

    def create_optimizer(self, model: ContextAnchors, scene: Scene) -> SplatOptimizer:
        rates = {"offsets": 0.01 * scene.extent, "features": 7.5e-3, "log_scales": 7e-3, "mlp_opacity": 2e-3,
                 "mlp_cov": 4e-3, "mlp_color": 8e-3, "context": 2e-2}  # fmt: skip
        return SplatOptimizer(model, [ParamGroup(name, lr) for name, lr in rates.items()])

    def register_post_task(self, scheduler: Scheduler, ppl: PipelineParams, opt: OptimizationParams) -> None:
        interval = self.opt.adjust_interval
        scheduler.register_task(range(self.opt.iterations), self.collect_statistics)
        scheduler.register_task(range(interval, self.opt.iterations, interval), self.adjust_anchors)

    def collect_statistics(self, model: ContextAnchors, result: RenderResult) -> None:
        accumulate_anchor_statistics(model, result.extras["anchors"], result.grad2d.value, result.radii)

    def adjust_anchors(self, model: ContextAnchors, optimizer: SplatOptimizer, step: int) -> None:
        # Cells of one and of half a voxel: the coarse ones of the papers are all taken in so short a run.
        adjust_anchors(
            model, optimizer, step=step, generator=self.growth, interval=self.opt.adjust_interval,
            grad_threshold=self.opt.grad_threshold, min_opacity=self.opt.min_opacity,
            levels=2, init_factor=1, hierarchy=2,
        )  # fmt: skip

    def raster_options(self, step: int, background: Tensor) -> RasterOptions:
        return RasterOptions(background=background, grad2d=True)

    def loss(self, model: ContextAnchors, view: View, result: RenderResult, background: Tensor, step: int) -> LossPack:
        photometric = photometric_loss(result.image, view.image(background, result.image.device))
        bits = result.extras["bits"].sum() / max(result.extras["bits"].numel(), 1)  # no anchor visible: 0, not NaN
        volume = result.inputs.scales.prod(dim=1).sum() / max(len(result.inputs), 1)
        total = photometric.total + self.opt.rate_weight * bits + self.opt.volume_weight * volume
        return LossPack(total, {**photometric.parts, "bits": bits.detach(), "volume": volume.detach()})


class TestAnchors(Method):
    name = "test-anchors"
    Config = TestAnchorsConfig
    RATES = {"r1": {"feature_step": 0.08}, "r2": {"feature_step": 0.02}}
    DEFAULT_RATE = "r2"

    def create_model(self, scene: Scene, generator: torch.Generator) -> ContextAnchors:
        if scene.points is None:
            raise SceneError(f"scene '{scene.name}' has no points to put anchors at", path=scene.path)
        c = self.config
        return ContextAnchors.from_points(
            scene.points, voxel_size=c.voxel_size, num_offsets=c.num_offsets, feature_dim=c.feature_dim,
            hidden=c.hidden, generator=generator, feature_step=c.feature_step, plugins=self.plugins,
        )  # fmt: skip

    def stages(self) -> Sequence[Stage]:
        return [AnchorStage(self.config)]

    def encode(self, model: ContextAnchors, writer: ContainerWriter) -> None:
        octree = self.plugins.position_codecs.load("octree")()
        codes, side = model.grid.encode(model.anchors)
        order = torch.from_numpy(octree.sort(codes.cpu().numpy()))
        codes = codes.cpu()[order]
        writer.static = {name: getattr(self.config, name) for name in (*LIMITS, "voxel_size", "feature_step")}
        writer.add("positions", octree.encode(codes.numpy(), bits=POSITION_BITS))
        writer.add_array("positions.low", side["low"])
        writer.add_array("positions.step", side["step"])

        writer.require("context model", "integer-mlp")
        network = IntegerMlp.from_module(model.context)
        for key, weights in network.state().items():
            writer.add_array(f"context.{key}", weights)
        writer.require("entropy model", "gaussian-exact")
        rounded = self.plugins.quantizers.load("ste-round")(model.feature_step)
        symbols, _ = rounded.encode(model.features.cpu()[order])
        writer.add(
            "features",
            GaussianExact().encode(symbols.flatten().numpy(), distribution(network, codes, model.features.shape[1])),
        )

        columns = self.plugins.entropy_models.load("columns")()
        for name in ("offsets", "log_scales"):
            uniform = self.plugins.quantizers.load("uniform")(self.config.attribute_bits)
            symbols, side = uniform.encode(getattr(model, name).detach().cpu()[order].flatten(1))
            writer.add(name, columns.encode(symbols.numpy()))
            for key, value in side.items():
                writer.add_array(f"{name}.{key}", value)
        for name in NETWORKS:
            for key, value in getattr(model, name).state_dict().items():
                writer.add_array(f"{name}.{key}", value.cpu().numpy().astype("<f4"))

    def decode(self, reader: ContainerReader) -> AnchorModel:
        k, feature_dim, hidden = (reader.integer(name, low=1, high=high) for name, high in LIMITS.items())
        voxel_size, step = (reader.number(name, low=1e-9, high=1e9) for name in ("voxel_size", "feature_step"))
        uniform = self.plugins.quantizers.load("uniform")
        with reader.decoding("positions") as data:
            codes = torch.from_numpy(self.plugins.position_codecs.load("octree")().decode(data))
            bits = np.full(3, POSITION_BITS, np.uint8)
            anchors = uniform.decode(codes, {**grid_side(reader, "positions", 3), "bits": bits})
        n = len(codes)

        keys = [f"{kind}{layer}" for layer in (0, 1) for kind in ("weight", "bias")]
        state = {key: reader.array(f"context.{key}", dtype="<f4") for key in keys}
        with reader.decoding("features") as data:
            network = IntegerMlp.from_state(state)
            symbols = torch.from_numpy(GaussianExact().decode(data, distribution(network, codes, feature_dim)))
            rounded = self.plugins.quantizers.load("ste-round")
            features = rounded.decode(symbols.reshape(n, feature_dim), {"step": np.float64(step)})

        columns = self.plugins.entropy_models.load("columns")()
        found = []
        for name, width in (("offsets", 3 * k), ("log_scales", 6)):
            with reader.decoding(name) as data:
                symbols = torch.from_numpy(columns.decode(data, (n, width)))
                side = {**grid_side(reader, name, width), "bits": reader.array(f"{name}.bits", dtype="u1")}
                found.append(uniform.decode(symbols, side))
        model = AnchorModel(
            anchors, features, found[0].reshape(n, k, 3), found[1],
            voxel_size=voxel_size, hidden=hidden, generator=torch.Generator(),
        )  # fmt: skip
        for name in NETWORKS:
            network = getattr(model, name)
            arrays = {
                key: reader.array(f"{name}.{key}", dtype="<f4", shape=value.shape, finite=True)
                for key, value in network.state_dict().items()
            }
            network.load_state_dict({key: torch.from_numpy(array) for key, array in arrays.items()})
        return model


def distribution(network: IntegerMlp, codes: Tensor, feature_dim: int) -> IntegerContext:
    """Mean and scale of every feature, anchor by anchor: what encoder and decoder both derive from the positions.

    Raises ValueError if the network has another number of outputs.
    """
    mean, scale = network(context_inputs(codes)).split(feature_dim, dim=1)
    return IntegerContext(mean.flatten().numpy(), scale.flatten().numpy())


def grid_side(reader: ContainerReader, name: str, channels: int) -> dict[str, np.ndarray]:
    """Low end and step of each channel of a uniform quantizer."""
    return {key: reader.array(f"{name}.{key}", dtype="<f4", shape=(channels,), finite=True) for key in ("low", "step")}
