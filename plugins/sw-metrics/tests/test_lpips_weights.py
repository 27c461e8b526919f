"""Backbone files from anywhere: found by name, read without running anything, refused in one line."""

import io
import os
import pickle
import zipfile
from pathlib import Path

import pytest
import torch
from sw_metrics import lpips_weights
from sw_metrics.lpips_weights import BACKBONES, check_folder, find_weights, load_weights, read_weights

from splatwizard_core.cli.main import main
from splatwizard_core.errors import CapabilityError, UserInputError

ALEX = BACKBONES["alex"]


def alex_state() -> dict[str, torch.Tensor]:
    return {key: torch.zeros(shape) for key, shape in ALEX.shapes().items()}


def saved(path: Path, content: object, *, legacy: bool = False) -> Path:
    torch.save(content, path, _use_new_zipfile_serialization=not legacy)
    return path


@pytest.mark.parametrize("net", ["vgg", "alex"])
def test_the_table_of_shapes_is_that_of_the_network_in_the_package(net: str):
    from sw_metrics.perceptual import _import_lpips

    try:
        package = _import_lpips()
    except CapabilityError as error:
        pytest.skip(str(error))
    with torch.random.fork_rng(devices=[]), pytest.warns(UserWarning, match="deprecated"):
        network = package.LPIPS(net=net, pnet_rand=True, verbose=False).net
    theirs = {f"features.{k.partition('.')[2]}": tuple(v.shape) for k, v in network.state_dict().items()}
    assert theirs == BACKBONES[net].shapes()


def test_file_names_carry_the_beginning_of_the_checksum():
    assert (BACKBONES["vgg"].sha256_prefix, BACKBONES["alex"].sha256_prefix) == ("397923af", "7be5be79")
    assert BACKBONES["vgg"].address == "https://download.pytorch.org/models/vgg16-397923af.pth"


def test_the_named_folder_wins_over_torch_hubs_cache(tmp_path: Path, empty_hub: Path):
    assert find_weights("alex", tmp_path) is None
    empty_hub.mkdir(parents=True)
    (empty_hub / ALEX.file_name).touch()
    assert find_weights("alex", tmp_path) == empty_hub / ALEX.file_name
    (tmp_path / ALEX.file_name).touch()
    assert find_weights("alex", tmp_path) == tmp_path / ALEX.file_name
    assert find_weights("alex", None) == empty_hub / ALEX.file_name


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_both_layouts_of_torch_save_are_read_and_a_classifier_is_passed_over(tmp_path: Path, legacy: bool):
    # torchvision's own files are of the older layout, and hold the classifier.
    content = {**alex_state(), "classifier.1.weight": torch.ones(7, 7)}
    weights = read_weights(saved(tmp_path / ALEX.file_name, content, legacy=legacy), ALEX)
    assert set(weights.state) == set(ALEX.shapes())
    assert not weights.published


def test_a_file_with_the_published_checksum_counts_as_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = saved(tmp_path / ALEX.file_name, alex_state())
    monkeypatch.setattr(lpips_weights, "file_sha256", lambda _: "7be5be79" + "0" * 56)
    assert read_weights(path, ALEX).published


