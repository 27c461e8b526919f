"""Registers LPIPS in three forms, and the check of what it needs on a machine."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_metrics(registry: Registry) -> None:
    for name, target, label, position, summary in (
        ("lpips_vgg_3dgs", "VGG_3DGS", "LPIPS (VGG, 3DGS)", 3,
         "LPIPS, VGG16 fed with 0..1 as the 3DGS code does: the one in most tables"),
        ("lpips_vgg", "VGG", "LPIPS (VGG)", 4, "LPIPS, VGG16, images mapped to -1..1"),
        ("lpips_alex", "ALEX", "LPIPS (Alex)", 5, "LPIPS, AlexNet, images mapped to -1..1"),
    ):  # fmt: skip
        registry.add(name, f"sw_metrics.perceptual:{target}", summary=summary, direction="lower", slow=True,
                     label=label, digits=4, position=position)  # fmt: skip


@hookimpl
def register_checks(registry: Registry) -> None:
    registry.add("LPIPS", "sw_metrics.check:check_lpips", group="metrics", needs="torch",
                 summary="the package lpips and its weights")  # fmt: skip
