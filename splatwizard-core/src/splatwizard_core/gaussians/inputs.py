"""Activated Gaussians as plain tensors: the input of every rasterizer."""

from __future__ import annotations

import functools
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias

import torch
from torch import Tensor

from splatwizard_core.errors import ShapeError

Layout: TypeAlias = "tuple[tuple[str, torch.Size, torch.dtype, torch.device], ...]"
"""Name, shape, dtype and device of every tensor that is there, means first: all that checks look at."""

SH_C0 = 0.28209479177387814
"""Value of the basis function of degree 0."""


def rgb_to_dc(rgb: Tensor) -> Tensor:
    """The degree-0 coefficient whose colour is `rgb` from every side; any shape."""
    return (rgb - 0.5) / SH_C0


@dataclass
class SH:
    """Spherical-harmonics colours in exactly one storage form. K = (degree + 1)^2 coefficients, then RGB.

    dense           [N,K,3]
    dc + rest       [N,1,3] and [N,K-1,3]; dc alone at degree 0
    codebook        [M,K,3] with indices, or [M,K-1,3] together with dc
    indices         [N] int64, row of the codebook for each Gaussian
    active_degree   bands above it are not evaluated and get exactly zero gradient
    """

    dense: Tensor | None = None
    dc: Tensor | None = None
    rest: Tensor | None = None
    codebook: Tensor | None = None
    indices: Tensor | None = None
    active_degree: int = 3

    @classmethod
    def from_rgb(cls, rgb: Tensor) -> SH:
        """Degree 0: colours [N,3] that are the same from every side."""
        return cls(dense=rgb_to_dc(rgb)[:, None], active_degree=0)

    def to_dense(self) -> Tensor:
        """[N,K,3], differentiable with respect to whatever is stored."""
        if self.dense is not None:
            return self.dense
        rest = self.rest
        if self.codebook is not None:
            assert self.indices is not None
            rest = self.codebook.index_select(0, self.indices)
        if self.dc is None:
            assert rest is not None
            return rest
        return self.dc if rest is None else torch.cat([self.dc, rest], dim=1)


def check_shape(name: str, shape: torch.Size, expected: tuple[int | str, ...]) -> None:
    """Raise ShapeError unless the tensor's shape is `expected`; a string there stands for any size."""
    if len(shape) != len(expected) or any(a != e for a, e in zip(shape, expected, strict=True) if isinstance(e, int)):
        wanted = ", ".join(str(e) for e in expected)
        raise ShapeError(f"{name} must be [{wanted}], got {list(shape)}")


_SIZES: dict[str, tuple[int | str, ...]] = {
    "means": ("N", 3),
    "opacities": ("N",),
    "scales": ("rows", "2 or 3"),
    "quats": ("rows", 4),
    "cov3d": ("N", 6),
    "geom_indices": ("N",),
    "scale_factors": ("N",),
    "colors": ("N", "C"),
    "features": ("N", "E"),
    "visible": ("N",),
    "sh.dense": ("N", "K", 3),
    "sh.dc": ("N", 1, 3),
    "sh.rest": ("N", "K-1", 3),
    "sh.codebook": ("M", "K", 3),
    "sh.indices": ("N",),
}
"""The tensors of GaussianInputs and their sizes; "rows" is N, or M with `geom_indices`."""


def _rows_of(table: Tensor, indices: Tensor) -> Tensor:
    """Rows of a table. On the CPU several threads sum the gradient of `table[indices]` in any order, not of this."""
    return table.index_select(0, indices)


