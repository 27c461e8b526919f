"""Registers the command `sw bench` and the executors `local` and `slurm`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_commands(registry: Registry) -> None:
    registry.add("bench", "sw_bench.command:bench", position=0.5,
                 summary="methods x scenes x rates x seeds: a sweep that goes on after any kill")  # fmt: skip


@hookimpl
def register_executors(registry: Registry) -> None:
    registry.add("local", "sw_bench.local:LocalExecutor",
                 summary="processes on this machine: one per GPU, or a share of the cores each")  # fmt: skip
    registry.add("slurm", "sw_bench.slurm:SlurmExecutor",
                 summary="jobs of a Slurm cluster, through submitit")  # fmt: skip
