"""Registers density controls, the tasks of 3DGS, of 3DGS-MCMC and of volume masks, a pruner, and the .ply of 3DGS."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_density_controls(registry: Registry) -> None:
    registry.add("adc", "sw_gaussians.density.adc:AdaptiveDensityControl",
                 summary="clone, split and prune by screen-space gradients, reset opacities (3DGS, AbsGS)",
                 native="sw_gaussians.native:GAUSSIANS")  # fmt: skip
    registry.add("mcmc", "sw_gaussians.density.mcmc:MCMC",
                 summary="relocate and add Gaussians up to a cap, shake them (3DGS-MCMC)")  # fmt: skip
    registry.add("budget", "sw_gaussians.density.budget:BudgetControl",
                 summary="add Gaussians within a budget, drawn by a score (LiteGS)",
                 native="sw_gaussians.native:GAUSSIANS")  # fmt: skip


@hookimpl
def register_tasks(registry: Registry) -> None:
    registry.add("update-lr", "sw_gaussians.stage:UpdateLearningRate",
                 summary="exponential decay of the means' step size, times the scene extent", factory=True)  # fmt: skip
    registry.add("increase-sh-degree", "sw_gaussians.stage:increase_sh_degree",
                 summary="activate one more band of spherical harmonics", factory=False)  # fmt: skip
    registry.add("collect-gradient-statistics", "sw_gaussians.statistics:collect_statistics",
                 summary="add up screen-space gradients (needs grad2d, or absgrad)", factory=False,
                 native="sw_gaussians.native:GAUSSIANS")  # fmt: skip
    registry.add("collect-absgrad-statistics", "sw_gaussians.statistics:collect_statistics",
                 summary="add up absolute screen-space gradients (needs absgrad)", factory=False)  # fmt: skip
    registry.add("prune-and-densify", "sw_gaussians.tasks:PruneAndDensify",
                 summary="clone, split and prune Gaussians by those statistics", factory=True)  # fmt: skip
    registry.add("reset-opacity", "sw_gaussians.tasks:ResetOpacity",
                 summary="lower every opacity to at most 0.01", factory=True)  # fmt: skip
    registry.add("mask-prune", "sw_gaussians.volume_mask:mask_prune",
                 summary="remove Gaussians that a learned volume mask turned off (Compact3DGS)",
                 factory=False)  # fmt: skip
    registry.add("relocate-dead", "sw_gaussians.mcmc_tasks:Relocate",
                 summary="move faint Gaussians onto opaque ones (3DGS-MCMC)", factory=True)  # fmt: skip
    registry.add("grow-to-cap", "sw_gaussians.mcmc_tasks:Grow",
                 summary="add Gaussians beside opaque ones, up to a cap (3DGS-MCMC)", factory=True)  # fmt: skip
    registry.add("add-position-noise", "sw_gaussians.mcmc_tasks:AddNoise",
                 summary="shake the means of faint Gaussians after each update (3DGS-MCMC)", factory=True)  # fmt: skip

    registry.add("collect-opacity-gradients", "sw_gaussians.density.fragments:collect_opacity_gradients",
                 summary="add up opacity gradients and their squares over fragments (needs fragment_grad)",
                 factory=False)  # fmt: skip
    registry.add("densify-to-budget", "sw_gaussians.fast_tasks:DensifyToBudget",
                 summary="prune, and grow by a score within a budget (LiteGS)", factory=True)  # fmt: skip
    registry.add("halve-opacity", "sw_gaussians.fast_tasks:HalveOpacity",
                 summary="halve every opacity and reset Adam (LiteGS)", factory=True)  # fmt: skip
    registry.add("prune-by-views", "sw_gaussians.fast_tasks:PruneByViews",
                 summary="prune by opacity and by errors in several views (FastGS)",
                 factory=True)  # fmt: skip
    registry.add("sum-views", "sw_gaussians.late_batches:SumViews",
                 summary="update on the summed gradients of several views (dense Adam)",
                 factory=True)  # fmt: skip
    registry.add("average-parameters", "sw_gaussians.averaging:AverageParameters",
                 summary="make a model the mean of itself over the last steps", factory=True)  # fmt: skip
    registry.add("dash", "sw_gaussians.resolution:SmallPictures",
                 summary="begin with small pictures, sizes by what their spectra hold (DashGaussian)",
                 factory=True, resizes_pictures=True)  # fmt: skip
    registry.add("settle-learning-rates", "sw_gaussians.learning_rate_decay:SettleLearningRates",
                 summary="let learning rates fall towards the end", factory=True)  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("opacity", "sw_gaussians.pruners:Opacity", summary="keeps what is opaque; looks at no view")
    registry.add("removal", "sw_gaussians.removal:Removal",
                 summary="keeps what the photographs lose most by removing: exact squared error")  # fmt: skip


@hookimpl
def register_exporters(registry: Registry) -> None:
    registry.add("ply", "sw_gaussians.ply:export_ply",
                 summary="3DGS .ply, float32, as the original viewers read it", suffix=".ply")  # fmt: skip
    registry.add("ply-as-3dgs", "sw_gaussians.ply:export_ply_as_3dgs",
                 summary="the same, of surfels too: they get a third scale of 1e-8", suffix="")  # fmt: skip


@hookimpl
def register_importers(registry: Registry) -> None:
    registry.add("ply", "sw_gaussians.ply:load_ply",
                 summary=".ply of 3DGS and 2DGS, float32, as the original codes write it", suffix=".ply")  # fmt: skip
