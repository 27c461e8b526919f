"""`sw data list`, `verify`, `fetch`: asked, downloaded from a server on localhost, unpacked, checked."""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from PIL import Image
from range_server import Site, running_site
from sw_datasets.write_scene import write_scene

from splatwizard_core.cli.main import main
from splatwizard_core.plugins import load_plugins
from splatwizard_core.scene.dataset import SceneOptions
from splatwizard_core.scene.loading import load_scene

pytest.importorskip("pooch", reason="pip install 'sw-datasets[download]'")

REGISTRY = """
[dataset.lab]
title = "The lab's own"
scenes = ["desk", "shelf"]
needs = ["images", "sparse"]
views = [7, 1]
[[dataset.lab.file]]
name = "lab.zip"
url = "{address}/lab.zip"
sha256 = "{sha256}"

[dataset.again]
title = "One more scene of the same archive"
scenes = ["attic"]
needs = ["images", "sparse"]
[[dataset.again.file]]
name = "lab.zip"
url = "{address}/lab.zip"

[dataset.loose]
title = "Not pinned"
scenes = ["desk"]
[[dataset.loose.file]]
name = "loose.zip"
url = "{address}/loose.zip"
about = "about 12 GB (a listing)"

[dataset.hand]
title = "Behind a page"
scenes = ["desk"]
[[dataset.hand.file]]
name = "hand.zip"
url = "https://drive.google.com/file/d/0/view"
by_hand = true

[dataset.truth]
title = "No scenes"
[[dataset.truth.file]]
name = "truth.zip"
url = "{address}/truth.zip"
into = "points"

[dataset.weights]
title = "Two files that are no archives"
[[dataset.weights.file]]
name = "first.pth"
url = "{address}/first.pth"
sha256 = "{first}"
into = "weights"
plain = true
[[dataset.weights.file]]
name = "second.pth"
url = "{address}/second.pth"
into = "weights"
plain = true
"""
FIRST, SECOND = b"first weights", b"second weights"


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Three scenes of eight views each."""
    folder = tmp_path_factory.mktemp("scene") / "desk"
    write_scene(load_scene("demo:tiny", SceneOptions(), load_plugins()), folder)
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as opened:
        for file in sorted(folder.rglob("*.*")):
            for scene in ("desk", "shelf", "attic"):
                opened.write(file, f"lab-2025/{scene}/{file.relative_to(folder)}")
    return packed.getvalue()


@pytest.fixture
def site(archive: bytes, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    with running_site() as running:
        running.files = {
            "/lab.zip": archive,
            "/loose.zip": archive,
            "/truth.zip": archive,
            "/first.pth": FIRST,
            "/second.pth": SECOND,
        }
        running.etags["/lab.zip"] = '"1"'
        yield running


@pytest.fixture
def data(tmp_path: Path, site: Site, archive: bytes, monkeypatch: pytest.MonkeyPatch) -> Path:
    """$SPLATWIZARD_DATA, with the registry above."""
    registry = tmp_path / "registry.toml"
    pins = {"sha256": hashlib.sha256(archive).hexdigest(), "first": hashlib.sha256(FIRST).hexdigest()[:8]}
    registry.write_text(REGISTRY.format(address=site.address, **pins))
    monkeypatch.setenv("SPLATWIZARD_DATA_REGISTRY", str(registry))
    monkeypatch.setenv("SPLATWIZARD_DATA", str(tmp_path / "data"))
    return tmp_path / "data"


@pytest.fixture
def answer(monkeypatch: pytest.MonkeyPatch):
    """answer("y"): what the user types."""

    def types(text: str) -> None:
        monkeypatch.setattr("sys.stdin", io.StringIO(text))

    return types


def states(capsys: pytest.CaptureFixture[str]) -> dict[str, tuple[str, str]]:
    capsys.readouterr()
    assert main(["data", "list", "--json"]) == 0
    return {
        entry["id"]: (entry["state"], entry["checksum"]) for entry in json.loads(capsys.readouterr().out)["datasets"]
    }


def test_the_list_needs_no_folder(data: Path, capsys, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("SPLATWIZARD_DATA")
    assert states(capsys)["lab"] == ("missing", "pinned")
    assert main(["data", "list"]) == 0
    assert "under $SPLATWIZARD_DATA (not set)" in capsys.readouterr().out


def test_a_data_set_is_fetched_verified_listed_and_loaded(data: Path, site: Site, capsys):
    assert states(capsys)["lab"] == ("missing", "pinned")
    assert main(["data", "fetch", "lab", "--yes", "--json"]) == 0
    done = json.loads(capsys.readouterr().out)["fetched"]
    assert [(entry["dataset"], entry["verified"], sorted(entry["folders"])) for entry in done] == [
        ("lab", True, ["desk", "shelf"])
    ]
    assert states(capsys)["lab"] == ("present", "verified")
    assert main(["data", "verify", "--checksums", "--decode", "--json"]) == 0
    verdicts = json.loads(capsys.readouterr().out)["scenes"]
    assert [(v["name"], v["whole"], v["train"], v["test"], v["cameras"]) for v in verdicts] == [
        ("lab/desk", True, 7, 1, 1), ("lab/shelf", True, 7, 1, 1),
    ]  # fmt: skip
    assert verdicts[0]["pictures"] == {"images": 8}
    assert verdicts[0]["recorded"] == 8 + 3
    assert main(["info", "lab/desk"]) == 0
    assert sorted(os.listdir(data / "lab")) == [".fetched", "desk", "shelf"]
    assert [name for name in os.listdir(data / ".downloads") if "lab" in name] == []  # the archive has served


def test_it_asks_and_shows_size_and_address_first(data: Path, site: Site, answer, capsys):
    answer("n\n")
    assert main(["data", "fetch", "loose"]) == 1
    said = capsys.readouterr().err
    for fact in (
        f"{site.address}/loose.zip",
        "about 12 GB (a listing)",
        "unverified",
        str(data),
        "nothing was fetched",
    ):
        assert fact in said
    assert site.asked == []
    assert not data.exists()
    answer("y\n")
    assert main(["data", "fetch", "loose"]) == 0
    assert "unverified" in capsys.readouterr().out
    assert states(capsys)["loose"] == ("present", "unverified")


def test_nobody_to_answer_is_an_error_that_names_the_option(data: Path, site: Site, answer, capsys):
    answer("")
    assert main(["data", "fetch", "lab"]) == 2
    assert "--yes" in capsys.readouterr().err
    assert site.asked == []


def test_one_archive_serves_two_data_sets_with_one_download(data: Path, site: Site, capsys):
    assert main(["data", "fetch", "lab", "again", "-y"]) == 0
    assert len(site.asked) == 1
    assert (data / "again" / "attic" / "images").is_dir()
    assert states(capsys)["lab"][0] == states(capsys)["again"][0] == "present"


def test_a_single_scene_is_fetched_and_the_rest_later(data: Path, site: Site, capsys):
    assert main(["data", "fetch", "lab/shelf", "-y", "--keep"]) == 0
    assert states(capsys)["lab"] == ("partly", "verified")
    assert not (data / "lab" / "desk").exists()
    assert main(["data", "fetch", "lab", "-y"]) == 0
    assert "there already: lab/shelf" in capsys.readouterr().out
    assert len(site.asked) == 1  # the archive was kept
    assert main(["data", "fetch", "lab", "-y"]) == 0
    assert len(site.asked) == 1  # and nothing is missing now


def test_an_interrupted_fetch_resumes_with_the_same_command(data: Path, site: Site, capsys, monkeypatch):
    monkeypatch.setattr("sw_datasets.downloads.download.CHUNK_BYTES", 1000)
    site.cuts = [30_000]

    def interrupt(seconds: float) -> None:
        raise KeyboardInterrupt

    from sw_datasets.downloads.download import download

    monkeypatch.setattr(download, "__kwdefaults__", {**download.__kwdefaults__, "pause": interrupt})
    assert main(["data", "fetch", "lab", "-y"]) == 130
    assert not (data / "lab").exists()
    assert main(["data", "fetch", "lab", "-y"]) == 0
    assert [wanted for _, wanted in site.asked] == [None, "bytes=30000-"]
    assert states(capsys)["lab"] == ("present", "verified")


def test_a_checksum_of_the_user_is_held_against_the_file(data: Path, site: Site, archive: bytes, capsys):
    assert main(["data", "fetch", "loose", "-y", "--sha256", "0" * 64]) == 1
    assert "pinned is 0000" in capsys.readouterr().err
    assert not (data / "loose").exists()
    assert main(["data", "fetch", "loose", "-y", "--sha256", hashlib.sha256(archive).hexdigest()]) == 0
    assert len(site.asked) == 1  # a mistyped pin did not cost the download
    assert states(capsys)["loose"] == ("present", "verified")


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["lba"], 2, "did you mean 'lab'"),
        (["lab/garden"], 2, "data set 'lab' has no scene 'garden'"),
        (["lab", "--sha256", "xyz"], 2, "64 hexadecimal digits"),
        (["lab", "--sha256", "x.zip=" + "0" * 64], 2, "no file 'x.zip' is fetched, but lab.zip"),
        (["lab", "loose", "--sha256", "0" * 64], 2, "which file?"),
        (["lab", "--from", "/nowhere.zip"], 2, "no such file"),
        (["lab", "--registry", "/nowhere.toml"], 2, "cannot be read"),
        ([], 2, "Missing argument"),
    ],
)
def test_wrong_input_is_one_line_and_asks_nobody(arguments, status, message, data: Path, site: Site, capsys):
    assert main(["data", "fetch", *arguments, "-y"]) == status
    said = capsys.readouterr().err
    assert message in said
    assert len(said.strip().splitlines()) <= 2
    assert site.asked == []
    assert not data.exists()


def test_a_page_in_place_of_the_archive_is_told(data: Path, site: Site, capsys):
    site.files["/loose.zip"] = b"<html>Sign in</html>"
    assert main(["data", "fetch", "loose", "-y"]) == 1
    said = capsys.readouterr().err
    assert "a web page in its place" in said
    assert "delete it to download it again" in said
    assert not (data / "loose" / "desk").exists()


def test_what_is_gone_is_told_with_its_address(data: Path, site: Site, capsys):
    del site.files["/loose.zip"]
    assert main(["data", "fetch", "loose", "-y"]) == 1
    assert "/loose.zip: the server answers 404" in capsys.readouterr().err


def test_by_hand_says_where_from_and_where_to(data: Path, site: Site, archive: bytes, tmp_path: Path, capsys):
    assert main(["data", "fetch", "hand", "-y"]) == 1
    said = capsys.readouterr().err
    assert "must be fetched by hand, from https://drive.google.com/file/d/0/view" in said
    assert f"{data / 'hand' / 'SCENE'}" in said
    assert "--from" in said
    brought = tmp_path / "brought.zip"
    brought.write_bytes(archive)
    assert main(["data", "fetch", "hand", "-y", "--from", str(brought)]) == 0
    assert brought.is_file()
    assert site.asked == []
    assert states(capsys)["hand"] == ("present", "unverified")


def test_files_that_are_no_scenes_go_into_their_folder(data: Path, capsys):
    assert states(capsys)["truth"] == ("missing", "unverified")
    assert main(["data", "fetch", "truth", "-y"]) == 0
    assert (data / "truth" / "points" / "lab-2025" / "desk" / "images").is_dir()
    assert states(capsys)["truth"][0] == "present"
    assert main(["data", "fetch", "truth", "-y"]) == 0
    assert "there already: truth/points" in capsys.readouterr().out


def test_plain_files_are_kept_as_they_are_and_held_against_the_digits_that_are_known(data: Path, site: Site, capsys):
    folder = data / "weights" / "weights"
    assert main(["data", "fetch", "weights", "-y"]) == 0
    assert sorted(os.listdir(folder)) == ["first.pth", "second.pth"]
    assert (folder / "first.pth").read_bytes() == FIRST
    told = capsys.readouterr().out
    assert "first.pth: 13 bytes" in told
    assert told.count(": verified") == 1
    assert states(capsys)["weights"][0] == "present"
    (folder / "first.pth").unlink()
    assert states(capsys)["weights"][0] == "partly"
    site.files["/first.pth"] = b"other weights"
    assert main(["data", "fetch", "weights", "-y"]) != 0
    assert "SHA-256 is" in capsys.readouterr().err
    assert os.listdir(folder) == ["second.pth"]


def test_a_scene_that_lacks_something_is_not_written_over(data: Path, site: Site, capsys):
    (data / "loose" / "desk").mkdir(parents=True)
    (data / "lab" / "desk" / "images").mkdir(parents=True)
    assert main(["data", "fetch", "lab", "-y"]) == 1
    assert "is there but lacks sparse: move it away" in capsys.readouterr().err
    assert os.listdir(data / "lab" / "desk") == ["images"]
    assert (data / "lab" / "shelf" / "sparse").is_dir()  # the other scene came


def test_two_fetches_at_once_are_kept_apart(data: Path, site: Site, capsys):
    from splatwizard_core.base.lock import directory_lock

    with directory_lock(data / ".downloads"):
        assert main(["data", "fetch", "lab", "-y"]) == 2
    assert "another `sw data fetch` is at work there" in capsys.readouterr().err


def test_without_pooch_the_extra_is_named_before_the_question(data: Path, site: Site, answer, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "pooch", None)
    answer("y\n")
    assert main(["data", "fetch", "lab"]) == 2
    said = capsys.readouterr().err
    assert "pip install 'sw-datasets[download]'" in said
    assert "go on?" not in said


def test_the_variable_is_asked_for(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    for command in (["fetch", "tandt"], ["verify"]):
        assert main(["data", *command]) == 2
        assert "$SPLATWIZARD_DATA is not set" in capsys.readouterr().err


def test_the_list_needs_no_variable_and_says_that_it_is_not_set(monkeypatch: pytest.MonkeyPatch, capsys):
    monkeypatch.delenv("SPLATWIZARD_DATA", raising=False)
    assert main(["data", "list"]) == 0
    assert "$SPLATWIZARD_DATA (not set)" in capsys.readouterr().out


def test_the_tables_say_what_the_json_says(data: Path, capsys):
    assert main(["data", "list"]) == 0
    table = capsys.readouterr().out
    for word in ("lab", "mipnerf360", "unverified", "pinned", "by hand", "not known", "about 12 GB", str(data)):
        assert word in table
    assert main(["data", "list", "lab"]) == 0
    detail = capsys.readouterr().out
    for word in ("desk", "shelf", "missing", "sha256", "lab.zip"):
        assert word in detail


@pytest.fixture
def fetched(data: Path, capsys) -> Path:
    assert main(["data", "fetch", "lab", "-y"]) == 0
    capsys.readouterr()
    return data / "lab" / "desk"


def first_picture(scene: Path) -> Path:
    return sorted((scene / "images").iterdir())[0]


def remove_picture(scene: Path) -> None:
    first_picture(scene).unlink()


def spoil_header(scene: Path) -> None:
    first_picture(scene).write_bytes(b"no picture")


def truncate_model(scene: Path) -> None:
    model = scene / "sparse" / "0" / "images.bin"
    model.write_bytes(model.read_bytes()[:-5])


def remove_model(scene: Path) -> None:
    shutil.rmtree(scene / "sparse")


def resave_picture(scene: Path) -> None:
    file = first_picture(scene)
    with Image.open(file) as picture:
        picture.convert("L").save(file)


def change_a_bit(scene: Path) -> None:
    file = first_picture(scene)
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 1
    file.write_bytes(content)


def smaller_copy_lacks_one(scene: Path) -> None:
    shutil.copytree(scene / "images", scene / "images_2")
    sorted((scene / "images_2").iterdir())[3].unlink()


@pytest.mark.parametrize(
    ("spoil", "options", "message"),
    [
        (remove_picture, [], "1 of 8 images are missing"),
        (spoil_header, [], "not a readable picture"),
        (truncate_model, [], "truncated at byte"),
        (remove_model, [], "sparse is missing"),
        (resave_picture, [], "were unpacked"),
        (change_a_bit, ["--checksums"], "its SHA-256 differs"),
        (change_a_bit, ["--decode"], "cannot be decoded"),
        (smaller_copy_lacks_one, [], "images_2: 1 of 8 images are missing"),
    ],
)
def test_what_is_wrong_with_a_scene_is_said(spoil, options: list[str], message: str, fetched: Path, capsys):
    spoil(fetched)
    assert main(["data", "verify", *options]) == 1
    said = capsys.readouterr().out
    assert any(line.startswith("lab/desk: ") and message in line for line in said.splitlines())
    assert main(["data", "verify", "lab/shelf", *options]) == 0


def test_too_few_views_are_said(fetched: Path, capsys):
    from sw_datasets.loaders.colmap_model import ColmapModel, read_model, write_model

    model = read_model(fetched / "sparse" / "0")
    fewer = dict(list(model.images.items())[:-1])
    write_model(ColmapModel(model.cameras, fewer, model.points), fetched / "sparse" / "0")
    assert main(["data", "verify", "lab"]) == 1
    assert "6 train and 1 test views, it should have 7 and 1" in capsys.readouterr().out


def test_verify_names_what_is_not_there_and_what_is_no_name(data: Path, fetched: Path, capsys):
    assert main(["data", "verify", "loose"]) == 1
    assert "loose/desk: not there" in capsys.readouterr().out
    assert main(["data", "verify", "nothing"]) == 2
    assert "neither a folder nor DATASET[/SCENE]" in capsys.readouterr().err
    assert main(["data", "verify", str(fetched)]) == 0
    shutil.rmtree(data)
    assert main(["data", "verify"]) == 1
    assert "nothing to check" in capsys.readouterr().err


def test_list_imports_no_torch(data: Path):
    program = (
        "import sys\nfrom splatwizard_core.cli.main import main\nstatus = main(['data', 'list'])\n"
        "print('torch' in sys.modules, file=sys.stderr)\nsys.exit(status)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300, check=True)
    assert done.stderr.split() == ["False"]


@pytest.mark.parametrize(("layout", "options"), [("colmap", "split=every4"), ("blender", "split=file")])
def test_the_views_that_synth_tells_are_those_that_are_read(layout, options, tmp_path, capsys):
    out = str(tmp_path / "scene")
    assert main(["data", "synth", out, "--size", "tiny", "--format", layout]) == 0
    told = capsys.readouterr().out
    assert told.startswith("6 train and 2 test views")
    assert (f"--set {options}" in told) == (layout == "colmap")
    assert main(["info", out, "--set", options, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["views"] == {"train": 6, "test": 2}


@pytest.mark.parametrize(
    ("typed", "offered"), [("dt", ["dtu", "dtu_truth"]), ("dtu/2", ["dtu/24"]), ("nobody/", []), ("tandt", ["tandt"])]
)
def test_names_of_data_sets_and_scenes_are_completed(typed, offered, monkeypatch):
    from sw_datasets.commands.completions import dataset_or_folder, datasets

    monkeypatch.delenv("SPLATWIZARD_DATA_REGISTRY", raising=False)
    context = click.Context(click.Command("fetch"))
    parameter = click.Argument(["targets"])
    assert [item.value for item in datasets(context, parameter, typed)] == offered
    assert [item.type for item in dataset_or_folder(context, parameter, typed)] == ["dir", *["plain"] * len(offered)]


def test_completion_says_nothing_of_a_registry_that_cannot_be_read(monkeypatch):
    from sw_datasets.commands.completions import datasets

    monkeypatch.setenv("SPLATWIZARD_DATA_REGISTRY", "/nowhere/at/all.toml")
    assert datasets(click.Context(click.Command("fetch")), click.Argument(["targets"]), "dt") == []


def test_synth_writes_a_scene_that_info_reads(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["data", "synth", str(tmp_path / "s"), "--size", "tiny", "--json"]) == 0
    written = json.loads(capsys.readouterr().out)
    assert main(["info", str(tmp_path / "s"), "--set", "test_every=4", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["dataset"] == "colmap"
    assert found["views"] == {"train": written["train_views"], "test": written["test_views"]}
    assert found["points"]["count"] == written["points"]


def test_synth_leaves_a_folder_alone_that_holds_something(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "notes.txt").touch()
    assert main(["data", "synth", str(tmp_path)]) == 2
    assert "not an empty folder" in capsys.readouterr().err
