"""`sw build-kernels`: compile all native modules ahead of time."""

from __future__ import annotations

from dataclasses import asdict

import click

from splatwizard_core.tooling import (
    debug_option,
    json_option,
    load_plugins,
    options,
    print_json,
    print_table,
    say,
)
from sw_doctor.building import build_all
from sw_doctor.declared_modules import declared_modules


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
    rows = build_all(
        declared_modules(load_plugins()), march="portable" if portable else "native", into_packages=into_packages,
        force=force, cuda=cuda, jobs=jobs, say=say,
    )  # fmt: skip
    if as_json:
        print_json({"modules": [{**asdict(row), "path": row.path and str(row.path)} for row in rows]})
    else:
        print_table(["module", "state", "seconds"], [[r.name, r.state, f"{r.seconds:.1f}"] for r in rows])
        for row in (r for r in rows if r.error is not None):
            click.echo(row.error, err=True)
    if any(row.error is not None for row in rows):
        click.get_current_context().exit(1)
