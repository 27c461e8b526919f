"""What this package provides: the method 3dgs, and its tasks, its files and a pruner for any method that wants them."""

from splatwizard_core.plugins import Registry, hookimpl


@hookimpl
def register_methods(registry: Registry) -> None:
    registry.add("3dgs", "sw_3dgs.method:ThreeDGS",
                 summary="3D Gaussian Splatting (Kerbl et al. 2023), float32 or quantised",
                 presets=["paper", "inria", "inria2024", "absgrad", "mcmc", "quick"],
                 rates=["r1", "r2", "r3", "r4", "r5", "r6"])  # fmt: skip


@hookimpl
def register_tasks(registry: Registry) -> None:
    registry.add("update-lr", "sw_3dgs.tasks:UpdateLearningRate",
                 summary="exponential decay of the means' step size, times the scene extent", factory=True)  # fmt: skip
    registry.add("increase-sh-degree", "sw_3dgs.tasks:increase_sh_degree",
                 summary="activate one more band of spherical harmonics", factory=False)  # fmt: skip
    registry.add("collect-gradient-statistics", "sw_3dgs.tasks:collect_gradient_statistics",
                 summary="add up screen-space gradients (needs grad2d)", factory=False)  # fmt: skip
    registry.add("collect-absgrad-statistics", "sw_3dgs.tasks:collect_absgrad_statistics",
                 summary="add up absolute screen-space gradients (needs absgrad)", factory=False)  # fmt: skip
    registry.add("prune-and-densify", "sw_3dgs.tasks:PruneAndDensify",
                 summary="clone, split and prune Gaussians by those statistics", factory=True)  # fmt: skip
    registry.add("reset-opacity", "sw_3dgs.tasks:ResetOpacity",
                 summary="lower every opacity to at most 0.01", factory=True)  # fmt: skip
    registry.add("relocate-dead", "sw_3dgs.mcmc:Relocate",
                 summary="move faint Gaussians onto opaque ones (3DGS-MCMC)", factory=True)  # fmt: skip
    registry.add("grow-to-cap", "sw_3dgs.mcmc:Grow",
                 summary="add Gaussians beside opaque ones, up to a cap (3DGS-MCMC)", factory=True)  # fmt: skip
    registry.add("add-position-noise", "sw_3dgs.mcmc:AddNoise",
                 summary="shake the means of faint Gaussians after each update (3DGS-MCMC)", factory=True)  # fmt: skip


@hookimpl
def register_pruners(registry: Registry) -> None:
    registry.add("opacity", "sw_3dgs.pruners:Opacity", summary="keeps what is opaque; looks at no view")


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("gaussians-exact", "sw_3dgs.codecs:Exact", codes="gaussians",
                 summary="whole Gaussian models, float32 as trained")  # fmt: skip
    registry.add("gaussians-quantized", "sw_3dgs.codecs:Quantized", codes="gaussians",
                 summary="whole Gaussian models on a lattice, octree positions, range coded")  # fmt: skip
    registry.add("gaussians-ply", "sw_3dgs.codecs:Ply", codes="gaussians",
                 summary="whole Gaussian models, the .ply of 3DGS bit for bit")  # fmt: skip
    registry.add("gaussians-zstd", "sw_3dgs.codecs:Lossless", codes="gaussians",
                 summary="whole Gaussian models, float32 as trained, packed without loss")  # fmt: skip
