"""Small models of HAC with values that follow their predicted distributions, as those of a trained one do."""

import copy
from types import SimpleNamespace

import torch
from sw_anchors.attribute_sections import AttributeEncoder
from sw_anchors.coded_anchors import ENTROPY
from sw_anchors.sections import kept_geometry, round_networks
from sw_anchors.shape import GROUPS

from splatwizard_core.coding.container import ContainerReader, ContainerWriter
from splatwizard_core.plugins import load_plugins
from splatwizard_core.runs.config import apply_overrides
from sw_hac import codec
from sw_hac.config import HACConfig
from sw_hac.method import HAC
from sw_hac.mixed_grid import MixedHashGrid
from sw_hac.model import HACAnchors

PLUGINS = load_plugins()
SMALL_GRID = {"features": 2, "log2_space": 8, "log2_planes": 8}


def generator(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def method(**values) -> HAC:
    overrides = {key.replace("__", "."): value for key, value in values.items()}
    return HAC(PLUGINS, apply_overrides(HACConfig(), overrides, source="test"))


def make(n: int = 300, feature_dim: int = 8, k: int = 4, *, seed: int = 0, **kwargs) -> HACAnchors:
    """n anchors in front of the test camera; a fifth of the offsets, and anchors 0 to 4, are masked."""
    g = generator(seed)
    anchors = torch.rand(n, 3, generator=g) * 2 - torch.tensor([1.0, 1.0, -3.0])
    grid = MixedHashGrid((6, 10, 18), (10, 34), **SMALL_GRID, generator=g)
    model = HACAnchors(
        anchors, torch.zeros(n, feature_dim), torch.zeros(n, k, 3), torch.zeros(n, 6), voxel_size=0.01, hidden=8,
        generator=g, grid=grid, grid_hidden=16, margin="extent", **kwargs,
    )  # fmt: skip
    with torch.no_grad():
        for part in model.grid.grids:
            part.table.copy_(torch.randn(part.table.shape, generator=g))
        last = model.mlp_grid[2]
        parts = last.bias.split([feature_dim, feature_dim, 6, 6, 3 * k, 3 * k, 1, 1, 1])
        # Deviations of some steps, all predicted scales positive, steps of all sizes.
        for part, center, width in zip(parts, (0, 4, 0.08, 0.01, 0, 0.8, 0.3, -0.4, 0.2),
                                       (3, 1, 0.02, 0.002, 0.5, 0.2, 0, 0, 0), strict=True):  # fmt: skip
            part.copy_(center + width * (torch.rand(part.shape, generator=g) * 2 - 1))
        last.weight[-3:] *= 2
        last.weight[2 * feature_dim : 2 * feature_dim + 12] *= 0.02
        if n:
            context = predicted(model, torch.arange(n))
            features, scales, offsets = (
                mean + scale.clamp(min=1e-9) * torch.randn(mean.shape, generator=g)
                for mean, scale in zip(context.means, context.scales, strict=True)
            )
            model.features.copy_(features)
            model.log_scales.copy_(scales.clamp(min=1e-3).log())
            model.offsets.copy_(offsets.view(n, k, 3))
            model.mask_logits[torch.rand(n, k, generator=g) < 0.2] = -6
            model.mask_logits[:5] = -6
    model.phase = ENTROPY
    return model.eval()


def predicted(model, rows):
    """Distributions of the anchors `rows`."""
    found = model.rate_model
    return found.read(found.network(found.grid(*model.context_of(rows))))


def encoded(model: HACAnchors, **values) -> bytes:
    writer = ContainerWriter("hac", HAC.version)
    with torch.no_grad():
        method(**values).encode(model, writer)
    return writer.to_bytes()


def decoded(data: bytes):
    with torch.no_grad():
        return HAC(PLUGINS, None).decode(ContainerReader(data))


class Recorder(AttributeEncoder):
    """An encoder that keeps integers and steps, and counts the bits of the tables."""

    def __init__(self, *args):
        super().__init__(*args)
        self.symbols, self.steps, self.bits = {g: [] for g in GROUPS}, {g: [] for g in GROUPS}, 0.0

    def code(self, block, context, step, present=None):
        symbols = super().code(block, context, step, present)
        self.symbols[block.group].append(symbols)
        self.steps[block.group].append(step)
        self.bits += float(self.coder.bits(symbols, context, present).sum()) if self.coder.mode == "exact" else 0.0
        return symbols


def predictor(model, mode="exact"):
    return model.rate_model.predictor(mode)


def lattice_of(model, *, mode="exact", **values):
    """Geometry, integers and steps of a file by group, the values they stand for, its bits by the tables; the file."""
    settings = method(codec__settings__mode=mode, **values).config.codec.settings
    writer, again = ContainerWriter("hac", 1), ContainerWriter("hac", 1)
    with torch.no_grad():
        codec.encode(model, writer, settings, PLUGINS)
        model = copy.deepcopy(model)
        model.fold_units()
        round_networks(model.networks(), settings.weights)
        geometry, rows = kept_geometry(model)
        recorder = Recorder(model, rows, list(codec.SECTIONS.values()), mode, PLUGINS)
        codec.walk(recorder, predictor(model, mode), geometry)
        recorder.write(again)
    stored = ContainerReader(writer.to_bytes()), ContainerReader(again.to_bytes())
    assert all(stored[0].section(name) == stored[1].section(name) for name in codec.SECTIONS.values())
    symbols, steps = ([torch.cat(each[g]) for g in GROUPS] for each in (recorder.symbols, recorder.steps))
    return SimpleNamespace(
        places=geometry, symbols=symbols, steps=steps, values=model.raw(rows), bits=recorder.bits
    ), writer
