"""The HTML file: whole, alone, and with what is known of the scene."""

from __future__ import annotations

import base64
import hashlib
import html
import io
import json
import re
import shutil
import subprocess
import zlib
from dataclasses import replace
from pathlib import Path

import pytest
import sw_view
import torch
from PIL import Image
from sw_gaussians.ply import export_ply
from sw_view import coded_file
from sw_view.coded_file import with_file
from sw_view.packing import pack
from sw_view.page_file import About, write_page

from splatwizard_core.api import GaussianModel
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import load_plugins, open_model
from sw_codecs.entropy.exact_tables import exact_tables

GOLDEN = Path(__file__).parents[3] / "tests" / "golden"


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    draw = torch.Generator().manual_seed(1)
    n = 40
    return GaussianModel.from_tensors(
        torch.randn(n, 3, generator=draw), torch.randn(n, 1, 3, generator=draw),
        0.1 * torch.randn(n, 3, 3, generator=draw), torch.ones(n), torch.full((n, 3), -2.0),
        torch.randn(n, 4, generator=draw),
    )  # fmt: skip


@pytest.fixture
def ply(model, tmp_path) -> Path:
    export_ply(model, tmp_path / "a<b>&c.ply")
    return tmp_path / "a<b>&c.ply"


def facts_of(page: Path) -> dict:
    (found,) = re.findall(r'<script type="application/json" id="facts">(.*?)</script>', page.read_text("utf-8"))
    return json.loads(found)


