"""`sw bench`: a sweep of methods, scenes, rate points and seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    config_option,
    debug_option,
    device_option,
    geometry_option,
    images_option,
    init_option,
    json_option,
    methods_option,
    name_of,
    options,
    preset_option,
    rates_option,
    repeats_option,
    scene_option,
    seeds_option,
    set_option,
)


@click.command(short_help="a sweep of methods, scenes, rate points and seeds")
@click.argument("paths", metavar="[PLAN.toml | FILE...]", nargs=-1, type=click.Path(dir_okay=False))
@options(
    methods_option, scene_option, rates_option, seeds_option, preset_option, images_option, init_option, config_option,
    set_option,
    click.option("--out", metavar="DIR", type=click.Path(),
                 help="Root of the run directories, DIR/seed-N/<scene>/<method>/<rate>; the same sweep goes on there.  "
                 "[default: what the plan says, else out/NAME for NAME.toml, else out]"),
    device_option, repeats_option, geometry_option,
    click.option("--executor", metavar="NAME", type=name_of("executor"),
                 help="Where the runs happen, see `sw list-plugins`.  [default: what the plan says, else local]"),
    click.option("--option", "-o", "given", multiple=True, metavar="KEY=VALUE",
                 help="Option of the executor, such as workers=2; repeatable, wins over the plan's."),
    click.option("--dry-run", is_flag=True, help="Print what would run, with an estimate of the time; run nothing."),
    click.option("--probe/--no-probe", default=True, show_default=True,
                 help="With --dry-run: measure a few training steps of each method for the estimate."),
    click.option("--rerun-changed", is_flag=True,
                 help="Discard what was made by another plan's values and train it anew; without it that is an error."),
    click.option("--recheck", is_flag=True,
                 help="Start finished runs too: they do again what new versions or changed pictures ask for."),
    click.option("--retries", type=click.IntRange(min=0), default=2, show_default=True, metavar="N",
                 help="Further starts of a process that was killed."),
    click.option("--train-shared", nargs=2, hidden=True, type=click.Path(), metavar="FILE ROOT",
                 help="Used by sweeps: train what several runs start from.  [default: none]"),
    click.option("--protocol", type=click.Choice(["mpeg-gsc"]),
                 help="Code trained models FILE... by methods that need no training, after the MPEG GSC exploration "
                 "(2025), own renderer and cameras.  [default: a sweep]"),
    click.option("--cameras", metavar="PATH", type=EXISTING,
                 help="With --protocol: a scene's folder or a file of cameras.  [default: those of FILE's comments, "
                 "else 16 around or in the model]"),
    click.option("--views", metavar="NAMES", help="With --protocol: all, every<n>, or views with commas.  [default: a "
                 "scene's test views, else all]"),
    click.option("--size", metavar="WxH", help="With --protocol: of pictures from cameras without a size.  [default: "
                 "1280x720]"),
    click.option("--frames", metavar="PATTERN", help="With --protocol: the frames of one sequence, 'f%04d.ply', each "
                 "coded alone, in place of FILE...  [default: none]"),
    json_option, debug_option,
)  # fmt: skip
def bench(paths: tuple[str, ...], train_shared: tuple[str, str] | None, **given: Any) -> None:
    """Run a sweep: every method of PLAN on every scene, at every rate point, with every seed.

    Without a PLAN the options are one, with comma lists; with one, --method, --scene and --seed choose a part of it.
    What is finished is not done again, what was interrupted goes on, what failed is tried again: give the same command.

    With --protocol mpeg-gsc, FILE... are trained models, and --method names codecs (default: all that train nothing).
    Further -o KEY=VALUE: anchor, path (auto, orbit16, inside16), up (x,y,z or auto), quaternion (w2c, c2w), range
    (auto, fixed), alpha_max (0.99, 0.999). Written are gsc.csv, gsc_bd.csv and gsc.json.
    """
    of_protocol = {name: given.pop(name) for name in ("protocol", "cameras", "views", "size", "frames")}
    if of_protocol.pop("protocol") is not None:
        from sw_bench.gsc.command import bench_models

        bench_models(paths, given, **of_protocol)
        return
    if alone := [name for name, value in of_protocol.items() if value is not None]:
        raise click.UsageError(f"--{alone[0]} is for --protocol mpeg-gsc")
    if len(paths) > 1:
        raise click.UsageError("give one PLAN.toml; several models are for --protocol mpeg-gsc")
    plan = paths[0] if paths else None
    if train_shared is not None:
        from sw_bench.shared import train_shared as train

        train(Path(train_shared[0]), Path(train_shared[1]))
        return
    from sw_bench.running import bench_plan, plan_of_options

    wanted = plan_of_options(plan, given)
    click.get_current_context().exit(bench_plan(wanted, given))
