"""Checkpoints of trainers, with the layouts that they have, and the map of nerfstudio undone."""

import json

import numpy as np
import pytest
import torch
from interchange_files import random_scene
from sw_interchange import GaussianScene, Limits, from_gaussians, read, to_gaussians
from sw_interchange.frames import transformed

from splatwizard_core.api import BitstreamError, SceneError, UserInputError


@pytest.fixture(scope="module")
def scene() -> GaussianScene:
    return random_scene(7, 2)


def tensors(scene: GaussianScene) -> dict[str, torch.Tensor]:
    names = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
    return {name: torch.from_numpy(getattr(scene, name)) for name in names}


def same(a: GaussianScene, b: GaussianScene) -> bool:
    names = ("means", "log_scales", "opacity_logits", "sh_dc", "sh_rest")
    return all(np.array_equal(getattr(a, n), getattr(b, n)) for n in names) and np.allclose(a.quats, b.quats, atol=1e-6)


def test_gsplat(tmp_path, scene):
    t = tensors(scene)
    splats = {"means": t["means"], "scales": t["log_scales"], "quats": 3 * t["quats"], "opacities": t["opacity_logits"],
              "sh0": t["sh_dc"][:, None], "shN": t["sh_rest"]}  # fmt: skip
    torch.save({"step": 7, "splats": splats}, tmp_path / "ckpt_29999_rank0.pt")
    found = read(tmp_path / "ckpt_29999_rank0.pt")
    assert same(found, scene)
    assert found.report.version == "gsplat"
    torch.save({"step": 7, "splats": {**splats, "features": t["means"]}}, tmp_path / "appearance.pt")
    with pytest.raises(SceneError, match="from a network"):
        read(tmp_path / "appearance.pt")


def test_what_several_gpus_saved_is_one_scene(tmp_path, scene):
    t = tensors(scene)
    names = {"means": "means", "log_scales": "scales", "quats": "quats", "opacity_logits": "opacities",
             "sh_dc": "sh0", "sh_rest": "shN"}  # fmt: skip
    for rank, rows in enumerate((slice(0, 3), slice(3, 6), slice(6, 7))):
        splats = {theirs: t[own][rows].clone() for own, theirs in names.items()}
        torch.save({"step": 7, "splats": splats}, tmp_path / f"ckpt_9_rank{rank}.pt")
    torch.save({"step": 7, "splats": splats}, tmp_path / "ckpt_8_rank0.pt")
    found = read(tmp_path / "ckpt_9_rank0.pt")
    assert same(found, scene)
    assert "ckpt_9_rank1.pt, ckpt_9_rank2.pt" in found.report.warnings[0]
    assert read(tmp_path / "ckpt_9_rank2.pt").num_gaussians == 7
    alone = read(tmp_path / "ckpt_8_rank0.pt")
    assert (alone.num_gaussians, alone.report.warnings) == (1, [])
    with pytest.raises(BitstreamError, match=r"ckpt_9_rank0\.pt: claims 7 Gaussians, more than the limit of 6"):
        read(tmp_path / "ckpt_9_rank0.pt", limits=Limits(max_gaussians=6))
    total = sum((tmp_path / f"ckpt_9_rank{rank}.pt").stat().st_size for rank in range(3))
    assert read(tmp_path / "ckpt_9_rank0.pt", limits=Limits(max_output_bytes=total)).report.bytes == total
    with pytest.raises(BitstreamError, match=rf"ckpt_9_rank0\.pt: decodes to {total:,} bytes"):
        read(tmp_path / "ckpt_9_rank0.pt", limits=Limits(max_output_bytes=total - 1))
    (tmp_path / "ckpt_9_rank1.pt").unlink()
    with pytest.raises(SceneError, match=r"'ckpt_9_rank1\.pt', which"):
        read(tmp_path / "ckpt_9_rank2.pt")


