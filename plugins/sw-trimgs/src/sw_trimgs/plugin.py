"""Registers TrimGS' methods, its score as a pruner and its densification as a task."""

from splatwizard_core.api import Registry, hookimpl

RATES = ["r1", "r2", "r3", "r4", "r5", "r6"]


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("flat-3dgs", "sw_trimgs.method:Flat3DGS", title="flat 3DGS",
                 summary="3DGS with flat Gaussians: what trim-3dgs starts from",
                 presets=["paper", "quick"], rates=RATES)  # fmt: skip
    registry.add("trim-3dgs", "sw_trimgs.method:Trim3DGS", title="Trim3DGS",
                 summary="flat Gaussians, trimmed by contribution and split by scale (Fan et al. 2024)",
                 presets=["paper", "dtu", "mipnerf360-outdoor", "mipnerf360-indoor", "quick"],
                 rates=RATES)  # fmt: skip
    registry.add("trim-2dgs", "sw_trimgs.surfel_method:Trim2DGS", title="Trim2DGS",
                 summary="surfels of a 2DGS scene, trimmed by contribution and split by scale (Fan et al. 2024)",
                 presets=["paper", "dtu", "mipnerf360", "tnt", "tnt-large", "quick"], rates=RATES)  # fmt: skip
    registry.add("trim-2dgs-scratch", "sw_trimgs.surfel_method:Trim2DGSScratch", title="Trim2DGS, scratch",
                 summary="2DGS that is trimmed and split by scale while it trains (Fan et al. 2024)",
                 presets=["paper", "dtu", "quick"], rates=RATES)  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("trimgs", "sw_trimgs.contribution:Contribution",
                 summary="TrimGS' contribution: mean of alpha times transmittance in the five best views")  # fmt: skip


@hookimpl
def register_tasks(registry: Registry) -> None:
    registry.add("scale-split", "sw_trimgs.scale_split:ScaleSplit",
                 summary="split what is too large in three, prune what is faint (TrimGS)", factory=True)  # fmt: skip
