"""Made-up scenes for the tests of the coder."""

import numpy as np
import torch

from sw_wisp.cube import Cube
from sw_wisp.eight_bits import EightBitLayer
from sw_wisp.file import Scene
from sw_wisp.numbers import BASE_STEPS


def layers(seed: int = 0) -> tuple[EightBitLayer, ...]:
    """An appearance network of the shapes that the method has."""
    rng = np.random.default_rng(seed)
    shapes = [(45, 12, False), (32, 15, True), (45, 32, True)]
    return tuple(
        EightBitLayer.nearest(rng.normal(0, 0.1, (rows, columns)), rng.normal(0, 0.1, rows) if bias else None)
        for rows, columns, bias in shapes
    )


def made_up(n: int, *, seed: int = 0, subsets: int = 1, planes: int = 0, spread: float = 3.0, **changes) -> Scene:
    """Splats on a wavy sheet; numbers smooth in space plus noise of `spread` steps."""
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.random((n, 3)))
    means[:, 2] = 0.2 * torch.sin(6 * means[:, 0]) * means[:, 1]
    scales = torch.from_numpy(0.004 * np.exp(rng.normal(0, 0.7, n)))
    cube = Cube.around(means) if n else Cube((0.0, 0.0, 0.0), 1.0)
    opacities = torch.from_numpy(rng.normal(0, 2, n))
    levels, cells = cube.settled(means, cube.levels(scales, 1.0), opacities)
    steps = np.array(BASE_STEPS)
    trend = np.sin(4 * means.numpy()[:, :1] + np.arange(22)) * 4 * steps
    values = trend + rng.normal(0, spread, (n, 22)) * steps * (levels.numpy()[:, None] / 9)
    values[:, 0] = opacities
    labels = rng.choice(subsets, n) if subsets > 1 else None
    return Scene(cube, levels, cells, torch.from_numpy(values), layers(), subsets=labels, planes=planes, **changes)
