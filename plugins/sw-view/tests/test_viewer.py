"""The viewer without viser: what browsers are sent when they connect, move, choose and compare."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from fake_viser import Client, Server
from sw_view import frames
from sw_view.browser_session import ELLIPSOIDS, SPLATS
from sw_view.entries import find_all_entries
from sw_view.live import LiveView
from sw_view.shown_cameras import surroundings_about, surroundings_of
from sw_view.shown_gaussians import ShownGaussians
from sw_view.shown_models import ShownModel
from sw_view.view_command import view
from sw_view.viewer import Viewer, start_server

from splatwizard_core.api import Camera, CapabilityError, GaussianModel, SceneOptions
from splatwizard_core.cli.main import main
from splatwizard_core.tooling import NegotiatedRasterizer, StartedTraining, load_plugins, load_scene

POINTS = np.random.default_rng(0).normal(size=(100, 3)).astype(np.float32)


class Clock:
    """The monotonic clock of the viewer: it stands still until a test moves it."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    for module in ("viewer", "browser_session"):
        monkeypatch.setattr(f"sw_view.{module}.time", clock)
    return clock


def shown() -> ShownGaussians:
    n = 7
    return ShownGaussians(np.zeros((n, 3), np.float32), np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
                          np.ones((n, 3), np.float32), np.full((n, 3), 200, np.uint8),
                          np.ones((n, 1), np.float32))  # fmt: skip


def of_one_colour(value: int, drawn: list[tuple[Camera, str]]) -> ShownModel:
    def draw(camera: Camera, mode: str) -> np.ndarray:
        drawn.append((camera, mode))
        if mode == "normals":
            raise CapabilityError("no rasterizer offers normals")
        return np.full((camera.height, camera.width, 3), value, np.uint8)

    return ShownModel(draw, lambda _camera: shown(), lambda: f"model {value}")


class Shown:
    """A viewer with two models, and a browser that looks."""

    def __init__(self, labels: tuple[str, ...] = ("10", "20")) -> None:
        self.server, self.drawn, self.opened = Server(), [], []

        def open_label(label: str) -> ShownModel:
            self.opened.append(label)
            return of_one_colour(int(label), self.drawn)

        self.around = surroundings_about(POINTS)
        self.viewer = Viewer(self.server, self.around, labels, open_label)  # type: ignore[arg-type]
        self.client: Client = self.server.connect()
        self.session = self.viewer._sessions[self.client.client_id]

    def pictures(self) -> list[np.ndarray]:
        return self.client.scene.pictures


def test_a_browser_starts_at_the_first_camera_and_is_sent_a_picture(clock):
    one = Shown(("10",))
    camera = one.around.cameras[0].camera
    np.testing.assert_allclose(one.client.camera.position, camera.center.numpy(), atol=1e-5)
    one.viewer.pump(0)
    assert one.pictures()[-1].shape == (48, 64, 3)  # it never moved: in full
    assert (one.pictures()[-1] == 10).all()
    assert "64 x 48" in one.session.told.content
    drawn_from = one.drawn[-1][0]
    torch.testing.assert_close(drawn_from.R, camera.R, atol=1e-5, rtol=0)
    # The camera's whole picture is in the window: 960 x 720 in 64 x 48, the same shape.
    assert drawn_from.fov_y == pytest.approx(camera.fov_y, abs=1e-6)


def test_nothing_is_drawn_twice(clock):
    one = Shown(("10",))
    for _ in range(3):
        one.viewer.pump(0)
    assert len(one.pictures()) == 1


def test_a_moving_camera_gets_fewer_pixels_and_all_of_them_when_it_rests(clock):
    one = Shown(("10",))
    one.viewer.pump(0)
    one.session.pace.share = 0.5
    one.client.camera.say()
    one.viewer.pump(0)
    assert one.pictures()[-1].shape == (24, 32, 3)
    clock.now += frames.REST + 0.01
    one.viewer.pump(0)
    assert one.pictures()[-1].shape == (48, 64, 3)
    one.viewer.pump(0)
    assert len(one.pictures()) == 3


def test_two_models_are_side_by_side_and_opened_once(clock):
    two = Shown()
    two.viewer.pump(0)
    middle = two.pictures()[-1][0, :, 0]
    assert (middle[0], middle[-1]) == (10, 20)
    assert middle[32] == 255
    two.session.split.say(value=0.25)
    two.viewer.pump(0)
    assert two.pictures()[-1][0, 20, 0] == 20
    two.session.beside.say(value="nothing")
    two.viewer.pump(0)
    assert (two.pictures()[-1] == 10).all()
    assert sorted(two.opened) == ["10", "20"]


