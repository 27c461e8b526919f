"""Fixtures of pytest that every package with sw-kit installed has: plugins, a tiny scene, a few Gaussians.

pytest imports this module in every session, so it imports nothing heavy before a test asks for a fixture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from splatwizard_core.api import GaussianModel, PluginManager, Rasterizer, Scene


@pytest.fixture(scope="session")
def sw_plugins() -> PluginManager:
    """Return all installed plugins."""
    from splatwizard_core.tooling import load_plugins

    return load_plugins()


@pytest.fixture(scope="session")
def sw_scene() -> Scene:
    """Return the scene `demo:tiny`: a few small pictures, and start points."""
    from sw_kit.samples import tiny_scene

    return tiny_scene()


@pytest.fixture
def sw_gaussians() -> GaussianModel:
    """Return a fresh model of 200 Gaussians with values as training leaves them, in view of `sw_scene`."""
    from sw_kit.samples import some_gaussians

    return some_gaussians()


@pytest.fixture(scope="session")
def sw_rasterizer() -> Rasterizer:
    """Return the reference rasterizer, on the CPU."""
    from sw_reference.rasterizer import ReferenceRasterizer

    return ReferenceRasterizer()
