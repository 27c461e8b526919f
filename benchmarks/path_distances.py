"""Records of earlier releases, with how far each test view lies from the training views: cameras alone decide that.

    python benchmarks/path_distances.py DATA out/records out/chair out/room
    sw report out/records --distance distance.html

Copies every metrics.json below the last arguments into the first folder after DATA, where DATA/<scene> holds the scene
of the record with the same test views; those that lack `path_distance`, `path_angle` and `path_combined` get them.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from sw_metrics.path_distance import path_angle, path_combined, path_distance

from splatwizard_core.api import Scene, SceneOptions, UserInputError
from splatwizard_core.tooling import load_plugins, load_scene

METRICS = {"path_distance": path_distance, "path_angle": path_angle, "path_combined": path_combined}


def with_distances(record: dict[str, Any], scene: Scene) -> dict[str, Any]:
    """A record with the path metrics of the scene's cameras. Raises UserInputError for other test views."""
    if record["views"] != [view.name for view in scene.test]:
        raise UserInputError(f"its {len(record['views'])} test views are not the {len(scene.test)} of {scene.path}")
    metrics = dict(record["metrics"])
    for name, compute in METRICS.items():
        if name not in metrics:
            found = compute(SimpleNamespace(scene=scene))  # type: ignore[arg-type]
            metrics[name] = {"mean": found.mean, "direction": found.direction, "per_view": list(found.per_view or [])}
    return {**record, "metrics": metrics}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, help="folder of the scenes")
    parser.add_argument("out", type=Path, help="where the copies go")
    parser.add_argument("records", type=Path, nargs="+", help="folders with run directories")
    args = parser.parse_args()
    plugins, scenes = load_plugins(), {}
    for root in args.records:
        for path in sorted(root.rglob("metrics.json")):
            record = json.loads(path.read_bytes())
            split = str(record["protocol"].get("split") or "")
            key = (record["scene"], None if split == "file" else split or None)
            if not (args.data / key[0]).is_dir():
                print(f"{path}: there is no scene {args.data / key[0]}: left out")
                continue
            if key not in scenes:
                scenes[key] = load_scene(str(args.data / key[0]), SceneOptions(split=key[1]), plugins)
            try:
                made = with_distances(record, scenes[key])
            except UserInputError as error:
                print(f"{path}: {error}: left out")
                continue
            target = args.out / root.name / path.relative_to(root)
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(json.dumps(made))
    print(f"written: {args.out}")


if __name__ == "__main__":
    main()