def test_what_cannot_be_drawn_is_told_and_another_mode_works(clock):
    one = Shown(("10",))
    one.session.mode.say(value="normals")
    one.viewer.pump(0)
    assert one.pictures() == []
    assert "no rasterizer offers normals" in one.session.told.content
    one.session.mode.say(value="depth")
    one.viewer.pump(0)
    assert len(one.pictures()) == 1
    assert one.drawn[-1][1] == "depth"


def test_a_full_gpu_or_a_lost_file_is_told_and_ends_nothing(clock):
    for error in (RuntimeError("out of memory"), FileNotFoundError(2, "No such file", "scene.swz")):

        def lost(_label: str, error: Exception = error) -> ShownModel:
            raise error

        server = Server()
        viewer = Viewer(server, surroundings_about(POINTS), ("10",), lost)  # type: ignore[arg-type]
        session = viewer._sessions[server.connect().client_id]
        viewer.pump(0)
        assert str(error) in session.told.content


def test_who_comes_while_a_picture_is_drawn_disturbs_nobody(clock):
    one = Shown(("10",))
    one.client.camera.say()

    class Enters(tuple):
        """A session's last picture; to look at it lets another browser in, as viser's thread may."""

        def __getitem__(self, index: Any) -> Any:
            if len(one.viewer._sessions) == 1:
                one.server.connect()
            return super().__getitem__(index)

    one.session.drawn = Enters((9, 0, 0.5))
    one.session.due = lambda *_: None  # type: ignore[method-assign]
    one.viewer.pump(0)
    assert len(one.viewer._sessions) == 2


def test_equal_names_in_two_folders_are_told_apart(tmp_path):
    for place in ("a/r1", "b/r1", "b/r2"):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "scene.swz").touch()
        (tmp_path / place / "config.toml").touch()
    a, b = tmp_path / "a", tmp_path / "b"
    (a / "r3").mkdir()
    for name in ("scene.swz", "config.toml"):
        (a / "r3" / name).touch()
    found = find_all_entries([a, b, b])
    assert list(found) == [str(a / "r1"), "r3", str(b / "r1"), "r2"]
    assert [entry.run for entry in found.values()] == [a / "r1", a / "r3", b / "r1", b / "r2"]
    assert all(label == entry.label for label, entry in found.items())


def test_ellipsoids_and_splats_are_sent_once_and_taken_away(clock):
    one = Shown(("10",))
    one.session.mode.say(value=ELLIPSOIDS)
    one.viewer.pump(0)
    one.client.camera.say()
    one.viewer.pump(0)
    ((name, node, options),) = one.client.scene.nodes
    assert name == "/ellipsoids"
    assert (options["batched_scales"] == 1).all()
    one.session.sigmas.say(value=2.0)
    one.viewer.pump(0)
    assert node.removed
    assert (one.client.scene.nodes[-1][2]["batched_scales"] == 2).all()
    one.session.mode.say(value=SPLATS)
    one.viewer.pump(0)
    name, splats, options = one.client.scene.nodes[-1]
    assert name == "/splats"
    assert options["arguments"][1].shape == (7, 3, 3)
    one.session.mode.say(value="picture")
    one.viewer.pump(0)
    assert splats.removed
    assert one.pictures()[-1].shape == (48, 64, 3)


def test_a_click_on_a_frustum_takes_its_place_and_only_for_who_clicked(clock):
    one = Shown(("10",))
    other = one.server.connect()
    frusta = [node for name, node, _ in one.server.scene.nodes if name.startswith("/cameras/")]
    assert len(frusta) == 8
    frusta[3].say(SimpleNamespace(client=one.client))
    np.testing.assert_allclose(one.client.camera.position, one.around.cameras[3].camera.center.numpy(), atol=1e-5)
    np.testing.assert_allclose(other.camera.position, one.around.cameras[0].camera.center.numpy(), atol=1e-5)


def test_who_left_is_drawn_for_no_more(clock):
    one = Shown(("10",))
    one.server.disconnect(one.client)
    one.viewer.pump(0)
    assert one.pictures() == []
    assert not one.viewer.watched


