"""Requests of a viewer of a streamed SOG: the PlayCanvas engine in headless Chromium, under three budgets of splats.

    npm install playcanvas
    python benchmarks/streamed_requests.py DIR/lod-meta.json --engine node_modules/playcanvas/build/playcanvas.mjs

The camera looks at the whole scene; the budget is the coarsest level, then a half and all of the finest one. Told are
units and bytes that the page asked for until then by level, of those that there are, and the share of the picture that
is drawn. `--pictures DIR` keeps the pictures.
"""

from __future__ import annotations

import argparse
import http.server
import json
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from PIL import Image
from sw_interchange.streamed_sog import Index, parse_index

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from headless_chromium import WEBGL, Chromium, find_chromium

SIZE = (960, 540)
QUIET, MOST = 8.0, 90.0
"""Seconds without a request after which the viewer has what it wants; seconds at most."""
PAGE = """<!doctype html><style>body{margin:0}</style><canvas id=c width=%d height=%d></canvas>
<script type=module>
import * as pc from '/engine.mjs';
const app = new pc.Application(document.getElementById('c'), { graphicsDeviceOptions: { antialias: false } });
app.start();
const [low, high, budget] = %s;
app.scene.gsplat.splatBudget = budget;
window.budget = (count) => { app.scene.gsplat.splatBudget = count; };
const eye = new pc.Entity();
eye.addComponent('camera', { clearColor: new pc.Color(0, 0, 0), fov: 60 });
const size = Math.hypot(...high.map((x, k) => x - low[k]));
eye.setPosition(...low.map((x, k) => (x + high[k]) / 2 + (k == 2 ? -0.6 * size : 0)));
app.root.addChild(eye);
eye.lookAt(...low.map((x, k) => (x + high[k]) / 2), 0, -1, 0);
const asset = new pc.Asset('scene', 'gsplat', { url: '/scene/lod-meta.json' });
asset.on('load', () => {
  const scene = new pc.Entity();
  scene.addComponent('gsplat', { asset, unified: true });
  app.root.addChild(scene);
});
app.assets.add(asset);
app.assets.load(asset);
</script>"""


class Handler(http.server.BaseHTTPRequestHandler):
    """Serves the page, the engine and one folder, and keeps what of the folder was asked for."""

    def __init__(self, page: str, engine: Path, folder: Path, asked: list[str], *rest: object) -> None:
        self.page, self.engine, self.folder, self.asked = page, engine, folder, asked
        super().__init__(*rest)  # type: ignore[arg-type]

    def do_GET(self) -> None:
        content, kind = self.page.encode(), "text/html"
        if self.path == "/engine.mjs":
            content, kind = self.engine.read_bytes(), "text/javascript"
        elif self.path.startswith("/scene/"):
            name = self.path.removeprefix("/scene/").partition("?")[0]
            path = (self.folder / name).resolve()
            if not path.is_relative_to(self.folder) or not path.is_file():
                self.send_error(404)
                return
            self.asked.append(name)
            content, kind = path.read_bytes(), "application/octet-stream"
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: object) -> None:
        pass


def settle(asked: list[str]) -> None:
    """Wait until nothing was asked for during a while."""
    started = last = time.monotonic()
    seen = len(asked)
    while (now := time.monotonic()) - last < QUIET and now - started < MOST:
        time.sleep(0.2)
        if len(asked) > seen:
            seen, last = len(asked), now


def told(index: Index, folder: Path, asked: list[str]) -> str:
    """Units of each level that were asked for, and bytes of all."""
    level_of = {index.units[rows.file]: level for leaf in index.leaves for level, rows in leaf.levels.items()}
    units = [sum(level == k and unit in asked for unit, level in level_of.items()) for k in range(index.levels)]
    there = [sum(level == k for level in level_of.values()) for k in range(index.levels)]
    read = sum((folder / name).stat().st_size for name in set(asked))
    return ", ".join(f"{a} of {b}" for a, b in zip(units, there, strict=True)) + f"  {read:>12,}"


def look(index: Index, folder: Path, engine: Path, pictures: Path | None, say: Callable[[str], None]) -> None:
    """Open the page and raise its budget."""
    finest, coarsest = index.counts[0], index.counts[-1]
    places = np.array([[leaf.low, leaf.high] for leaf in index.leaves])
    low, high = np.quantile(places.mean(axis=1), (0.1, 0.9), axis=0).tolist()
    asked: list[str] = []
    page = PAGE % (*SIZE, json.dumps([low, high, coarsest]))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, page, engine, folder, asked))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    every = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    say(f"{index.counts} Gaussians, {len(index.leaves)} places, {every:,} bytes; units asked for, finest level first")
    with tempfile.TemporaryDirectory() as profile:
        browser = Chromium(find_chromium() or "chromium", Path(profile), flags=WEBGL)
        try:
            browser.send("Emulation.setDeviceMetricsOverride", width=SIZE[0], height=SIZE[1], deviceScaleFactor=1,
                         mobile=False)  # fmt: skip
            browser.send("Page.navigate", url=f"http://127.0.0.1:{server.server_port}/")
            for budget in (coarsest, finest // 2, finest):
                while asked and browser.ask("typeof window.budget") != "function":
                    time.sleep(0.1)
                if asked:
                    browser.ask(f"window.budget({budget})")
                settle(asked)
                path = (pictures or Path(profile)) / f"{budget}.png"
                browser.picture(path, whole=False)
                drawn = np.asarray(Image.open(path).convert("RGB")).max(axis=2) > 8
                say(f"budget {budget:>9,}: {told(index, folder, asked)} bytes, {100 * drawn.mean():.0f} % drawn")
            for line in browser.complaints():
                if "GPU stall" not in line:  # of the software renderer
                    say(line)
        finally:
            browser.close()
            server.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("index", type=Path)
    parser.add_argument("--engine", type=Path, required=True)
    parser.add_argument("--pictures", type=Path)
    given = parser.parse_args()
    if find_chromium() is None:
        sys.exit("no Chromium is installed")
    folder = given.index.resolve().parent
    look(parse_index(given.index.read_bytes(), given.index.name), folder, given.engine, given.pictures, print)


if __name__ == "__main__":
    main()
