"""Registers LPIPS in three forms, PSNR and SSIM in other codes' conventions, and what brings LPIPS's weights."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_metrics(registry: Registry) -> None:
    for name, form, label, position, summary in (
        ("lpips_vgg_3dgs", "VGG_3DGS", "LPIPS (VGG, 3DGS)", 3,
         "LPIPS, VGG16 fed with 0..1 as the 3DGS code does: the one in most tables"),
        ("lpips_vgg", "VGG", "LPIPS (VGG)", 4, "LPIPS, VGG16, images mapped to -1..1"),
        ("lpips_alex", "ALEX", "LPIPS (Alex)", 5, "LPIPS, AlexNet, images mapped to -1..1"),
    ):  # fmt: skip
        registry.add(name, f"sw_metrics.perceptual:{form}", summary=summary, label=label, digits=4, direction="lower",
                     slow=True, group="lpips", settings="sw_metrics.perceptual:LpipsSettings",
                     position=position)  # fmt: skip
    conventions = "sw_metrics.conventions"
    registry.add("psnr_channel_mean", f"{conventions}:psnr_channel_mean", label="PSNR, mean of channels", unit="dB",
                 digits=2, direction="higher", diagnostic=True,
                 summary="mean of the channels' PSNRs, dB: never below psnr")  # fmt: skip
    registry.add("psnr_unrounded", f"{conventions}:psnr_unrounded", label="PSNR, unrounded", unit="dB", digits=2,
                 direction="higher", diagnostic=True, unrounded=True,
                 summary="psnr of the render before it is rounded to 8 bit, dB")  # fmt: skip
    registry.add("ssim_valid", f"{conventions}:ssim_valid", label="SSIM, no border", digits=4, direction="higher",
                 diagnostic=True, summary="ssim without the border, as scikit-image averages")  # fmt: skip
    registry.add("ssim_reflect", f"{conventions}:ssim_reflect", label="SSIM, mirrored", digits=4, direction="higher",
                 diagnostic=True,
                 summary="ssim of the picture mirrored at its edge, as torchmetrics averages")  # fmt: skip
    for name, label, unit, digits, direction, summary in (
        ("cc_psnr", "PSNR, colour-corrected", "dB", 2, "higher", "psnr after colours are fitted to the photograph, dB"),
        ("cc_gain", "gain of colour correction", "dB", 2, "lower",
         "cc_psnr - psnr, dB; below 1 it says nothing about exposure"),
        ("cc_psnr_channel", "PSNR, channels corrected", "dB", 2, "higher",
         "psnr after a slope and an offset for each channel, dB"),
        ("cc_psnr_quad", "PSNR, quadratically corrected", "dB", 2, "higher",
         "psnr after multinerf's quadratic colour correction, dB"),
        ("cc_ssim", "SSIM, colour-corrected", "", 4, "higher", "ssim after colours are fitted to the photograph"),
    ):  # fmt: skip
        registry.add(name, f"sw_metrics.colour_correction:{name}", label=label, unit=unit, digits=digits,
                     direction=direction, diagnostic=True, slow=name != "cc_psnr", pixelwise=name != "cc_ssim",
                     summary=summary)  # fmt: skip
    registry.add("cc_lpips_vgg_3dgs", "sw_metrics.colour_correction:CC_VGG_3DGS", digits=4, direction="lower",
                 label="LPIPS (VGG, 3DGS), colour-corrected", diagnostic=True, slow=True, group="lpips",
                 settings="sw_metrics.perceptual:LpipsSettings",
                 summary="lpips_vgg_3dgs after colours are fitted to the photograph")  # fmt: skip
    for name, label, direction, digits, summary in (
        (
            "flip",
            "FLIP",
            "lower",
            4,
            "FLIP (LDR) of NVIDIA, by flip-evaluator: visible differences when two pictures alternate",
        ),
        ("ms_ssim", "MS-SSIM", "higher", 4, "multi-scale SSIM, by piq"),
        ("haarpsi", "HaarPSI", "higher", 4, "Haar wavelet similarity, by piq"),
        ("fsim", "FSIMc", "higher", 4, "feature similarity with colour, by piq"),
        ("vsi", "VSI", "higher", 4, "visual saliency similarity, by piq"),
        ("gmsd", "GMSD", "lower", 4, "deviation of gradient magnitude similarity, by piq"),
        (
            "cvvdp",
            "ColorVideoVDP",
            "higher",
            2,
            "ColorVideoVDP in JOD on a display, by cvvdp: 10 means no visible difference",
        ),
    ):
        given = (
            {"settings": f"sw_metrics.vision_models:{name.capitalize()}Settings"} if name in ("flip", "cvvdp") else {}
        )
        registry.add(name, f"sw_metrics.vision_models:{name.upper()}", label=label, digits=digits,
                     direction=direction, diagnostic=True, slow=True, summary=summary, **given)  # fmt: skip
    for name, label, unit, summary in (
        ("path_distance", "distance", "", "distance of a test camera from the nearest trained one, in their spacings"),
        ("path_angle", "angle", "deg", "angle of a test view to the training view that looks most alike, degrees"),
        ("path_combined", "distance and angle", "", "distance / scene extent + angle / 90 degrees, to the nearest"),
    ):
        registry.add(name, f"sw_metrics.path_distance:{name}", label=label, unit=unit, digits=2, direction="lower",
                     diagnostic=True, over="views", summary=summary)  # fmt: skip


@hookimpl
def register_downloads(registry: Registry) -> None:
    registry.add("lpips", "sw_metrics.backbones:downloads", make="sw_metrics.packaged_weights:make_backbone",
                 summary="the backbones of LPIPS")  # fmt: skip


@hookimpl
def register_checks(registry: Registry) -> None:
    registry.add("LPIPS", "sw_metrics.check:check_lpips", group="metrics", needs="torch",
                 summary="the package lpips and its weights")  # fmt: skip
    registry.add("vision models", "sw_metrics.check:check_vision_models", group="metrics", needs="torch",
                 summary="the packages of FLIP, MS-SSIM and others, ColorVideoVDP")  # fmt: skip
