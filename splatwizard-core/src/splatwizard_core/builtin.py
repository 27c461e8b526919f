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
    for position, (name, target, summary) in enumerate((
        ("run", "run:run", "train, encode, decode, evaluate, report: one scene"),
        ("train", "train:train", "train one method on one scene"),
        ("encode", "codec:encode", "a trained model to one file"),
        ("decode", "codec:decode", "a file back to a model, from nothing but itself"),
        ("eval", "evaluate:evaluate", "quality, speed and memory of an encoded scene"),
        ("export", "export:export", ".ply and other interchange formats"),
        ("list-plugins", "list_plugins:list_plugins", "what is installed, what is broken and why"),
        ("schedule", "schedule:schedule", "a method's plan as a table"),
    )):  # fmt: skip
        registry.add(name, f"splatwizard_core.cli.{target}", summary=summary, position=position)
    registry.add("truncate", "splatwizard_core.cli.truncate:truncate", summary="a shorter file of one with cuts",
                 position=3.5)  # fmt: skip