@dataclass
class GaussianInputs:
    """Activated Gaussians, all tensors on one device.

    means           [N,3] world units
    opacities       [N] in [0,1]
    scales, quats   [N,3] > 0 (standard deviations, world units) and [N,4] (w,x,y,z), any norm;
                    [M,3], [M,4] with geom_indices; scales [N,2] for surfels
    cov3d           [N,6] upper triangle xx,xy,xz,yy,yz,zz; excludes scales and quats
    geom_indices    [N] int64 rows of scales and quats
    scale_factors   [N] multiplies the (indexed) scales
    sh XOR colors   spherical harmonics, or [N,C] colours used as they are
    features        [N,E] extra channels composited with the same weights
    visible         [N] bool, Gaussians marked False are not drawn
    extras          what the model wants its losses and tasks to see again in `RenderResult.extras`
                    (a rate, a selection mask); no rasterizer looks at it
    """

    means: Tensor
    opacities: Tensor
    scales: Tensor | None = None
    quats: Tensor | None = None
    cov3d: Tensor | None = None
    geom_indices: Tensor | None = None
    scale_factors: Tensor | None = None
    sh: SH | None = None
    colors: Tensor | None = None
    features: Tensor | None = None
    visible: Tensor | None = None
    extras: dict[str, Any] = field(default_factory=dict)

    def __len__(self) -> int:
        return self.means.shape[0]

    def tensors(self) -> dict[str, Tensor]:
        """Every tensor that is present, by field name (`sh.dense`, `sh.dc`, ... for colours)."""
        held = dict(vars(self))
        if self.sh is not None:
            held |= {f"sh.{name}": stored for name, stored in vars(self.sh).items()}
        return {name: held[name] for name in _SIZES if held.get(name) is not None}

    def gathered(self, *, geometry: bool = True, colors: bool = True) -> GaussianInputs:
        """A shallow copy in which every Gaussian has its own scales, quaternion and colours; differentiable.

        geometry, colors    False leaves the shapes, or the colours, in the form in which they are stored
        """
        g = replace(self)
        if geometry and g.scales is not None and g.quats is not None:
            if g.geom_indices is not None:
                g.scales, g.quats = _rows_of(g.scales, g.geom_indices), _rows_of(g.quats, g.geom_indices)
            if g.scale_factors is not None:
                g.scales = g.scales * g.scale_factors[:, None]
            g.geom_indices = g.scale_factors = None
        if colors and g.sh is not None and g.sh.codebook is not None and g.sh.indices is not None:
            rest = _rows_of(g.sh.codebook, g.sh.indices)
            own: dict[str, Tensor] = {"dense": rest} if g.sh.dc is None else {"dc": g.sh.dc, "rest": rest}
            g.sh = SH(**own, active_degree=g.sh.active_degree)
        return g

    def requires_grad(self) -> bool:
        """Whether autograd would record anything for these inputs now."""
        if not torch.is_grad_enabled():
            return False
        return self.means.requires_grad or any(t.requires_grad for t in self.tensors().values())

    def validate(self) -> Layout:
        """Return the layout, or raise ShapeError if the fields do not fit together (values are no matter of shape)."""
        layout = tuple([(name, t.shape, t.dtype, t.device) for name, t in self.tensors().items()])
        _check_layout(layout, None if self.sh is None else self.sh.active_degree)
        return layout


@functools.lru_cache(maxsize=64)  # a training asks for the same at every step
def _check_layout(layout: Layout, sh_degree: int | None) -> None:
    shapes = {name: shape for name, shape, _, _ in layout}
    n, device = shapes["means"][0], layout[0][3]
    rows = "M" if "geom_indices" in shapes else n
    sizes: dict[int | str, int | str] = {"N": n, "rows": rows}
    for name, shape, _, there in layout:
        check_shape(f"GaussianInputs.{name}", shape, tuple(sizes.get(size, size) for size in _SIZES[name]))
        if there != device:
            raise ShapeError(f"GaussianInputs mixes devices: {name} is on {there}, means on {device}")
    if "cov3d" in shapes:
        if shapes.keys() & {"scales", "quats", "geom_indices", "scale_factors"}:
            raise ShapeError("GaussianInputs.cov3d excludes scales, quats, geom_indices and scale_factors")
    elif not {"scales", "quats"} <= shapes.keys():
        raise ShapeError("GaussianInputs needs either scales and quats, or cov3d")
    elif (scales := shapes["scales"])[1] not in (2, 3) or scales[0] != shapes["quats"][0]:
        raise ShapeError(
            f"GaussianInputs.scales must be [{rows}, 3], or [{rows}, 2] for surfels, and as long as quats; "
            f"got {list(scales)} and {list(shapes['quats'])}"
        )
    if (sh_degree is None) == ("colors" not in shapes):
        raise ShapeError("GaussianInputs needs either sh or colors")
    if sh_degree is not None:
        _check_sh({name[3:]: shape for name, shape in shapes.items() if name.startswith("sh.")}, sh_degree)


def _check_sh(shapes: dict[str, torch.Size], degree: int) -> None:
    """Raise ShapeError unless exactly one storage form is there: of two it would be open which one is drawn."""
    forms = ({"dense"}, {"dc"}, {"dc", "rest"}, {"codebook", "indices"}, {"dc", "codebook", "indices"})
    if set(shapes) not in forms:
        raise ShapeError(
            f"SH holds {', '.join(sorted(shapes)) or 'nothing'}; it must be dense, or dc (and rest), "
            "or codebook and indices (and dc)"
        )
    held, needed = sum(shape[1] for name, shape in shapes.items() if name != "indices"), (degree + 1) ** 2
    if held < needed:
        raise ShapeError(f"SH degree {degree} needs {needed} coefficients, here are {held}")
