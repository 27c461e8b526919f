"""The pinhole camera: geometry alone, no picture."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from splatwizard_core.errors import ShapeError


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera in OpenCV axes (x right, y down, z forward), world to camera, pixel units.

    Pixel (i, j) covers the square [i, i+1) x [j, j+1); its centre is (i + 0.5, j + 0.5), and the
    principal point lives in the same frame. A point X projects to u = fx tx/tz + cx with t = R X + tau.

    width, height   pixels
    fx, fy          focal lengths, pixels of this resolution
    cx, cy          principal point, pixels of this resolution
    R               [3,3] world -> camera rotation
    tau             [3] world -> camera translation, world units
    near, far       z range that is drawn, world units
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    R: Tensor
    tau: Tensor
    near: float = 0.2
    far: float = 1e10

    def __post_init__(self) -> None:
        if self.R.shape != (3, 3) or self.tau.shape != (3,):
            raise ShapeError(f"Camera needs R [3,3] and tau [3], got {tuple(self.R.shape)} and {tuple(self.tau.shape)}")

    @classmethod
    def look_at(
        cls, eye: Tensor, target: Tensor, up: Tensor, *, width: int, height: int, fov_x: float, near: float = 0.2
    ) -> Camera:
        """A camera at `eye` that looks at `target`, principal point in the image centre, square pixels.

        eye, target     [3] world units
        up              [3] the world direction that points up in the picture
        fov_x           horizontal field of view, radians
        """
        forward = torch.nn.functional.normalize(target - eye, dim=0)
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=0)
        down = torch.linalg.cross(forward, right)
        R = torch.stack([right, down, forward])
        focal = width / (2 * math.tan(fov_x / 2))
        return cls(width, height, focal, focal, width / 2, height / 2, R, -R @ eye, near=near)

    @cached_property
    def center(self) -> Tensor:
        """Camera centre in the world, [3]."""
        return -self.R.T @ self.tau

    @cached_property
    def pose(self) -> tuple[float, ...]:
        """R row by row, then tau: 12 numbers on the host, read once (from a GPU, reading waits for it)."""
        return (*self.R.detach().flatten().tolist(), *self.tau.detach().tolist())

    @property
    def tan_half_fov(self) -> tuple[float, float]:
        """(W / 2 fx, H / 2 fy)."""
        return self.width / (2 * self.fx), self.height / (2 * self.fy)

    @property
    def fov_x(self) -> float:
        """Horizontal field of view, radians."""
        return 2 * math.atan(self.tan_half_fov[0])

    @property
    def fov_y(self) -> float:
        """Vertical field of view, radians."""
        return 2 * math.atan(self.tan_half_fov[1])

    @property
    def viewmat(self) -> Tensor:
        """World -> camera, [4,4]."""
        mat = torch.eye(4, dtype=self.R.dtype, device=self.R.device)
        mat[:3, :3], mat[:3, 3] = self.R, self.tau
        return mat

    @property
    def K(self) -> Tensor:  # noqa: N802 (the field's name)
        """Intrinsics, [3,3]."""
        rows = [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
        return torch.tensor(rows, dtype=self.R.dtype, device=self.R.device)

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Camera:
        """The same camera with R and tau on another device or in another dtype; kept, so that it is moved once."""
        kept = self._moved.get((str(device), dtype))
        if kept is not None:
            return kept
        R, tau = (each.to(device=device, dtype=dtype) for each in (self.R, self.tau))
        if R is self.R and tau is self.tau:
            return self
        moved = replace(self, R=R, tau=tau)
        if R.dtype == self.R.dtype and tau.dtype == self.tau.dtype and ("pose" in vars(self) or not self.R.is_cuda):
            vars(moved)["pose"] = self.pose  # the numbers stay: nobody need fetch them back
        if not (R.requires_grad or tau.requires_grad):
            self._moved[str(device), dtype] = moved
        return moved

    @cached_property
    def _moved(self) -> dict[tuple[str, torch.dtype | None], Camera]:
        return {}

    def resized(self, width: int, height: int) -> Camera:
        """The same view at another resolution: intrinsics scale per axis, so the field of view is kept."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self, width=width, height=height, fx=self.fx * sx, fy=self.fy * sy, cx=self.cx * sx, cy=self.cy * sy
        )