def test_export_writes_one_file_that_names_no_address(ply, tmp_path, capsys):
    page = tmp_path / "scene.html"
    assert main(["export", str(ply), str(page), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["format"] == "html"
    text = page.read_text("utf-8")
    assert not re.search(r"https?:|//[a-z]|@[A-Z]|src=|@import", text.replace("data:,", ""))
    facts = facts_of(page)
    assert facts["count"] == 40
    assert len(facts["cameras"]) == 8
    assert "40 Gaussians" in text
    assert "made up around the Gaussians" in text


def test_made_up_cameras_see_the_gaussians(model, ply, tmp_path):
    page = tmp_path / "scene.html"
    assert main(["export", str(ply), str(page)]) == 0
    for camera in facts_of(page)["cameras"]:
        R, tau = torch.tensor(camera["R"]).reshape(3, 3), torch.tensor(camera["tau"])
        x, y, z = (model.means @ R.T + tau).T
        u, v = camera["fx"] * x / z + camera["cx"], camera["fy"] * y / z + camera["cy"]
        inside = (z > facts_of(page)["near"]) & (u > 0) & (u < camera["width"]) & (v > 0) & (v < camera["height"])
        assert inside.float().mean() > 0.7
        assert R[1, 1] > 0.5  # -y is up


def test_names_from_files_are_text_not_markup(ply, tmp_path):
    page = tmp_path / "scene.html"
    assert main(["view", str(ply), "--html", str(page)]) == 0
    text = page.read_text("utf-8")
    assert "a&lt;b&gt;&amp;c" in text
    assert "a<b>" not in text


def test_a_page_of_a_scene_has_its_cameras_test_cameras_first(ply, tmp_path):
    page = tmp_path / "scene.html"
    assert main(["view", str(ply), "--scene", "demo:tiny", "--html", str(page), "--set", "background=white"]) == 0
    facts = facts_of(page)
    names = [camera["name"] for camera in facts["cameras"]]
    assert names[:2] == ["view_000.png (test)", "view_004.png (test)"]
    assert names[2].endswith("(train)")
    assert len(set(names)) == len(names)
    assert facts["background"] == [1.0, 1.0, 1.0]
    assert (facts["cameras"][0]["width"], facts["cameras"][0]["height"]) == (64, 48)


def test_the_method_and_the_bytes_of_a_file_are_told(tmp_path):
    page = tmp_path / "scene.html"
    file = GOLDEN / "3dgs_r3_v1.swz"
    assert main(["view", str(file), "--html", str(page)]) == 0
    text = page.read_text("utf-8")
    assert "<span>3dgs</span>" in text
    assert f"<span>{file.stat().st_size:,} bytes encoded</span>" in text


def test_two_models_stand_in_one_page_and_are_seen_from_the_same_cameras(tmp_path, monkeypatch):
    monkeypatch.chdir(GOLDEN)
    page = tmp_path / "pair.html"
    assert main(["view", "3dgs_r1_v1.swz", "3dgs_r3_v1.swz", "--html", str(page)]) == 0
    frames = re.findall(r'<iframe title="([^"]*)" srcdoc="([^"]*)"></iframe>', page.read_text("utf-8"))
    assert [title for title, _ in frames] == ["3dgs_r1_v1.swz", "3dgs_r3_v1.swz"]
    facts = []
    for i, (title, text) in enumerate(frames):
        single = tmp_path / f"{i}.html"
        single.write_text(html.unescape(text), "utf-8")
        facts.append(facts_of(single))
        size = (GOLDEN / title).stat().st_size
        assert f"<span>{size:,} bytes encoded</span>" in single.read_text("utf-8")
        assert "<h1>" + title + "</h1>" in single.read_text("utf-8")
    assert facts[0]["cameras"] == facts[1]["cameras"]
    assert "http" not in re.sub(r"srcdoc=\"[^\"]*\"", "", page.read_text("utf-8"))  # it loads nothing


@pytest.mark.skipif(shutil.which("node") is None, reason="needs node")
def test_an_eye_goes_where_another_one_is():
    script = (
        (Path(sw_view.__file__).parent / "page" / "camera.js").read_text("utf-8")
        + """
    const camera = { width: 4, height: 3, fx: 1, fy: 1, cx: 2, cy: 1.5, R: [1,0,0, 0,1,0, 0,0,1], tau: [0,0,2] };
    const facts = { up: [0,-1,0], pivot: [0,0,0], size: 1, cameras: [camera] };
    let changes = 0;
    const [one, two] = [new Eye(facts, () => {}), new Eye(facts, () => { changes += 1; })];
    one.turn(0.3, 0.1); one.move(0.1, 0, 0.2);
    two.take(JSON.parse(JSON.stringify(one.place)));
    console.log(JSON.stringify([one.pose, two.pose, one.lens(8, 6), two.lens(8, 6), changes]));
    """
    )
    done = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    pose, same, lens, same_lens, changes = json.loads(done.stdout)
    assert pose == same
    assert lens == same_lens
    assert changes == 2  # its own first place, and this one


def test_what_cannot_be_a_page_is_refused_and_nothing_is_left(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(coded_file, "covers", lambda _: False)  # as a file that only its own package decodes
    assert main(["export", str(GOLDEN / "compact3dgs_v1.swz"), str(tmp_path / "new.html")]) == 2
    assert "depend on the camera" in capsys.readouterr().err
    (tmp_path / "runs").mkdir()
    assert main(["view", str(tmp_path / "runs"), "--html", str(tmp_path / "new.html")]) == 2
    assert "holds no finished run" in capsys.readouterr().err
    three = [str(GOLDEN / f"3dgs_r{n}_v1.swz") for n in (1, 2, 3)]
    assert main(["view", *three, "--html", str(tmp_path / "new.html")]) == 2
    assert "writes one model or two side by side, here are 3" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["runs"]


def test_a_mean_at_the_end_of_float32_leaves_a_page_that_browsers_can_read(model, tmp_path):
    with torch.no_grad():
        far = GaussianModel.from_tensors(*(getattr(model, name).clone() for name in model.RAW))
        far.means[:3] = torch.tensor([3e38, -3e38, 0.0])[:, None]
    write_page(far, tmp_path / "far.html", About("far"), None)
    text = (tmp_path / "far.html").read_text("utf-8")
    assert "NaN" not in re.findall(r'id="facts">(.*?)</script>', text)[0]
    assert facts_of(tmp_path / "far.html")["count"] == 38


def of_file(name: str) -> GaussianModel:
    model, _ = open_model(GOLDEN / f"{name}.swz", load_plugins(), torch.device("cpu"))
    assert isinstance(model, GaussianModel)
    return model


@pytest.mark.parametrize("name", ["3dgs_classes_v1", "wisp_v1"])
def test_a_page_holds_the_file_where_that_is_smaller(monkeypatch, name):
    model, data = of_file(name), (GOLDEN / f"{name}.swz").read_bytes()
    packed = replace(pack(model), text="a" * 20_000)  # as if its Gaussians were no small family
    monkeypatch.setattr(coded_file, "_decoder", lambda _: "<script></script>")
    assert base64.b64decode(with_file(model, packed).text) == data
    assert with_file(model, packed).facts == {**packed.facts, "reach": packed.reach}
    monkeypatch.setattr(coded_file, "_decoder", lambda _: " " * 20_000)
    assert with_file(model, packed) is packed


@pytest.mark.parametrize("command", ["export", "view"])
def test_a_page_of_anchors_holds_their_file_and_says_how_many(command, tmp_path):
    file, page = GOLDEN / "hac_exact_v2.swz", tmp_path / "x.html"
    assert main([command, str(file), *(["--html"] if command == "view" else []), str(page)]) == 0
    text, facts = page.read_text("utf-8"), facts_of(page)
    (held,) = re.findall(r'<script type="text/plain" id="gaussians">(.*?)</script>', text)
    (module,) = re.findall(r'<script type="text/plain" id="wasm">(.*?)</script>', text)
    assert base64.b64decode(held) == file.read_bytes()
    assert zlib.decompress(base64.b64decode(module)) == (coded_file.FOLDER / "anchors.wasm").read_bytes()
    assert (facts["anchors"], facts["count"], facts["degree"]) == (40, 101, 0)
    assert "<span>101 Gaussians</span><span>of 40 anchors</span>" in text


def test_a_page_of_a_colour_field_holds_its_file(tmp_path):
    file, page = GOLDEN / "compact3dgs_v1.swz", tmp_path / "x.html"
    assert main(["export", str(file), str(page)]) == 0
    text, facts = page.read_text("utf-8"), facts_of(page)
    (module,) = re.findall(r'<script type="text/plain" id="wasm">(.*?)</script>', text)
    assert zlib.decompress(base64.b64decode(module)) == (coded_file.FOLDER / "codebooks.wasm").read_bytes()
    assert 'id="tables"' not in text
    assert (facts["live"], facts["count"], "anchors" in facts) == (1, 24, False)


def test_a_page_of_a_scene_holds_some_test_photographs(tmp_path):
    page, run = tmp_path / "x.html", [str(GOLDEN / "3dgs_one_v1.swz"), "--scene", "demo:tiny", "--html"]
    for given, most in (([], 4), (["--photos", "1"], 1), (["--photos", "0"], 0)):
        assert main(["view", *run, str(page), *given]) == 0
        held = [camera for camera in facts_of(page)["cameras"] if "photo" in camera]
        tested = [camera for camera in facts_of(page)["cameras"] if camera["name"].endswith("(test)")]
        assert len(held) == min(most, len(tested))
        assert all(camera["name"].endswith("(test)") for camera in held)
        for camera in held:
            kind, _, text = camera["photo"].partition(",")
            assert kind == "data:image/jpeg;base64"
            assert Image.open(io.BytesIO(base64.b64decode(text))).size == (camera["width"], camera["height"])


@pytest.mark.parametrize("change", [{"world_origin": [1.0, 0.0, 0.0]}, {"file": "gone.swz"}, {"left_out": {"some": 1}}])
def test_a_model_that_is_not_that_of_its_file_is_packed(monkeypatch, change):
    model = of_file("3dgs_classes_v1")
    model.origin = {**model.origin, **change}
    packed = replace(pack(model), text="a" * 20_000)
    monkeypatch.setattr(coded_file, "_decoder", lambda _: "")
    assert with_file(model, packed) is packed


def test_the_policy_of_a_page_allows_its_own_script_and_style_alone(tmp_path):
    write_page(of_file("3dgs_classes_v1"), tmp_path / "x.html", About("toy"), None)
    page = (tmp_path / "x.html").read_text("utf-8")
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="(.*?)">', page)
    inline = re.findall(r"<script>(.*?)</script>|<style>(.*?)</style>", page, re.DOTALL)
    hashes = [base64.b64encode(hashlib.sha256("".join(part).encode()).digest()).decode() for part in inline]
    assert len(hashes) == 2
    assert policy.startswith("default-src 'none'; ")
    assert all(f"'sha256-{each}'" in policy for each in hashes)
    assert "unsafe-inline" not in policy
    assert "http" not in policy


def test_the_decoder_in_the_page_is_the_module_that_is_shipped():
    text = coded_file._elements("decoder.wasm", has_tables=False)
    (module,) = re.findall(r'<script type="text/plain" id="wasm">(.*?)</script>', text)
    assert zlib.decompress(base64.b64decode(module)) == (coded_file.FOLDER / "decoder.wasm").read_bytes()
    assert text.count("</script>") == 2
    other = coded_file._elements("anchors.wasm", has_tables=True)
    (tables,) = re.findall(r'<script type="text/plain" id="tables">(.*?)</script>', other)
    assert zlib.crc32(zlib.decompress(base64.b64decode(tables))[:-4]) == exact_tables().crc
    assert "export " not in text