def test_without_viser_the_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(CapabilityError, match=r"pip install 'sw-view\[viser\]'"):
        start_server("127.0.0.1", 0)


@pytest.fixture
def training(tmp_path) -> StartedTraining:
    plugins = load_plugins()
    rasterizer = NegotiatedRasterizer(plugins, device=torch.device("cpu"))
    return StartedTraining("toy", tmp_path, load_scene("demo:tiny", SceneOptions(), plugins), rasterizer)


@pytest.fixture
def live(training, monkeypatch) -> tuple[LiveView, Server]:
    server = Server()
    monkeypatch.setattr("sw_view.live.start_server", lambda _host, _port: server)
    return LiveView(training, 8080), server


def made(training: StartedTraining) -> GaussianModel:
    points = training.scene.points
    assert points is not None
    n = len(points)
    return GaussianModel(points.xyz, torch.zeros(n, 1, 3), torch.zeros(n, 0, 3), torch.zeros(n),
                         torch.full((n, 3), -3.0), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)).train()  # fmt: skip


def step(n: int) -> Any:
    return SimpleNamespace(step=n, iterations=10, stage_name="toy", total=torch.tensor(0.5), num_rows=3)


def test_a_training_draws_for_who_looks_and_leaves_no_trace(live, training):
    observer, server = live
    model = made(training)
    random, digest = torch.get_rng_state(), model.digest()
    observer.after_step(model, step(1))  # nobody looks
    client = server.connect()
    observer.after_step(model, step(2))
    assert client.scene.pictures[-1].max() > 0
    told = observer._viewer._sessions[client.client_id].told.content
    assert "step 2 of 10, loss 0.5000, 3 gaussians" in told
    assert model.training
    assert model.digest() == digest
    assert all(p.grad is None and p.requires_grad for p in model.parameters())
    assert torch.equal(torch.get_rng_state(), random)
    observer.finished()
    assert server.stopped


def test_who_moves_takes_a_fifth_of_the_time_of_a_training_at_most(live, training, monkeypatch):
    observer, server = live
    server.connect()
    clock, drawn = Clock(), []
    monkeypatch.setattr("sw_view.live.time", clock)

    def pump(_wait: float) -> None:
        drawn.append(clock.now)
        clock.now += 0.1  # somebody moves all the time

    monkeypatch.setattr(observer._viewer, "pump", pump)
    model = made(training)
    for n in range(100):
        observer.after_step(model, step(n))
        clock.now += 0.02
    assert len(drawn) > 2
    assert 0.1 * len(drawn) <= 0.2 * (clock.now - 100.0) + 0.1


def test_a_paused_training_waits_until_the_box_is_cleared(live, training, monkeypatch):
    observer, server = live
    server.connect()
    observer._paused.value = True
    waits: list[float] = []

    def pump(wait: float) -> None:
        waits.append(wait)
        observer._paused.value = len(waits) < 4

    monkeypatch.setattr(observer._viewer, "pump", pump)
    observer.after_step(made(training), step(1))
    assert waits == [0, 0.2, 0.2, 0.2]


def test_the_command_says_where_to_look_and_ends_cleanly(monkeypatch, capsys):
    server, calls = Server(), []
    golden = Path(__file__).parents[3] / "tests" / "golden" / "3dgs_r3_v1.swz"

    def interrupted(self: Viewer, _wait: float) -> None:
        calls.append(self.address)
        raise KeyboardInterrupt

    monkeypatch.setattr("sw_view.viewer.start_server", lambda host, port: server)
    monkeypatch.setattr(Viewer, "pump", interrupted)
    assert main(["view", str(golden)]) == 0
    told = capsys.readouterr()
    assert told.err == "look at http://127.0.0.1:8080 (Ctrl-C ends it)\nended\n"
    assert calls == ["http://127.0.0.1:8080"]
    assert server.stopped


def test_the_server_listens_here_alone_unless_told_otherwise():
    defaults: dict[str, Callable[[], Any] | Any] = {p.name: p.default for p in view.params}
    assert defaults["host"] == "127.0.0.1"


def test_surroundings_have_the_direction_that_is_up(training):
    server = Server()
    around = surroundings_of(training.scene)
    Viewer(server, around, ("1",), lambda label: of_one_colour(1, []))  # type: ignore[arg-type]
    assert server.scene.up is around.up
