"""Registers the executor `ray`."""

from splatwizard_core.api import Registry, hookimpl


@hookimpl
def register_executors(registry: Registry) -> None:
    registry.add("ray", "sw_ray.executor:RayExecutor", summary="tasks of a Ray cluster")
