"""A COLMAP scene with larger pictures, for measuring seconds and memory at a size that no scene at hand has.

    python benchmarks/enlarge.py DATA/room out/room2x --factor 2
    python benchmarks/time_to_quality.py out/room2x --presets paper,fast --seeds 0,1,2 --device cuda

Pictures are resampled by Lanczos and keep their file format; cameras and key points go with them. They show no more
than before: PSNR and SSIM are comparable among trainings of the enlarged scene alone.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from PIL import Image
from sw_datasets.loaders.colmap_model import read_model, write_model
from sw_datasets.undistort import is_pinhole

from splatwizard_core.api import SceneError, track
from splatwizard_core.tooling import new_folder


def enlarge(scene: Path, out: Path, factor: int, *, quality: int = 90) -> None:
    """Write a copy of the scene whose pictures are `factor` times as wide and as high; `out` is whole or not there.

    quality     of the JPEG pictures, 1..100

    Raises SceneError for cameras with distortion, whose coefficients belong to undistorted pictures first.
    """
    if out.exists():
        raise SceneError(f"{out} is there already: choose another folder", path=str(out))
    model = read_model(scene / "sparse" / "0")
    for camera in model.cameras.values():
        if not is_pinhole(camera):
            raise SceneError(f"{scene}: camera {camera.id} has distortion; use `sw data undistort` first")
    cameras = {
        i: replace(
            camera,
            width=camera.width * factor,
            height=camera.height * factor,
            params=tuple(value * factor for value in camera.params),
        )
        for i, camera in model.cameras.items()
    }
    images = {i: replace(image, xys=image.xys * factor) for i, image in model.images.items()}
    with new_folder(out) as temporary, track("enlarge", total=len(images), unit="pictures") as bar:
        for image in images.values():
            target = temporary / "images" / image.name
            target.parent.mkdir(parents=True, exist_ok=True)
            with Image.open(scene / "images" / image.name) as picture:
                size = picture.width * factor, picture.height * factor
                plain = picture if picture.mode in ("RGB", "RGBA", "L") else picture.convert("RGB")
                plain.resize(size, Image.Resampling.LANCZOS).save(target, quality=quality)
            bar.advance()
        write_model(replace(model, cameras=cameras, images=images), temporary / "sparse" / "0")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with images/ and sparse/0")
    parser.add_argument("out", type=Path, help="folder to make")
    parser.add_argument("--factor", type=int, default=2, help="how many times as wide and as high (default: 2)")
    given = parser.parse_args()
    if given.factor < 2:
        parser.error("--factor must be at least 2")
    try:
        enlarge(given.scene, given.out, given.factor)
    except (SceneError, OSError) as error:
        parser.exit(1, f"{error}\n")


if __name__ == "__main__":
    main()
