"""What this package provides: LPIPS in three forms."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_metrics(registry: Registry) -> None:
    for name, target, summary in (
        ("lpips_vgg_3dgs", "VGG_3DGS", "LPIPS, VGG16 fed with 0..1 as the 3DGS code does: the one in most tables"),
        ("lpips_vgg", "VGG", "LPIPS, VGG16, images mapped to -1..1"),
        ("lpips_alex", "ALEX", "LPIPS, AlexNet, images mapped to -1..1"),
    ):
        registry.add(name, f"sw_metrics.perceptual:{target}", summary=summary, direction="lower", slow=True)
