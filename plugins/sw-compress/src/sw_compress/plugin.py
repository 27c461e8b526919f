"""Registers `sw compress`, and the codec of trainings to a size."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add(
        "compress",
        "sw_compress.command:compress",
        position=4.2,
        summary="any splat file to a size, without photographs",
    )


@hookimpl
def register_coders(registry: Registry) -> None:
    registry.add("gaussians-sized", "sw_compress.sized:Sized", codes="gaussians",
                 summary="whole Gaussian models to a size, in files of gaussians-quantized")  # fmt: skip


@hookimpl
def register_tasks(registry: Registry) -> None:
    registry.add("lead-to-size", "sw_compress.lambda_control:LeadToSize", factory=True,
                 summary="change lambda of an anchor method so that its file comes to a size")  # fmt: skip
