"""Frames a second of the one-file page of `sw view --html`, and seconds to its first picture, in Chromium.

    python benchmarks/page_frames.py [--gaussians 200000,1000000,3000000] [--size 960x540] [--seconds 10]

The camera is turned by the pointer in every frame, so all of them are drawn; of frames that take over 50 ms the page
draws fewer pixels while the camera moves, which is told as the share of the width. Gaussians are made up: a ball of
them whose size falls with their number, as in trained scenes, SH degree 3. Chromium draws without a GPU here
(SwiftShader, on all cores), which says how slow it is at worst. A picture counts once a pixel of it can be read, and
the time ends when that holds for the last one. Each figure has few frames where one takes seconds: take more
`--seconds` then.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from first_picture import opened  # which makes the tests' browser known
from headless_chromium import find_chromium
from sw_view import page_file
from view import made_up

TIMEOUT = 240.0
TURN = """new Promise(done => {
  const canvas = document.querySelector('canvas'), gl = canvas.getContext('webgl2');
  const data = document.documentElement.dataset;
  const point = (kind, x) => canvas.dispatchEvent(new PointerEvent(kind, { bubbles: true, pointerId: 1,
    clientX: x, clientY: 200, buttons: 1, button: kind === 'pointermove' ? -1 : 0, isPrimary: true }));
  canvas.setPointerCapture = () => {};
  let x = 200, share = 0;
  const finish = () => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
  point('pointerdown', x);
  finish();
  const start = performance.now(), before = Number(data.frames || 0);
  const step = now => {
    point('pointermove', x += 3);
    share = canvas.width / canvas.clientWidth;
    if (performance.now() - start < %d) return requestAnimationFrame(step);
    point('pointerup', x);
    finish();
    done([Number(data.frames) - before, (performance.now() - start) / 1000, share]);
  };
  requestAnimationFrame(step);
})"""


def figures(page: Path, size: tuple[int, int], seconds: float, folder: Path) -> tuple[float, float, float]:
    """Return seconds to the first whole picture, frames a second while turning, and the share of the width."""
    with opened(page, size, folder, TIMEOUT) as browser:
        first = float(browser.ask("document.documentElement.dataset.seenWhole")) / 1000
        drawn, took, share = browser.ask(TURN % (1000 * seconds))
    return first, drawn / took, share


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", default="200000,1000000,3000000")
    parser.add_argument("--size", default="960x540")
    parser.add_argument("--seconds", type=float, default=10.0)
    given = parser.parse_args()
    if find_chromium() is None:
        sys.exit("no Chromium is installed")
    width, height = map(int, given.size.split("x"))
    print(f"{'Gaussians':>10} {'page, MB':>9} {'first, s':>9} {'frames/s':>9} {'share':>6}", flush=True)
    with tempfile.TemporaryDirectory() as name:
        page = Path(name) / "page.html"
        for count in map(int, given.gaussians.split(",")):
            page_file.write_page(made_up(count), page, page_file.About("made up"), None)
            first, rate, share = figures(page, (width, height), given.seconds, Path(name))
            print(
                f"{count:>10,} {page.stat().st_size / 1e6:>9.1f} {first:>9.2f} {rate:>9.2f} {share:>6.2f}", flush=True
            )


if __name__ == "__main__":
    main()
