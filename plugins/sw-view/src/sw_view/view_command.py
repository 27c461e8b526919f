"""`sw view`: look at decoded models in the browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_FILE,
    Choices,
    config_option,
    debug_option,
    device_option,
    images_option,
    json_option,
    load_plugins,
    options,
    print_facts,
    print_json,
    say,
    scene_option,
    set_option,
    takes_choices,
)

MOST_IN_A_PAGE = 2
LOCAL, EVERYWHERE = "127.0.0.1", "0.0.0.0"


def _addresses(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    return [address for address in (LOCAL, EVERYWHERE) if address.startswith(incomplete)]


@click.command(short_help="look at decoded models in the browser")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=EXISTING)
@options(
    click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, metavar="N",
                 help="Port of the server; another one if it is taken."),
    click.option("--host", default=LOCAL, show_default=True, metavar="ADDRESS", shell_complete=_addresses,
                 help="Address that the server listens on; 0.0.0.0: all of this machine's, open to its network."),
    click.option("--html", "page", type=OUTPUT_FILE, metavar="FILE",
                 help="Write one HTML file that shows the model offline, or two side by side.  [default: none, but a "
                 "server]"),
    scene_option, images_option, config_option, set_option, device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def view(
    paths: tuple[Path, ...], port: int, host: str, page: Path | None, as_json: bool, chosen: Choices
) -> None:  # fmt: skip
    """Look at decoded models in the browser, drawn by this machine; two side by side.

    PATH is a .swz, a .ply, a run directory, or a folder with run directories below it. The cameras are those of
    --scene, else of the run's scene; without either they are made up around the Gaussians. Needs viser,
    the extra [viser] of sw-view; --html does not.
    """
    from sw_view.entries import about_page, find_all_entries, fixed_gaussians, open_entry

    plugins = load_plugins()
    entries = find_all_entries(paths)
    if page is not None:
        from sw_view.page_file import write_page, write_pair

        if len(entries) > MOST_IN_A_PAGE:
            raise click.UsageError(
                f"--html writes one model or two side by side, here are {len(entries)}: name files or run directories"
            )
        opened = [open_entry(entry, chosen, plugins) for entry in entries.values()]
        models = [(model, replace(about_page(each), note=note)) for each in opened
                  for model, note in [fixed_gaussians(each)]]  # fmt: skip
        around = next((each.around for each in opened if each.has_scene), opened[0].around)
        if len(models) == 1:
            write_page(models[0][0], page, models[0][1], around)
        else:
            titled = zip(models, entries, strict=True)
            write_pair([(model, replace(about, title=label)) for (model, about), label in titled], page, around)
        facts: dict[str, Any] = {"file": str(page), "bytes": page.stat().st_size}
        print_facts(facts, as_json, f"{facts['bytes']:,} bytes: {page}")
        return

    from sw_view.mode_pictures import PICTURE
    from sw_view.shown_models import ShownModel, shown_model
    from sw_view.viewer import Viewer, start_server, stop_server

    server = start_server(host, port)
    try:
        first = open_entry(next(iter(entries.values())), chosen, plugins)
        shown = shown_model(first)
        shown.draw(first.around.cameras[0].camera, PICTURE)  # loads or compiles the kernels: no browser waits for that
        red, green, blue = first.drawing.scene.background.tolist()

        def open_label(label: str) -> ShownModel:
            return shown if label == first.entry.label else shown_model(open_entry(entries[label], chosen, plugins))

        viewer = Viewer(server, first.around, list(entries), open_label, (red, green, blue))
        if as_json:
            print_json({"address": viewer.address})
        say(f"look at {viewer.address} (Ctrl-C ends it)")
        while True:
            viewer.pump(3600.0)
    except KeyboardInterrupt:
        say("ended")
    finally:
        stop_server(server)
