"""One HTML file that shows a scene in any browser, with nothing else: Gaussians, cameras, viewer.

The viewer under page/ projects and blends as the rasterizers do: EWA with the low-pass of the file (0.3 px^2),
alpha = min(0.99, ...), none below 1/255. Source: 3D Gaussian Splatting (arXiv 2308.04079).
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sw_gaussians.render_options import antialias_of, eps2d_of

from splatwizard_core.api import Camera, GaussianModel, SplatModel, replacing
from sw_view.coded_file import with_file, with_live
from sw_view.packing import Packed, pack
from sw_view.shown_cameras import NamedCamera, Surroundings, surroundings_about

SCRIPTS = ("data.js", "renderer.js", "camera.js", "main.js")
POLICY = (
    "default-src 'none'; script-src {script} 'wasm-unsafe-eval'; style-src {style}; worker-src blob:; img-src data:"
)
"""Policy of the page (CSP): nothing but its own script, style, workers, and an empty icon. It asks no network."""
MADE_UP = "Nothing was known of the scene's cameras: these were made up around the Gaussians, with -y as up."
LIVE = "The method's Gaussians depend on the camera: they are computed anew wherever it comes to rest."
FILE_NAME = "scene.html"
"""Of a run directory; report.html has a link to it."""


@dataclass(frozen=True)
class About:
    """Facts that the page tells of a scene, and how its file wants it drawn.

    title       of the page
    method      name of the method; None: nobody knows
    size        bytes of the encoded file; None: there is none
    background  [3] in 0..1
    eps2d       low-pass, px^2
    antialias   whether opacities are compensated for it
    note        a sentence for the help, about the cameras or the model
    photographs data: URIs of pictures by the place of their camera
    """

    title: str
    method: str | None = None
    size: int | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    eps2d: float = 0.3
    antialias: bool = False
    note: str = ""
    photographs: Mapping[int, str] = field(default_factory=dict)


def write_page(
    model: SplatModel | Packed, path: str | os.PathLike[str], about: About, around: Surroundings | None
) -> None:
    """Write the page of explicit Gaussians, or of what is packed already; the file is complete or absent.

    around  cameras to look from; None: made up around the Gaussians
    Raises SceneError for a model whose Gaussians depend on the camera, or that has none.
    """
    packed = _packed(model)
    text = _page(packed, about, around or surroundings_about(packed.means))
    with replacing(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def write_pair(
    models: Sequence[tuple[SplatModel | Packed, About]], path: str | os.PathLike[str], around: Surroundings | None
) -> None:
    """Write one page of several models side by side, looked at from one place; complete or absent.

    around  cameras of all of them; None: made up around the first one's Gaussians
    Raises SceneError as `write_page` does.
    """
    frames = []
    for model, about in models:
        packed = _packed(model)
        around = around or surroundings_about(packed.means)
        page = html.escape(_page(packed, about, around))
        frames.append(f'<iframe title="{html.escape(about.title)}" srcdoc="{page}"></iframe>\n')
    parts = {"TITLE": html.escape(" | ".join(about.title for _, about in models)), "FRAMES": "".join(frames)}
    pieces = _text("pair.html").split("@TITLE@")
    text = parts["TITLE"].join(pieces).replace("@FRAMES@", parts["FRAMES"])
    with replacing(path) as temporary:
        Path(temporary).write_text(text, encoding="utf-8")


def _packed(model: SplatModel | Packed) -> Packed:
    return model if isinstance(model, Packed) else with_file(model, pack(model))


def export_page(model: SplatModel, path: str | os.PathLike[str]) -> None:
    """Write the page of a model of which nothing but its file is known (`sw export`): cameras are made up around it."""
    about = About(Path(path).stem, eps2d=eps2d_of(model), antialias=antialias_of(model), note=MADE_UP)
    if isinstance(model, GaussianModel):
        write_page(model, path, about, None)
        return
    around = surroundings_about(getattr(model, model.ROWS[0]).detach().float().cpu().numpy()[:, :3])
    live = with_live(model, Path(str(model.origin.get("file", ""))), [each.camera for each in around.cameras])
    write_page(live or model, path, replace(about, note=f"{LIVE} {MADE_UP}"), around)


def _page(packed: Packed, about: About, around: Surroundings) -> str:
    facts = {
        **packed.facts,
        "background": about.background, "eps2d": about.eps2d, "antialias": int(about.antialias),
        "near": around.cameras[0].camera.near, "up": _numbers(around.up), "pivot": _numbers(around.pivot),
        "size": around.size, "cameras": [
            _camera(each) | ({"photo": about.photographs[i]} if i in about.photographs else {})
            for i, each in enumerate(around.cameras)
        ],
    }  # fmt: skip
    told = [f"{packed.facts['count']:,} Gaussians"]
    told += [f"of {packed.facts['anchors']:,} anchors"] if "anchors" in packed.facts else []
    told += [] if about.method is None else [about.method]
    told += [] if about.size is None else [f"{about.size:,} bytes encoded"]
    style, script = _text("style.css"), "".join(_text(name) for name in SCRIPTS)
    parts = {
        "POLICY": POLICY.format(script=_sha256(f"\n'use strict';\n{script}"), style=_sha256(f"\n{style}")),
        "TITLE": html.escape(about.title),
        "STYLE": style,
        "FACTS_SHOWN": "".join(f"<span>{html.escape(each)}</span>" for each in told),
        "NOTE": html.escape(f"{about.note} Written by Splatwizard; the file needs no network.".strip()),
        "FACTS": json.dumps(facts, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "VERTEX": _text("splat.vert"),
        "FRAGMENT": _text("splat.frag"),
        "WORKER": _text("sort.js"),
        "SCRIPT": script,
        "GAUSSIANS": packed.text,
        "DECODER": packed.decoder,
    }
    # In one pass: what is put in is not looked at again.
    pieces = _text("page.html").split("@")
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces))


def _camera(each: NamedCamera) -> dict[str, Any]:
    camera: Camera = each.camera
    return {
        "name": each.name, "width": camera.width, "height": camera.height,
        "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
        "R": _numbers(camera.R.cpu().numpy().ravel()), "tau": _numbers(camera.tau.cpu().numpy()),
    }  # fmt: skip


def _numbers(values: NDArray[Any]) -> list[float]:
    return [float(f"{value:.9g}") for value in np.asarray(values, np.float64)]


def _sha256(text: str) -> str:
    """Return an inline script or style as a policy names it."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode('ascii')}'"


def _text(name: str) -> str:
    return (files("sw_view") / "page" / name).read_text(encoding="utf-8")
