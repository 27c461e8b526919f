"""`sw build-kernels`: compile all native modules ahead of time."""

from __future__ import annotations

import click

from splatwizard_core.cli.options import console, debug_option, json_option, options, print_json
from splatwizard_core.cli.setup import say


@click.command("build-kernels", short_help="compile all native modules ahead of time")
@options(
    click.option(
        "--portable", is_flag=True,
        help="For any CPU of this architecture, with run-time dispatch.  [default: for this machine's CPU]",
    ),
    click.option(
        "--into-packages", is_flag=True,
        help="Put the binaries beside their sources, to be shipped in a wheel.  [default: this user's cache]",
    ),
    click.option(
        "--cuda", is_flag=True,
        help="Fail if the CUDA kernels cannot be built. For the GPUs here, or those of $TORCH_CUDA_ARCH_LIST."
        "  [default: with CUDA where torch and toolkit have it]",
    ),
    click.option("--force", is_flag=True, help="Compile also what is up to date."),
    click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Compilers at once.  [default: the cores]"),
    json_option, debug_option,
)  # fmt: skip
def build_kernels(
    portable: bool, into_packages: bool, cuda: bool, force: bool, jobs: int | None, as_json: bool
) -> None:
    """Compile the native modules of the core and of all plugins ahead of time; exit status 1 if one fails.

    Without this they are compiled when first used.
    """
    from rich.markup import escape
    from rich.table import Table

    from splatwizard_core.native.build import build_all
    from splatwizard_core.plugins import load_plugins

    march = "portable" if portable else "native"
    rows = build_all(
        load_plugins(), march=march, into_packages=into_packages, force=force, cuda=cuda, jobs=jobs, say=say
    )
    failed = [row for row in rows if row.error is not None]
    if as_json:
        print_json(
            {
                "modules": [
                    {
                        "name": r.name,
                        "state": r.state,
                        "seconds": r.seconds,
                        "path": None if r.path is None else str(r.path),
                        "error": r.error,
                    }
                    for r in rows
                ]
            }
        )
    else:
        table = Table()
        for column in ("module", "state", "seconds"):
            table.add_column(column)
        for row in rows:
            table.add_row(escape(row.name), row.state, f"{row.seconds:.1f}")
        console().print(table)
        for row in failed:
            click.echo(row.error, err=True)
    if failed:
        click.get_current_context().exit(1)
