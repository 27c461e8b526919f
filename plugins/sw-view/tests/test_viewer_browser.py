"""The page and the viewer in a browser: pictures are those of the rasterizer, nothing is asked of any network.

Needs a Chromium, and for the last test viser; skips without one. `make test-browser` runs it.
"""

from __future__ import annotations

import base64
import io
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from headless_chromium import WEBGL, Chromium, find_chromium
from PIL import Image
from sw_gaussians.surfels import gaussians_of
from sw_view.entries import Opened, about_page, find_entries, for_page, open_entry
from sw_view.packing import pack
from sw_view.page_file import About, write_page, write_pair
from sw_view.photographs import photographs_of
from sw_view.shown_cameras import surroundings_of
from sw_view.shown_models import shown_model

from splatwizard_core.api import Camera, ContainerWriter, GaussianModel, RasterOptions, Scene, SceneOptions
from splatwizard_core.tooling import Choices, NegotiatedRasterizer, load_plugins, load_scene, open_model, render_view

pytestmark = [pytest.mark.slow, pytest.mark.skipif(find_chromium() is None, reason="no Chromium is installed")]
GOLDEN = Path(__file__).parents[3] / "tests" / "golden"

NOTES_STATES = """
globalThis.seen = [];
document.addEventListener('DOMContentLoaded', () => new MutationObserver(() => {
  seen.push(document.documentElement.dataset.state);
}).observe(document.documentElement, { attributes: true, attributeFilter: ['data-state'] }));
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory) -> Iterator[Chromium]:
    found = Chromium(find_chromium(), tmp_path_factory.mktemp("profile"), flags=WEBGL)
    yield found
    found.close()


@pytest.fixture(scope="module")
def scene() -> Scene:
    return load_scene("demo:tiny", SceneOptions(), load_plugins())


@pytest.fixture(scope="module")
def model(scene) -> GaussianModel:
    """Gaussians on the surfaces of the scene: needles and plates, half of them thin air, with strong harmonics."""
    assert scene.points is not None
    draw = torch.Generator().manual_seed(3)
    xyz = scene.points.xyz
    xyz = xyz + 0.02 * torch.randn(xyz.shape, generator=draw)
    n = len(xyz)
    return GaussianModel(
        xyz, torch.randn(n, 1, 3, generator=draw), 0.3 * torch.randn(n, 15, 3, generator=draw),
        2 * torch.randn(n, generator=draw), -3.2 + 0.9 * torch.randn(n, 3, generator=draw),
        torch.randn(n, 4, generator=draw),
    ).requires_grad_(False)  # fmt: skip


def at(address: str) -> Any:
    """An address as `Chromium.open` wants one."""
    return SimpleNamespace(resolve=lambda: SimpleNamespace(as_uri=lambda: address))


def still(browser: Chromium, page: Path, camera: int, size: tuple[int, int]) -> np.ndarray:
    """The picture of a camera, [H,W,3] in 0..1."""
    browser.send("Page.navigate", url="about:blank")  # a change of the fragment alone would load nothing
    browser.open(at(f"{page.as_uri()}#camera={camera}&size={size[0]}x{size[1]}&still"), width=1280)
    wait_for(browser, f"document.title === 'still {camera}'")
    return canvas_of(browser)


def canvas_of(browser: Chromium) -> np.ndarray:
    data = browser.ask("document.getElementById('canvas').toDataURL()").partition(",")[2]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), np.float64) / 255


def wait_for(browser: Chromium, condition: str, seconds: float = 60) -> None:
    until = time.monotonic() + seconds
    while not browser.ask(condition):
        assert browser.ask("document.documentElement.dataset.state") != "failed", browser.complaints()
        assert time.monotonic() < until, condition
        time.sleep(0.02)


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10 * np.log10(((a - b) ** 2).mean()))


def drawn(model: GaussianModel, camera: Camera, options: RasterOptions) -> np.ndarray:
    rasterizer = NegotiatedRasterizer(load_plugins(), device=torch.device("cpu"))
    return render_view(model, camera, rasterizer, options).image.clamp(0, 1).permute(1, 2, 0).numpy()


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("background", [(0.0, 0.0, 0.0), (1.0, 1.0, 1.0)])
def test_the_page_shows_what_the_rasterizer_draws(browser, scene, model, tmp_path, background, antialias):
    page = tmp_path / "scene.html"
    write_page(model, page, About("toy", background=background, antialias=antialias), surroundings_of(scene))
    for i, view in enumerate(scene.test):
        camera = view.camera.resized(256, 192)
        shown = still(browser, page, i, (camera.width, camera.height))
        options = RasterOptions(background=torch.tensor(background), antialias=antialias)
        # 50 dB and more: what is quantized, and Gaussians whose tails the rasterizer cuts at its tiles.
        assert psnr(shown, drawn(model, camera, options)) > 40
    assert browser.requests()[0].startswith(page.as_uri())
    assert all(url.startswith("blob:") for url in browser.requests()[1:])


@pytest.fixture(scope="module", params=["3dgs", "2dgs", "mesongs"])
def coded(request, scene, tmp_path_factory) -> GaussianModel:
    """Gaussians, or surfels, that come from a file; one of them lies too far away to be drawn."""
    draw = torch.Generator().manual_seed(5)
    method, plugins, n = request.param, load_plugins(), 40_000 if request.param == "mesongs" else 20_000
    codec, settings = ("raht", {"vq_steps": 1}) if method == "mesongs" else ("gaussians-quantized", {})
    axes = 2 if method == "2dgs" else 3
    xyz = scene.points.xyz[torch.randint(len(scene.points.xyz), (n,), generator=draw)]
    xyz = xyz + 0.05 * torch.randn(xyz.shape, generator=draw)
    xyz[7] = 0 if method == "mesongs" else 1e6  # its voxels would all be one
    found = gaussians_of(
        xyz, torch.randn(n, 1, 3, generator=draw), 0.1 * torch.randn(n, 15, 3, generator=draw),
        2 * torch.randn(n, generator=draw), -3.2 + 0.9 * torch.randn(n, axes, generator=draw),
        torch.randn(n, 4, generator=draw), active_sh_degree=2,
    )  # fmt: skip
    writer = ContainerWriter(method, 1)
    writer.static["codec"] = codec
    plugins.gaussian_codecs.load(codec)(plugins, **settings).encode(found, writer)
    path = tmp_path_factory.mktemp("coded") / "scene.swz"
    writer.write(path)
    return open_model(path, plugins, torch.device("cpu"))[0]


def test_a_page_that_holds_the_file_shows_what_one_of_packed_gaussians_shows(browser, scene, coded, tmp_path):
    pages = [tmp_path / name for name in ("file.html", "packed.html")]
    write_page(coded, pages[0], About("toy"), surroundings_of(scene))
    coded.origin = {}
    write_page(coded, pages[1], About("toy"), surroundings_of(scene))
    assert ['id="decoder"' in page.read_text() for page in pages] == [True, False]
    assert pages[0].stat().st_size < pages[1].stat().st_size
    camera = scene.test[0].camera
    pictures = []
    for page in pages:
        pictures.append(still(browser, page, 0, (camera.width, camera.height)))
        assert all(url.startswith("blob:") for url in browser.requests()[1:])
    assert psnr(*pictures) > 50  # places are exact in one of them
    assert pictures[0].std() > 0.05


@pytest.mark.parametrize(
    ("name", "first"), [("3dgs_packets_v1", "coarse"), ("wisp_packets_v2", "coarse"), ("wisp_v1", "drawn")]
)
def test_a_file_with_cuts_is_shown_coarse_first(browser, tmp_path, monkeypatch, name, first):
    """Its first cut, then all of it: what a page of its Gaussians shows."""
    model, _ = open_model(GOLDEN / f"{name}.swz", load_plugins(), torch.device("cpu"))
    pages = [tmp_path / name for name in ("coded.html", "packed.html")]
    packed = pack(model)
    write_page(model, pages[1], About("toy"), None)
    with monkeypatch.context() as patched:
        patched.setattr("sw_view.page_file.pack", lambda _: replace(packed, text="a" * 400_000))
        write_page(model, pages[0], About("toy"), None)
    text, telling = pages[0].read_text(), "tell(plain(arrays), facts, eye, whole);"
    assert telling in text
    pause = f"{{ if (whole) await new Promise(r => setTimeout(r, 500)); {telling} }}"
    pages[0].write_text(text.replace(telling, pause))
    added = browser.send("Page.addScriptToEvaluateOnNewDocument", source=NOTES_STATES)
    browser.open(at(pages[0].as_uri()), width=800)
    wait_for(browser, "document.documentElement.dataset.state === 'drawn'")
    states = browser.ask("seen")
    browser.send("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])
    assert states[0] == first
    assert states[-1] == "drawn"
    assert psnr(*(still(browser, page, 0, (160, 120)) for page in pages)) > 45


@pytest.mark.parametrize("name", ["hac_half_v2", "hac_plus_v1", "cat_3dgs_refined_v2", "compact3dgs_v1"])
def test_what_depends_on_the_eye_is_evaluated_wherever_the_eye_comes_to_rest(browser, tmp_path, name):
    opened = open_entry(find_entries(GOLDEN / f"{name}.swz")[0], Choices(), load_plugins())
    page, (packed, note) = tmp_path / "anchors.html", for_page(opened)
    write_page(packed, page, about_page(opened), opened.around)
    assert note.startswith("The method's Gaussians depend on the camera")

    def of_rasterizer(camera: Camera) -> np.ndarray:
        return opened.drawing.render(camera).image.clamp(0, 1).permute(1, 2, 0).numpy()

    cameras = [each.camera.resized(240, 180) for each in opened.around.cameras]
    assert psnr(*map(of_rasterizer, (cameras[0], cameras[3]))) < 42  # two pictures, not one twice
    assert psnr(still(browser, page, 0, (240, 180)), of_rasterizer(cameras[0])) > 45
    browser.ask("(l => { l.value = 3; l.dispatchEvent(new Event('change')); })(document.getElementById('camera'))")
    wait_for(browser, "document.title === 'still 3'")
    assert psnr(canvas_of(browser), of_rasterizer(cameras[3])) > 45
    assert all(url.startswith("blob:") for url in browser.requests()[1:])


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_every_degree_of_harmonics_is_drawn(browser, scene, model, tmp_path, degree):
    part = GaussianModel(model.means, model.sh_dc, model.sh_rest[:, : (degree + 1) ** 2 - 1], model.opacity_logits,
                         model.log_scales, model.quats).requires_grad_(False)  # fmt: skip
    page = tmp_path / "scene.html"
    write_page(part, page, About("toy"), surroundings_of(scene))
    camera = scene.test[1].camera
    shown = still(browser, page, 1, (camera.width, camera.height))
    options = RasterOptions(background=torch.zeros(3))
    assert psnr(shown, drawn(part, camera, options)) > 40
    if degree:
        assert psnr(shown, drawn(model, camera, options)) < 35, "the test would not see a missing band"


def test_an_off_centre_camera_of_another_shape_is_drawn_whole(browser, scene, model, tmp_path):
    view = scene.test[0]
    camera = replace(view.camera, cx=view.camera.cx + 5, cy=view.camera.cy - 3)
    around = surroundings_of(scene)
    named = replace(around.cameras[0], camera=camera)
    page = tmp_path / "scene.html"
    write_page(model, page, About("toy"), replace(around, cameras=[named]))
    shown = still(browser, page, 0, (camera.width, 2 * camera.height))
    top = camera.height // 2
    inside = shown[top : top + camera.height]
    # A larger window clamps the slopes of wide Gaussians elsewhere, so only most of the picture is the same.
    assert psnr(inside, drawn(model, camera, RasterOptions(background=torch.zeros(3)))) > 30


def test_controls_move_the_eye_and_cameras_bring_it_back(browser, scene, model, tmp_path):
    page = tmp_path / "scene.html"
    write_page(model, page, About("toy", note="A note."), surroundings_of(scene))
    browser.send("Page.navigate", url="about:blank")
    browser.open(page, width=900, height=700)
    settled = "document.documentElement.dataset.state === 'drawn'"
    wait_for(browser, settled)

    def picture() -> str:
        time.sleep(0.5)
        wait_for(browser, settled)
        return browser.ask("new Promise(r => requestAnimationFrame(() => r(document.documentElement.dataset.frames)))")

    before = int(picture())
    browser.key("ArrowRight", 39)
    browser.key("w", 87)
    assert int(picture()) > before
    x, y = 450, 350
    for kind, dx in (("mousePressed", 0), ("mouseMoved", 40), ("mouseReleased", 40)):
        browser.send("Input.dispatchMouseEvent", type=kind, x=x + dx, y=y, button="left", buttons=1, clickCount=1)
    moved = int(picture())
    browser.key("]", 221)
    assert browser.ask("document.getElementById('camera').value") == "1"
    assert int(picture()) > moved
    browser.key("f", 70)
    assert browser.ask("document.getElementById('fly').getAttribute('aria-pressed')") == "true"
    browser.key("h", 72)
    assert "A note." in browser.ask("document.getElementById('help').innerText")
    assert not [line for line in browser.complaints() if "ReadPixels" not in line]


def test_a_photograph_lies_over_the_picture_of_its_camera_alone(browser, scene, model, tmp_path):
    page, around = tmp_path / "scene.html", surroundings_of(scene)
    write_page(model, page, About("toy", photographs=photographs_of(around.cameras, 1)), around)
    browser.send("Page.navigate", url="about:blank")
    browser.open(page, width=900, height=700)
    wait_for(browser, "document.documentElement.dataset.state === 'drawn'")
    seen = "!document.getElementById('photo').hidden && !document.getElementById('border').hidden"
    assert not browser.ask(seen)
    browser.key("p", 80)
    assert browser.ask(seen)
    slide = "s => { s.value = 0; s.dispatchEvent(new Event('input')); }"
    browser.ask(f"({slide})(document.getElementById('border'))")
    wait_for(browser, "document.documentElement.dataset.state === 'drawn'")
    box = browser.ask("(({x, y, width, height}) => ({x, y, width, height}))"
                      "(document.getElementById('canvas').getBoundingClientRect())")  # fmt: skip
    camera = around.cameras[0].camera
    fit = min(box["width"] / camera.width, box["height"] / camera.height)
    size = (camera.width * fit, camera.height * fit)
    clip = {"x": box["x"] + (box["width"] - size[0]) / 2, "y": box["y"] + (box["height"] - size[1]) / 2,
            "width": size[0], "height": 0.9 * size[1]}  # fmt: skip
    browser.picture(tmp_path / "photo.png", whole=False, clip=clip)
    shown = Image.open(tmp_path / "photo.png").convert("RGB").resize((camera.width, round(0.9 * camera.height)))
    photograph = scene.test[0].image().permute(1, 2, 0).numpy()[: shown.height]
    assert psnr(np.asarray(shown, np.float64) / 255, photograph) > 25  # scaled twice, and a JPEG
    browser.key("ArrowRight", 39)
    assert not browser.ask(seen)
    browser.key("r", 82)
    assert browser.ask(seen)
    browser.key("]", 221)  # which has none
    assert not browser.ask(seen)
    assert browser.ask("document.getElementById('photograph').hidden")


def test_both_halves_of_a_page_of_two_are_drawn_and_move_together(browser, scene, model, tmp_path):
    """By what the window shows, against the page of each model alone in a window of its half."""
    grey = GaussianModel(model.means, torch.ones_like(model.sh_dc), torch.zeros_like(model.sh_rest),
                         model.opacity_logits, model.log_scales, model.quats).requires_grad_(False)  # fmt: skip
    pages, around = [tmp_path / name for name in ("a.html", "b.html", "both.html")], surroundings_of(scene)
    titled = [(model, About("a")), (grey, About("b" * 99))]  # whatever the names, of pictures of one size
    for (each, _), page in zip(titled, pages, strict=False):
        write_page(each, page, About("a"), around)
    write_pair(titled, pages[2], around)

    def shown(page: Path, width: int, camera: int | None = None, height: int = 700) -> np.ndarray:
        browser.open(page, width=width, height=height)
        documents = "[document, ...[...document.querySelectorAll('iframe')].map(f => f.contentDocument)]"
        documents = f"{documents}.filter(d => d.getElementById('canvas'))"
        settled = f"{documents}.every(d => d.documentElement.dataset.state === 'drawn')"
        wait_for(browser, settled)
        if camera is not None:  # in the first alone
            choose = f"l => {{ l.value = {camera}; l.dispatchEvent(new Event('change')); }}"
            browser.ask(f"({choose})({documents}[0].getElementById('camera'))")
        time.sleep(0.5)  # the last frame, drawn at full size, reaches the window
        wait_for(browser, settled)
        browser.picture(tmp_path / "window.png", whole=False)
        picture = np.asarray(Image.open(tmp_path / "window.png").convert("RGB"), np.float64) / 255
        return picture[100:600]  # between the bars

    for camera in (None, 1):
        both = shown(pages[2], 1280, camera)
        height = 700 - browser.ask("document.getElementById('tools').offsetHeight")
        for alone, half in zip(pages, (both[:, :639], both[:, 641:]), strict=False):
            assert half.std() > 0.05
            assert psnr(half, shown(alone, 639, camera, height)) > 40
    assert psnr(both[:, :639], both[:, 641:]) < 25  # two models, not one twice

    wide = [shown(page, 1280, 1, height) for page in pages[:2]]
    shown(pages[2], 1280, 1)
    slide = "s => { s.value = 25; s.dispatchEvent(new Event('input')); }"
    browser.ask(f"document.getElementById('over').click(), ({slide})(document.getElementById('share'))")
    time.sleep(1.0)  # drawn again at the new size
    browser.picture(tmp_path / "over.png", whole=False)
    over = np.asarray(Image.open(tmp_path / "over.png").convert("RGB"), np.float64)[100:600] / 255
    assert psnr(over[:, :318], wide[0][:, :318]) > 40
    assert psnr(over[:, 322:], wide[1][:, 322:]) > 40
    shown(pages[2], 390, height=844)
    height_of = "frame => frame.contentDocument.getElementById('canvas').offsetHeight"
    assert len(set(browser.ask(f"[...document.querySelectorAll('iframe')].map({height_of})"))) == 1


def test_an_eye_that_sees_nothing_is_shown_the_background(browser, scene, model, tmp_path):
    around = surroundings_of(scene)
    near = around.cameras[0].camera
    away = replace(near, R=torch.diag(torch.tensor([-1.0, 1.0, -1.0])) @ near.R, tau=torch.tensor([0.0, 0.0, -1e4]))
    page = tmp_path / "scene.html"
    cameras = [around.cameras[0], replace(around.cameras[0], camera=away)]
    write_page(model, page, About("toy", background=(1.0, 0.0, 0.0)), replace(around, cameras=cameras))
    np.testing.assert_array_equal(still(browser, page, 1, (64, 48)), np.broadcast_to([1.0, 0.0, 0.0], (48, 64, 3)))


def test_it_fits_a_phone_in_light_and_dark(browser, scene, model, tmp_path):
    page = tmp_path / "scene.html"
    write_page(model, page, About("a-title-" * 12, "3dgs", 123456), surroundings_of(scene))
    for scheme in ("light", "dark"):
        browser.send("Page.navigate", url="about:blank")
        browser.open(page, width=390, height=760, scheme=scheme)
        wait_for(browser, "document.documentElement.dataset.state === 'drawn'")
        assert browser.ask("document.documentElement.scrollWidth") == 390
        assert browser.ask("document.documentElement.scrollHeight") == 760
        ground = browser.ask("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, ground[4:-1].split(","))) < 200) == (scheme == "dark")


def test_a_damaged_page_says_so(browser, scene, model, tmp_path):
    page = tmp_path / "scene.html"
    write_page(model, page, About("toy"), surroundings_of(scene))
    text = page.read_text("utf-8")
    at_data = text.index('id="gaussians">') + 500
    page.write_text(text[:at_data] + "!" + text[at_data + 1 :], "utf-8")
    browser.send("Page.navigate", url="about:blank")
    browser.open(page, width=600)
    until = time.monotonic() + 30
    while browser.ask("document.documentElement.dataset.state") != "failed":
        assert time.monotonic() < until
        time.sleep(0.05)
    assert browser.ask("!document.getElementById('told').hidden && document.getElementById('told').textContent !== ''")


@pytest.fixture(scope="module")
def opened() -> Opened:
    return open_entry(find_entries(GOLDEN / "3dgs_r3_v1.swz")[0], Choices(scene="demo:tiny"), load_plugins())


def test_a_browser_is_sent_the_picture_of_its_camera(browser, opened):
    pytest.importorskip("viser", reason="pip install 'sw-view[viser]'")
    from sw_view.viewer import Viewer, start_server

    viewer = Viewer(start_server("127.0.0.1", 0), opened.around, ["golden"], lambda _label: shown_model(opened))
    done = threading.Event()

    def pump() -> None:
        while not done.is_set():
            viewer.pump(0.05)

    thread = threading.Thread(target=pump)
    thread.start()
    part = (slice(240, 480), slice(0, 300))  # the panel and messages are above and to the right
    best, until = 0.0, time.monotonic() + 60
    try:
        browser.open(at(viewer.address), width=640, height=480)
        while best <= 30:
            assert time.monotonic() < until, f"the browser shows something else: {best:.1f} dB"
            time.sleep(0.2)
            for session in viewer._sessions.values():
                camera = session.camera(1.0)
                assert (camera.width, camera.height) == (640, 480)
                sent = shown_model(opened).draw(camera, "picture")
                data = browser.send("Page.captureScreenshot", format="png")["data"]
                shown = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"))
                best = max(best, psnr(shown[part] / 255, sent[part] / 255))
    finally:
        done.set()
        thread.join()
        viewer.stop()
