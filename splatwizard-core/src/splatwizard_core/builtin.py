"""The core as a plugin of itself: its image metrics and its commands."""

from splatwizard_core.plugins.hookspecs import hookimpl
from splatwizard_core.plugins.registry import Registry


@hookimpl
def register_metrics(registry: Registry) -> None:
    image = "splatwizard_core.evaluation.image"
    registry.add("psnr", f"{image}:psnr", label="PSNR", unit="dB", digits=2, position=1, direction="higher",
                 summary="peak signal-to-noise ratio, dB, joint over channels")  # fmt: skip
    registry.add("ssim", f"{image}:ssim", label="SSIM", digits=4, position=2, direction="higher",
                 summary="structural similarity, 11x11 Gaussian window, zero padding")  # fmt: skip
    registry.add("l1", f"{image}:l1", label="L1", digits=4, position=6, direction="lower",
                 summary="mean absolute error")  # fmt: skip


@hookimpl
def register_commands(registry: Registry) -> None:
    for position, name, target, summary in (
        (0, "run", "run:run", "train, encode, decode, evaluate, report: one scene"),
        (1, "train", "train:train", "train one method on one scene"),
        (2, "encode", "codec:encode", "a trained model to one file"),
        (3, "decode", "codec:decode", "a file back to a model, from nothing but itself"),
        (4, "eval", "evaluate:evaluate", "quality, speed and memory of an encoded scene"),
        (6, "list-plugins", "list_plugins:list_plugins", "what is installed, what is broken and why"),
        (7, "schedule", "schedule:schedule", "a method's plan as a table"),
    ):
        registry.add(name, f"splatwizard_core.cli.{target}", summary=summary, position=position)
