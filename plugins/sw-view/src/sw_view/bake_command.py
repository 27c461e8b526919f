"""`sw bake`: explicit Gaussians of a scene whose Gaussians depend on the camera, and what they cost in PSNR."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_FILE,
    Choices,
    bytes_with_named,
    config_option,
    debug_option,
    device_option,
    export_model,
    exporter_of,
    images_option,
    json_option,
    load_plugins,
    name_of,
    open_session,
    options,
    print_facts,
    scene_option,
    set_option,
    takes_choices,
)


@click.command(short_help="make explicit Gaussians of anchors, for viewers")
@click.argument("file", metavar="FILE", type=EXISTING)
@click.argument("out", metavar="OUT", type=OUTPUT_FILE)
@options(
    scene_option, images_option, config_option, set_option,
    click.option(
        "--cameras", type=EXISTING, metavar="FILE",
        help="JSON of the cameras to fit to (README of sw-view).  [default: the scene's training cameras]",
    ),
    click.option(
        "--sh-degree", type=click.IntRange(0, 3), default=2, show_default=True, help="Of the colours, fitted by view."
    ),
    click.option(
        "--refine", type=click.IntRange(min=0), default=0, show_default=True, metavar="STEPS",
        help="Train the result on the model's own pictures; 1000 halve what is lost.",
    ),
    click.option(
        "--format", "exporter", metavar="NAME", type=name_of("exporter"),
        help="Exporter, see `sw list-plugins`.  [default: by the suffix of OUT]",
    ),
    device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def bake(
    file: Path, out: Path, cameras: Path | None, sh_degree: int, refine: int, exporter: str | None, as_json: bool,
    chosen: Choices,
) -> None:  # fmt: skip
    """Fit explicit Gaussians to FILE as given cameras see it, and write them to OUT in any format of `sw export`.

    FILE is a .swz of a method whose Gaussians depend on the camera (HAC, HAC++, CAT-3DGS), or a run directory. Told is
    the PSNR of the explicit Gaussians against the model itself, and of both against the test pictures.
    """
    import torch
    from sw_gaussians.bake_refining import refine as refine_model
    from sw_gaussians.baking import bake as bake_model
    from sw_gaussians.camera_files import read_cameras

    from sw_view.agreement import mean_psnr, truth_of
    from sw_view.drawing import encoded_file, open_drawing

    if file.is_dir():
        chosen = replace(chosen, config_file=chosen.config_file or str(file / "config.toml"))
        file = encoded_file(file)
    resolved = chosen.of_file(file).resolve_without_method()
    plugins = load_plugins()
    name = exporter_of(out, plugins, exporter)  # before the work, not after it
    drawing = open_drawing(file, open_session(resolved, plugins), resolved)
    train = [view.camera for view in drawing.views("train")]
    fitted = train if cameras is None else read_cameras(cameras).cameras
    model = bake_model(drawing.model, fitted, drawing.rasterizer, drawing.options, sh_degree=sh_degree)
    generator = torch.Generator().manual_seed(resolved.ppl.seed)
    refine_model(model, drawing.model, fitted, drawing.rasterizer, drawing.options, steps=refine, generator=generator)
    asked = drawing.rasterizer.decided(drawing.options)
    model.origin = {"raster": {"antialias": asked.antialias, "eps2d": asked.eps2d}}
    if any(drawing.scene.origin):
        model.origin["world_origin"] = list(drawing.scene.origin)  # for `sw export --world`
    baked = replace(drawing, model=model)
    export_model(model, out, plugins, name)
    psnr: dict[str, Any] = {"to_model_at_fitted": mean_psnr(baked, fitted, drawing)}
    told = f"PSNR {psnr['to_model_at_fitted']:.2f} dB against the model at the cameras it was fitted to"
    if cameras is None and (test := drawing.views("test")):
        places = [view.camera for view in test]
        psnr |= {
            "to_model_at_test": mean_psnr(baked, places, drawing),
            "model_at_test": mean_psnr(drawing, places, truth_of(drawing, test)),
            "baked_at_test": mean_psnr(baked, places, truth_of(drawing, test)),
        }
        told += f", {psnr['to_model_at_test']:.2f} dB at the test cameras, where the PSNR of the model was "
        told += f"{psnr['model_at_test']:.2f} dB and is now {psnr['baked_at_test']:.2f} dB"
    facts = {
        "file": str(out), "format": name, "bytes": bytes_with_named(out), "counts": model.counts(),
        "sh_degree": sh_degree, "refined": refine, "cameras": len(fitted), "psnr": psnr,
    }  # fmt: skip
    print_facts(facts, as_json, f"{model.num_rows:,} Gaussians, {facts['bytes']:,} bytes ({name}): {out}\n{told}")