@pytest.mark.parametrize("prefix", ["_model.gauss_params.", "module._model.gauss_params.", "_model."])
def test_nerfstudio(tmp_path, scene, prefix):
    t = tensors(scene)
    parts = {"means": t["means"], "scales": t["log_scales"], "quats": t["quats"], "features_dc": t["sh_dc"],
             "features_rest": t["sh_rest"], "opacities": t["opacity_logits"][:, None]}  # fmt: skip
    pipeline = {prefix + name: value for name, value in parts.items()}
    torch.save({"step": 7, "pipeline": pipeline, "optimizers": {}}, tmp_path / "step-000007.ckpt")
    found = read(tmp_path / "step-000007.ckpt")
    assert same(found, scene)
    assert "nerfstudio" in found.report.warnings[0]


def test_nerfstudio_without_sh_holds_logits_of_colours(tmp_path):
    t = tensors(random_scene(3, 0))
    parts = {"means": t["means"], "scales": t["log_scales"], "quats": t["quats"], "features_dc": torch.zeros(3, 3),
             "features_rest": t["sh_rest"], "opacities": t["opacity_logits"][:, None]}  # fmt: skip
    pipeline = {"_model.gauss_params." + name: value for name, value in parts.items()}
    torch.save({"pipeline": pipeline}, tmp_path / "a.ckpt")
    assert np.abs(read(tmp_path / "a.ckpt").sh_dc).max() == 0  # sigmoid(0) is grey


def test_the_authors_3dgs(tmp_path, scene):
    t = tensors(scene)
    captured = (2, t["means"], t["sh_dc"][:, None], t["sh_rest"], t["log_scales"], t["quats"],
                t["opacity_logits"][:, None], torch.zeros(7), {}, 1.5)  # fmt: skip
    torch.save((captured, 30000), tmp_path / "chkpnt30000.pth")
    assert same(read(tmp_path / "chkpnt30000.pth"), scene)


def test_another_checkpoint_is_no_scene(tmp_path):
    torch.save({"weights": torch.zeros(3)}, tmp_path / "a.pt")
    with pytest.raises(SceneError, match="none of: gsplat, nerfstudio, 3DGS"):
        read(tmp_path / "a.pt")
    torch.save({"splats": {"means": torch.zeros(3, 3), "scales": torch.zeros(2, 3)}}, tmp_path / "b.pt")
    with pytest.raises(BitstreamError, match="'log_scales' is"):
        read(tmp_path / "b.pt")


def test_the_map_of_nerfstudio_is_undone(tmp_path, scene):
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    scale, shift = 0.25, np.array([1, 2, 3.0])
    model = transformed(scene, turn, scale, scale * shift)  # s (R x + t)
    t = tensors(model)
    splats = {"means": t["means"], "scales": t["log_scales"], "quats": t["quats"], "opacities": t["opacity_logits"],
              "sh0": t["sh_dc"], "shN": t["sh_rest"]}  # fmt: skip
    torch.save({"splats": splats}, tmp_path / "a.pt")
    told = {"transform": np.concatenate([turn, shift[:, None]], axis=1).tolist(), "scale": scale}
    (tmp_path / "map.json").write_text(json.dumps(told))
    back = read(tmp_path / "a.pt", undo_dataparser=tmp_path / "map.json")
    assert np.allclose(back.means, scene.means, atol=1e-4)
    assert np.allclose(back.log_scales, scene.log_scales, atol=1e-5)
    assert np.allclose(back.sh_rest, scene.sh_rest, atol=1e-5)
    for text in ("{}", "[1]", '{"transform": [[1]], "scale": 1}', json.dumps(told | {"scale": 0}), "not JSON"):
        (tmp_path / "map.json").write_text(text)
        with pytest.raises(UserInputError, match="no map of nerfstudio"):
            read(tmp_path / "a.pt", undo_dataparser=tmp_path / "map.json")


def test_models_and_scenes_are_the_same_numbers(scene):
    model = to_gaussians(scene)
    assert same(from_gaussians(model), scene)
    model.active_sh_degree = 1
    assert from_gaussians(model).sh_degree == 1
    scene.kind = "2dgs"
    surfels = to_gaussians(scene)
    assert surfels.NUM_SCALES == 2
    assert (from_gaussians(surfels).kind, from_gaussians(surfels).log_scales[0, 2]) == ("2dgs", -20)
    scene.kind = "default"
    assert to_gaussians(random_scene(2, 4)).max_sh_degree == 3
    assert np.array_equal(to_gaussians(scene.in_frame("RUB")).means.detach().numpy(), scene.means)
