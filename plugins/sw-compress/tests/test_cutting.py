"""Files of methods to a size: settings between rate points first, then fewer rows."""

from pathlib import Path

import pytest
import torch
from sw_compress.cutting import FILLED, rows_that_fit, with_rows
from sw_compress.rate_ladder import RateLadder

from splatwizard_core.api import ConfigError, GaussianModel, UserInputError, create_method
from splatwizard_core.tooling import encode, load_plugins


def tried(count: int, size: int, each: float, fixed: int) -> tuple[int, int]:
    """Rows that fit where each has so many bytes beside fixed ones, and how many files it took."""
    asked = []

    def written(rows: int) -> int:
        asked.append(rows)
        return int(fixed + each * rows)

    return rows_that_fit(count, int(fixed + each * count), size, written), len(asked)


@pytest.mark.parametrize("share", [0.95, 0.5, 0.1])
@pytest.mark.parametrize("fixed", [0, 30_000])
def test_rows_fill_a_size_in_few_files(share: float, fixed: int):
    size = int(fixed + share * 40.0 * 10_000)
    rows, files = tried(10_000, size, 40.0, fixed)
    assert FILLED * size <= fixed + 40.0 * rows <= size
    assert files <= 4


def test_a_jump_of_the_bytes_ends_the_search_before_it():
    def written(rows: int) -> int:
        asked.append(rows)
        return 30 * rows + (10_000 if rows >= 2048 else 0)

    asked: list[int] = []
    assert 2020 < rows_that_fit(3000, 100_000, 66_000, written) < 2048
    assert len(asked) <= 7


@pytest.mark.pipeline
def test_a_palette_between_those_of_sog_fills_what_numbers_of_gaussians_leave(ball, tmp_path: Path):
    """With 2,048 Gaussians its palette is twice as large as with one less: 60,036 and 66,339 bytes."""
    out, method = tmp_path / "a.swz", create_method(load_plugins(), "sog", {"size": "63kB"})
    encode(method, ball(2060, degree=1), {}, out)
    assert 0.97 * 63_000 < out.stat().st_size <= 63_000


def test_no_row_fits_below_what_is_fixed():
    assert tried(10_000, 29_000, 40.0, 30_000)[0] == 0


def test_few_rows_come_as_near_as_they_can():
    assert tried(10, 1_050, 300.0, 100)[0] == 3


def configured(name: str, **values):
    return create_method(load_plugins(), name, {"codec.name": "gaussians-quantized", **values})


def test_a_ladder_has_the_rate_points_that_share_the_training():
    ladder = RateLadder(create_method(load_plugins(), "2dgs"))
    assert len(ladder.points) == 6
    assert ladder.own == 5
    assert ladder.points[5].codec.name == "gaussians-exact"


def test_settings_lie_between_rate_points_and_go_on_where_there_is_no_between():
    ladder = RateLadder(create_method(load_plugins(), "2dgs"))
    steps = [ladder.at(place).codec.settings["dc_step"] for place in (2.0, 2.5, 3.0, 4.0, 4.5)]
    assert steps[0] > steps[1] > steps[2] > steps[3] > steps[4]
    assert steps[1] == pytest.approx((steps[0] * steps[2]) ** 0.5)
    assert ladder.at(-1.0).codec.settings["dc_step"] > ladder.at(0.0).codec.settings["dc_step"]


def test_grades_are_for_settings_that_are_no_numbers():
    ladder = RateLadder(create_method(load_plugins(), "sog"))
    assert [ladder.graded(share).codec.settings["palette"] for share in (0.0, 1.0)] == [256, 65_536]
    assert ladder.points[ladder.own].codec.settings["palette"] is None
    for other in ("spz", "2dgs"):
        assert RateLadder(create_method(load_plugins(), other)).graded(0.5) is None


def test_settings_of_the_user_are_no_rate_point():
    ladder = RateLadder(configured("2dgs", **{"codec.settings.dc_step": 0.123}))
    assert (len(ladder.points), ladder.own, ladder.at(0.5)) == (1, 0, None)


def test_a_method_fills_a_size_with_its_own_file(ball, tmp_path: Path):
    model, out = ball(400), tmp_path / "a.swz"
    before = model.digest()
    encode(create_method(load_plugins(), "flat-3dgs", {"size": "6kB"}), model, {}, out)
    assert 0.97 * 6_000 < out.stat().st_size <= 6_000
    assert model.digest() == before


def test_a_format_fills_a_size_by_fewer_gaussians(ball, tmp_path: Path):
    out = tmp_path / "a.swz"
    encode(create_method(load_plugins(), "splat", {"size": "8kB"}), ball(400), {}, out)
    assert 0.97 * 8_000 < out.stat().st_size <= 8_000


def test_what_no_file_can_be_is_told_before_a_training():
    with pytest.raises(ConfigError, match="header and sections of a file alone have"):
        create_method(load_plugins(), "splat", {"size": "100"})
    with pytest.raises(ConfigError, match="numbers of its grid"):
        create_method(load_plugins(), "compact3dgs", {"size": "100kB"}).stages()
    with pytest.raises(UserInputError, match="its networks alone have"):
        create_method(load_plugins(), "wisp", {"size": "5kB"}).stages()
    with pytest.raises(ConfigError, match="300 Gaussians have no file as large"):
        create_method(load_plugins(), "2dgs", {"size": "5MB", "gaussians": 300})


def test_a_size_that_is_too_large_writes_the_whole_model_and_is_told(ball, tmp_path: Path, caplog):
    out = tmp_path / "a.swz"
    encode(create_method(load_plugins(), "splat", {"size": "1MB"}), ball(100), {}, out)
    assert "the largest file that was found has" in caplog.text
    assert out.stat().st_size < 1_000_000


def test_a_copy_has_the_rows_alone(ball):
    model = ball(20)
    part = with_rows(model, torch.tensor([3, 5]))
    assert isinstance(part, GaussianModel)
    assert part.num_rows == 2
    assert torch.equal(part.means, model.means[[3, 5]])
    assert model.num_rows == 20