class Evil:
    """Would create a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_nothing_in_a_file_is_run(tmp_path: Path, legacy: bool):
    path = saved(tmp_path / ALEX.file_name, {**alex_state(), "x": Evil(tmp_path / "run")}, legacy=legacy)
    with pytest.raises(UserInputError, match="does not hold the weights"):
        read_weights(path, ALEX)
    (tmp_path / "bare.pth").write_bytes(pickle.dumps(Evil(tmp_path / "run")))
    with pytest.raises(UserInputError, match="does not hold the weights"):
        read_weights(tmp_path / "bare.pth", ALEX)
    assert not (tmp_path / "run").exists()


def nan(shape: tuple[int, ...]) -> torch.Tensor:
    return torch.full(shape, float("nan"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"features.3.weight": torch.zeros(192, 64, 3, 3)}, r"'features\.3\.weight' has shape \[192, 64, 3, 3\], not"),
        ({"features.0.bias": torch.zeros(64, dtype=torch.float64)}, r"no float32 tensor 'features\.0\.bias'"),
        ({"features.0.bias": torch.zeros(64).to_sparse()}, r"no float32 tensor 'features\.0\.bias'"),
        ({"features.0.bias": [0.0] * 64}, r"no float32 tensor 'features\.0\.bias'"),
        ({"features.0.bias": nan((64,))}, r"'features\.0\.bias' holds values that are not finite"),
    ],
)
def test_a_state_dict_that_does_not_fit_is_refused_with_the_tensor(tmp_path: Path, change: dict, reason: str):
    path = saved(tmp_path / ALEX.file_name, {**alex_state(), **change})
    with pytest.raises(UserInputError, match=reason) as told:
        read_weights(path, ALEX)
    assert "\n" not in str(told.value)
    assert str(path) in str(told.value)


@pytest.mark.parametrize(
    "content", [[], torch.zeros(3), {}, {"state_dict": {}}], ids=["list", "tensor", "empty", "nested"]
)
def test_what_is_no_state_dict_is_refused(tmp_path: Path, content: object):
    with pytest.raises(UserInputError, match="does not hold the weights"):
        read_weights(saved(tmp_path / ALEX.file_name, content), ALEX)


@pytest.mark.parametrize("legacy", [False, True], ids=["zip", "legacy"])
def test_damage_anywhere_is_one_line(tmp_path: Path, legacy: bool):
    path = saved(tmp_path / ALEX.file_name, alex_state(), legacy=legacy)
    whole = path.read_bytes()
    generator = torch.Generator().manual_seed(1)
    cuts = torch.randint(len(whole), (12,), generator=generator).tolist()
    for damaged in [b"", b"\x80\x02", whole[:1000], *(whole[:cut] for cut in cuts)]:
        path.write_bytes(damaged)
        with pytest.raises(UserInputError, match="does not hold the weights") as told:
            read_weights(path, ALEX)
        assert len(str(told.value).splitlines()) == 1


def test_a_file_that_unpacks_to_more_than_it_may_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(lpips_weights, "MOST_BYTES", 1 << 24)
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("it was unpacked"))
    path = tmp_path / ALEX.file_name
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("archive/data.pkl", b"\x80\x02.")
        archive.writestr("archive/data/0", bytes((1 << 24) + 1))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(UserInputError, match=r"unpacks to 16,777,\d{3} bytes"):
        read_weights(path, ALEX)


def test_a_legacy_file_that_claims_more_than_it_has_is_refused(tmp_path: Path):
    plain = io.BytesIO()
    torch.save({"features.0.bias": torch.zeros(12345)}, plain, _use_new_zipfile_serialization=False)
    assert (12345).to_bytes(2, "little") in plain.getvalue()
    claim = plain.getvalue().replace((12345).to_bytes(2, "little"), (65535).to_bytes(2, "little"))
    path = tmp_path / ALEX.file_name
    path.write_bytes(claim)
    with pytest.raises(UserInputError, match="does not hold the weights"):
        read_weights(path, ALEX)


def test_too_large_a_file_is_not_opened(tmp_path: Path):
    path = tmp_path / ALEX.file_name
    with open(path, "wb") as file:
        file.truncate(lpips_weights.MOST_BYTES + 1)  # sparse: takes no room
    with pytest.raises(UserInputError, match="more than any such file"):
        read_weights(path, ALEX)


def test_a_damaged_file_is_an_error_where_it_was_named_and_missing_where_it_was_not(tmp_path: Path, empty_hub: Path):
    (tmp_path / ALEX.file_name).write_bytes(b"no")
    with pytest.raises(UserInputError, match="does not hold the weights"):
        load_weights("alex", tmp_path)
    empty_hub.mkdir(parents=True)
    (empty_hub / ALEX.file_name).write_bytes(b"no")
    with pytest.raises(
        CapabilityError, match=r"^weights-missing: alexnet-\S+ in the cache of torch\.hub does not hold"
    ):
        load_weights("alex", None)


def test_a_folder_is_checked_before_the_work(tmp_path: Path, lpips_folder: Path):
    with pytest.raises(UserInputError, match=r"there is no such folder; it is to hold vgg16-397923af\.pth or alexnet"):
        check_folder(tmp_path / "none")
    with pytest.raises(UserInputError, match=r"holds neither vgg16-397923af\.pth nor alexnet-owt-7be5be79\.pth"):
        check_folder(tmp_path)
    check_folder(lpips_folder)


@pytest.mark.parametrize("command", [["run"], ["eval", "scene.ply"]], ids=["run", "eval"])
def test_commands_refuse_a_folder_without_weights_in_one_line(command, tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "scene.ply").touch()
    assert main([*command, "--scene", "demo:tiny", "--set", "metrics.lpips.weights=nowhere"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("computing on ")]
    assert line.startswith("error: metrics.lpips.weights: ")
    assert [path.name for path in tmp_path.iterdir()] == ["scene.ply"]
