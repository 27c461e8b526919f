"""Photograph, decoded render and difference (x 4) of two demo views side by side: the picture in the README.

.venv/bin/sw render out/demo/3dgs/r6/scene.swz --scene demo --out renders
.venv/bin/python tools/demo_picture.py renders docs/images/demo.png
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from PIL import Image

from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

ROWS = (2, 9)  # test views
GAP = 4  # pixels of white between pictures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("renders", type=Path, help="folder that `sw render` wrote")
    parser.add_argument("out", type=Path, help="PNG to write")
    args = parser.parse_args()
    scene = load_scene("demo", SceneOptions(), load_plugins())
    files = sorted(args.renders.glob("*.png"))
    rows = []
    for index in ROWS:
        truth = scene.test[index].pixels.permute(1, 2, 0).numpy().astype(np.int16)
        render = np.asarray(Image.open(files[index]).convert("RGB")).astype(np.int16)
        difference = np.clip(4 * np.abs(render - truth), 0, 255)
        gap = np.full((truth.shape[0], GAP, 3), 255, np.int16)
        rows.append(np.concatenate([truth, gap, render, gap, difference], axis=1))
    band = np.full((GAP, rows[0].shape[1], 3), 255, np.int16)
    picture = np.concatenate([rows[0], band, rows[1]]).astype(np.uint8)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(args.out, optimize=True)


if __name__ == "__main__":
    main()
