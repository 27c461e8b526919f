"""Seconds until the one-file page of encoded scenes shows a picture, in Chromium.

    python benchmarks/first_picture.py FILE.swz ... [--copies 8] [--prefixes 4] [--repeats 3] [--size 960x540]

Counted from the navigation to the page until a pixel of the finished picture can be read and the browser begins its
next frame: "first" is the first picture, of the first cut in a file with cuts, "whole" the first one of all Gaussians.
With `--copies` the Gaussians of each file stand side by side so often, with noise of a thousandth on every number, and
are coded anew by `gaussians-quantized`, in so many packets (`--prefixes`). Chromium draws without a GPU here
(SwiftShader), which is part of the seconds. Bars for 4 MB: first 3 s on a desktop, 6 s on two shared cores; the whole
of wisp 12 s.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import torch
from sw_view import page_file
from sw_view.packing import pack

from splatwizard_core.api import ContainerWriter, GaussianModel
from splatwizard_core.tooling import PluginManager, load_plugins, open_model

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from headless_chromium import WEBGL, Chromium, find_chromium

TIMEOUT = 120.0
SEEN = """new MutationObserver(changes => {
  const gl = document.querySelector('canvas').getContext('webgl2'), { dataset } = document.documentElement;
  gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));  // waits until all is drawn
  for (const { attributeName } of changes) {
    const name = attributeName === 'data-first-whole' ? 'seenWhole' : 'seenFirst';
    requestAnimationFrame(() => { dataset[name] = performance.now().toFixed(1); });
  }
}).observe(document, { subtree: true, attributeFilter: ['data-first-frame', 'data-first-whole'] })"""
"""The page says when it has given a picture to the renderer; this, in the page, when that one was there to be seen."""


def enlarged(model: GaussianModel, copies: int) -> GaussianModel:
    """Return the Gaussians of a model so often, on a square lattice."""
    draw = torch.Generator().manual_seed(0)
    edge = 2 * float(model.means.detach().abs().quantile(0.9))
    side = int(copies**0.5 + 0.999)
    parts = []
    for copy in range(copies):
        part = {name: value.detach().clone() for name, value in model.named_parameters()}
        part["means"] += torch.tensor([copy % side, 0, copy // side]) * edge
        parts.append({name: v + 1e-3 * torch.randn(v.shape, generator=draw) for name, v in part.items()})
    return GaussianModel(**{name: torch.cat([part[name] for part in parts]) for name in parts[0]})


def coded(model: GaussianModel, prefixes: int, path: Path, plugins: PluginManager) -> None:
    """Write Gaussians as a file of 3DGS."""
    writer = ContainerWriter("3dgs", 1)
    writer.static["codec"] = "gaussians-quantized"
    settings = {"prefixes": prefixes} if prefixes > 1 else {}
    plugins.gaussian_codecs.load("gaussians-quantized")(plugins, **settings).encode(model, writer)
    writer.write(path)


@contextmanager
def opened(page: Path, size: tuple[int, int], folder: Path, timeout: float = TIMEOUT) -> Iterator[Chromium]:
    """Give a browser of its own that has drawn the whole picture of a page. Exits where that fails."""
    with tempfile.TemporaryDirectory(dir=folder) as profile:
        browser = Chromium(find_chromium() or "chromium", Path(profile), timeout=timeout, flags=WEBGL)
        try:
            browser.send("Page.addScriptToEvaluateOnNewDocument", source=SEEN)
            browser.open(page, width=size[0], height=size[1])
            until = time.monotonic() + timeout
            while browser.ask("document.documentElement.dataset.seenWhole") is None:
                if time.monotonic() > until or browser.ask("document.documentElement.dataset.state") == "failed":
                    sys.exit(f"{page}: no picture: {browser.ask('document.getElementById(`told`).textContent')}")
                time.sleep(0.1)
            yield browser
        finally:
            browser.close()


def seconds(page: Path, size: tuple[int, int], folder: Path) -> tuple[float, float]:
    """Return the seconds to the first picture and to the whole, in a browser of its own."""
    with opened(page, size, folder) as browser:
        found = browser.ask("(({ seenFirst, seenWhole }) => [seenFirst, seenWhole])(document.documentElement.dataset)")
    return float(found[0]) / 1000, float(found[1]) / 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--copies", type=int, default=1)
    parser.add_argument("--prefixes", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--size", default="960x540")
    given = parser.parse_args()
    if find_chromium() is None:
        sys.exit("no Chromium is installed")
    width, height = map(int, given.size.split("x"))
    plugins = load_plugins()
    print(f"{'bytes':>12} {'Gaussians':>10} {'page, MB':>9} {'first, s':>9} {'whole, s':>9}  file")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for path in given.files:
            shown = path
            if given.copies > 1:
                shown = folder / "scene.swz"
                source, _ = open_model(path, plugins, torch.device("cpu"))
                assert isinstance(source, GaussianModel)
                coded(enlarged(source, given.copies), given.prefixes, shown, plugins)
            model, _ = open_model(shown, plugins, torch.device("cpu"))
            packed = replace(pack(model), text=" " * (1 << 30))  # so that the page holds the file, whatever its size
            with patch.object(page_file, "pack", lambda _, packed=packed: packed):
                page_file.write_page(model, folder / "page.html", page_file.About(path.stem), None)
            found = [seconds(folder / "page.html", (width, height), folder) for _ in range(given.repeats)]
            first, whole = (statistics.median(each) for each in zip(*found, strict=True))
            size = (folder / "page.html").stat().st_size / 1e6
            print(f"{shown.stat().st_size:>12,} {model.num_rows:>10,} {size:>9.2f} {first:>9.2f} {whole:>9.2f}  {path}")


if __name__ == "__main__":
    main()
