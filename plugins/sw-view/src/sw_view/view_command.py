"""`sw view`: look at decoded models in the browser."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from splatwizard_core.tooling import (
    EXISTING,
    OUTPUT_PAGE,
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

if TYPE_CHECKING:
    from sw_view.arriving import Arriving
    from sw_view.viewer import Viewer

MOST_IN_A_PAGE = 2
POLL = 0.25
"""Seconds between looks at a download, while nobody moves."""
LOCAL, EVERYWHERE = "127.0.0.1", "0.0.0.0"


def _addresses(_context: click.Context, _parameter: click.Parameter, incomplete: str) -> list[str]:
    return [address for address in (LOCAL, EVERYWHERE) if address.startswith(incomplete)]


class PathOrAddress(type(EXISTING)):  # type: ignore[misc]  # the core's type of paths
    """A path that is there, or the http(s) address of a file."""

    def convert(self, value: str | Path, param: click.Parameter | None, ctx: click.Context | None) -> str | Path:
        if str(value).startswith(("http://", "https://")):
            return str(value)
        found: Path = super().convert(value, param, ctx)
        return found


@click.command(short_help="look at decoded models in the browser")
@click.argument("paths", metavar="PATH...", nargs=-1, required=True, type=PathOrAddress(EXISTING.check))
@options(
    click.option("--port", type=click.IntRange(0, 65535), default=8080, show_default=True, metavar="N",
                 help="Port of the server; another one if it is taken."),
    click.option("--host", default=LOCAL, show_default=True, metavar="ADDRESS", shell_complete=_addresses,
                 help="Address that the server listens on; 0.0.0.0: all of this machine's, open to its network."),
    click.option("--html", "page", type=OUTPUT_PAGE, metavar="FILE",
                 help="Write one HTML file that shows the model offline, or two side by side.  [default: none, but a "
                 "server]"),
    click.option("--photos", type=click.IntRange(0), default=4, show_default=True, metavar="N",
                 help="With --html: test photographs that the page puts beside its picture."),
    scene_option, images_option, config_option, set_option, device_option, json_option, debug_option,
)  # fmt: skip
@takes_choices
def view(
    paths: tuple[str | Path, ...], port: int, host: str, page: Path | None, photos: int, as_json: bool, chosen: Choices
) -> None:  # fmt: skip
    """Look at decoded models in the browser, drawn by this machine; two side by side.

    PATH is a .swz, a .ply, a run directory, or a folder with run directories below it, or one http(s) address of a
    .swz: of a file with cuts its first packets are shown while the others arrive. The cameras are those of
    --scene, else of the run's scene; without either they are made up around the Gaussians. Needs viser,
    the extra [viser] of sw-view; --html does not.
    """
    if any(isinstance(path, str) for path in paths) and (len(paths) > 1 or page is not None):
        raise click.UsageError("one address is shown alone, and not with --html: download it")
    if page is not None:
        _write_page([Path(path) for path in paths], page, photos, as_json, chosen)
        return
    with tempfile.TemporaryDirectory() as folder:  # of a file that arrives
        _serve(paths, Path(folder), host, port, as_json, chosen)


def _write_page(paths: Sequence[Path], page: Path, photos: int, as_json: bool, chosen: Choices) -> None:
    from sw_view.entries import about_page, find_all_entries, for_page, open_entry
    from sw_view.page_file import write_page, write_pair
    from sw_view.photographs import photographs_of

    plugins, entries = load_plugins(), find_all_entries(paths)
    if len(entries) > MOST_IN_A_PAGE:
        raise click.UsageError(
            f"--html writes one model or two side by side, here are {len(entries)}: name files or run directories"
        )
    opened = [open_entry(entry, chosen, plugins) for entry in entries.values()]
    shown = next((each for each in opened if each.has_scene), opened[0])
    around = shown.around
    pictures = photographs_of(around.cameras, photos, shown.drawing.scene.background)
    models = [(model, replace(about_page(each), note=note, photographs=pictures)) for each in opened
              for model, note in [for_page(each)]]  # fmt: skip
    if len(models) == 1:
        write_page(models[0][0], page, models[0][1], around)
    else:
        titled = zip(models, entries, strict=True)
        write_pair([(model, replace(about, title=label)) for (model, about), label in titled], page, around)
    facts: dict[str, Any] = {"file": str(page), "bytes": page.stat().st_size}
    print_facts(facts, as_json, f"{facts['bytes']:,} bytes: {page}")


def _serve(
    paths: Sequence[str | Path], folder: Path, host: str, port: int, as_json: bool, chosen: Choices
) -> None:  # fmt: skip
    from sw_view.arriving import Arriving
    from sw_view.entries import Entry, find_all_entries, open_entry
    from sw_view.mode_pictures import PICTURE
    from sw_view.shown_models import ShownModel, shown_model
    from sw_view.viewer import Viewer, start_server, stop_server

    plugins, arriving = load_plugins(), None
    if isinstance(paths[0], str):
        arriving = Arriving(paths[0], folder)
        arriving.wait()
        entries = {paths[0]: Entry(paths[0], arriving.file, None)}
    else:
        entries = find_all_entries([Path(path) for path in paths])
    server = start_server(host, port)
    try:
        first = open_entry(next(iter(entries.values())), chosen, plugins)
        opened = {first.entry.label: shown_model(first)}
        # Loads or compiles the kernels: no browser waits for that.
        opened[first.entry.label].draw(first.around.cameras[0].camera, PICTURE)
        red, green, blue = first.drawing.scene.background.tolist()

        def open_label(label: str) -> ShownModel:
            return opened.pop(label, None) or shown_model(open_entry(entries[label], chosen, plugins))

        viewer = Viewer(server, first.around, list(entries), open_label, (red, green, blue))
        if as_json:
            print_json({"address": viewer.address})
        say(f"look at {viewer.address} (Ctrl-C ends it)")
        if arriving is not None:
            show_arriving(viewer, arriving, first.entry.label)
        while True:
            viewer.pump(3600.0)
    except KeyboardInterrupt:
        say("ended")
    finally:
        stop_server(server)


def show_arriving(viewer: Viewer, arriving: Arriving, label: str) -> None:
    """Show the packets of a file that are there until all are, or no more come."""
    shown = arriving.packets
    while True:
        ended = arriving.ended
        viewer.note = arriving.told
        if arriving.packets > shown or (ended and viewer.note):
            shown = arriving.packets
            viewer.renew(label)
        if ended:
            return
        viewer.pump(POLL)
