"""The upper part of a report page as a PNG: the picture in the README. Needs a Chromium.

.venv/bin/sw run --method 3dgs --scene demo --rate all
.venv/bin/python tools/report_picture.py out/demo/3dgs/report.html docs/images/report.png
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import tempfile
from pathlib import Path

from PIL import Image

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--hide-scrollbars",
)  # fmt: skip
COLOURS = 192  # of the palette: photographs stay good, the file a third of its size


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("page", type=Path, help="report.html")
    parser.add_argument("out", type=Path, help="PNG to write")
    parser.add_argument("--size", type=int, nargs=2, default=(1200, 1960), metavar=("W", "H"), help="pixels")
    args = parser.parse_args()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        parser.error(f"no {BROWSERS[0]} is installed")
    with tempfile.TemporaryDirectory() as folder:
        shot = Path(folder) / "shot.png"
        subprocess.run(
            [browser, *FLAGS, f"--user-data-dir={folder}/profile", f"--window-size={args.size[0]},{args.size[1]}",
             f"--screenshot={shot}", args.page.resolve().as_uri()],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        picture = Image.open(shot).convert("RGB")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    picture.quantize(COLOURS, dither=Image.Dither.FLOYDSTEINBERG).save(args.out, optimize=True)


if __name__ == "__main__":
    main()
