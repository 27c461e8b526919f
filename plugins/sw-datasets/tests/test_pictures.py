"""Pictures: the resolution rule, every kind of file as uint8, masks."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from sw_datasets.picture_names import find_pictures, is_inside, list_pictures
from sw_datasets.pictures import (
    fitted_size,
    load_mask,
    load_picture,
    picture_header,
)

from splatwizard_core.errors import ConfigError, SceneError


@pytest.mark.parametrize(
    ("size", "resolution", "expected"),
    [
        ((4946, 3286), -1, (1600, 1063)),
        ((4946, 3286), 4, (1236, 822)),  # 1236.5 and 821.5 round half to even
        ((1554, 1036), -1, (1554, 1036)),
        ((1600, 5000), -1, (1600, 5000)),  # only the width is tested
        ((1000, 3000), -1, (1000, 3000)),
        ((800, 800), 2, (400, 400)),
        ((800, 600), 320, (320, 240)),
        ((3, 3), 8, (1, 1)),
    ],
)
def test_resolution_rule(size, resolution, expected):
    assert fitted_size(*size, resolution) == expected


@pytest.mark.parametrize("resolution", [0, -2, -1600])
def test_a_resolution_that_makes_no_sense_is_refused(resolution):
    with pytest.raises(ConfigError, match=f"resolution {resolution} makes no sense"):
        fitted_size(100, 100, resolution)


@given(st.integers(1, 20_000), st.integers(1, 20_000), st.sampled_from([-1, 1, 2, 4, 8, 400]))
def test_a_fitted_size_keeps_the_aspect_to_a_pixel(width, height, resolution):
    w, h = fitted_size(width, height, resolution)
    assert w >= 1
    assert h >= 1
    scale = w / width
    assert abs(h - height * scale) <= 1 + height / width  # both sides were rounded, the width's error is amplified


def save(path, array, mode=None):
    Image.fromarray(array).save(path) if mode is None else Image.fromarray(array).convert(mode).save(path)
    return path


RAMP = np.arange(48, dtype=np.uint8).reshape(6, 8)


def test_16_bit_grey_keeps_its_upper_byte(tmp_path):
    path = save(tmp_path / "a.png", (RAMP.astype(np.uint16) << 8) + 255)
    pixels = load_picture(path)
    assert pixels.dtype == np.uint8
    np.testing.assert_array_equal(pixels, np.repeat(RAMP[..., None], 3, axis=2))


def png16(path, array):
    """A 16-bit PNG with 1 to 4 channels, written by hand: Pillow writes such files in grey only."""
    height, width, channels = array.shape

    def chunk(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in array)
    head = struct.pack(">IIBBBBB", width, height, 16, {1: 0, 2: 4, 3: 2, 4: 6}[channels], 0, 0, 0)
    content = chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + content)
    return path


@pytest.mark.parametrize("channels", [1, 2, 3, 4])
def test_16_bit_pictures_of_any_kind_keep_their_upper_byte(tmp_path, channels):
    wide = np.arange(6 * 8 * channels, dtype=np.uint16).reshape(6, 8, channels) * 300 + 17
    path = png16(tmp_path / "a.png", wide)
    high = (wide >> 8).astype(np.uint8)
    colour = high[..., : 3 if channels > 2 else 1]
    np.testing.assert_array_equal(load_picture(path)[..., :3], np.broadcast_to(colour, (6, 8, 3)))
    assert picture_header(path) == (8, 6, channels in (2, 4))
    if channels in (2, 4):
        np.testing.assert_array_equal(load_picture(path)[..., 3], high[..., -1])
        np.testing.assert_array_equal(load_mask(path, (8, 6)), high[..., -1] >= 128)


def test_float_tiff_in_0_to_1_becomes_8_bit(tmp_path):
    path = tmp_path / "a.tif"
    Image.fromarray(np.full((2, 2), 0.5, np.float32)).save(path)
    assert load_picture(path).max() == 127


@pytest.mark.parametrize("mode", ["L", "1", "P", "CMYK", "RGB"])
def test_every_opaque_mode_becomes_rgb(tmp_path, mode):
    path = tmp_path / ("a.jpg" if mode == "CMYK" else "a.png")
    Image.fromarray(np.zeros((6, 8, 3), np.uint8)).convert(mode).save(path)
    assert load_picture(path).shape == (6, 8, 3)
    assert picture_header(path) == (8, 6, False)


@pytest.mark.parametrize("mode", ["LA", "RGBA"])
def test_alpha_is_kept_or_left_out(tmp_path, mode):
    rgba = np.full((6, 8, 4), 120, np.uint8)
    path = save(tmp_path / "a.png", rgba, mode)
    assert picture_header(path) == (8, 6, True)
    np.testing.assert_array_equal(load_picture(path), rgba)
    np.testing.assert_array_equal(load_picture(path, alpha=False), rgba[..., :3])


def test_16_bit_grey_with_a_transparent_value_is_a_picture_without_alpha(tmp_path):
    path = tmp_path / "a.png"
    Image.fromarray(RAMP.astype(np.uint16) << 8).save(path, transparency=256)
    assert picture_header(path) == (8, 6, False)
    assert load_picture(path).shape == (6, 8, 3)


@pytest.mark.filterwarnings("error")
def test_a_palette_with_alpha_becomes_rgb_without_a_warning(tmp_path):
    path = tmp_path / "a.png"
    picture = Image.new("P", (4, 3), 1)
    picture.putpalette([9, 8, 7, 60, 50, 40])
    picture.save(path, transparency=b"\x80\x00")
    assert load_picture(path, alpha=False)[0, 0].tolist() == [60, 50, 40]
    assert load_picture(path)[0, 0].tolist() == [60, 50, 40, 0]
    assert not load_mask(path, (4, 3)).any()


def test_resizing_is_pillows_bicubic_and_an_equal_size_is_untouched(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (30, 40, 3), dtype=np.uint8)
    path = save(tmp_path / "a.png", rgb)
    np.testing.assert_array_equal(load_picture(path, (40, 30)), rgb)
    expected = np.asarray(Image.fromarray(rgb).resize((20, 15), Image.Resampling.BICUBIC))
    np.testing.assert_array_equal(load_picture(path, (20, 15)), expected)


def test_hidden_colour_does_not_bleed_when_rgba_is_resized(tmp_path):
    rgba = np.zeros((8, 8, 4), np.uint8)
    rgba[:, :4] = (200, 100, 50, 255)
    rgba[:, 4:, :3] = 255  # white under alpha 0
    small = load_picture(save(tmp_path / "a.png", rgba), (4, 4))
    opaque = small[..., 3] > 128
    assert np.abs(small[opaque, :3].astype(int) - [200, 100, 50]).max() <= 4  # premultiplied 8 bit, rounded twice
    bled = np.asarray(Image.fromarray(rgba[..., :3]).resize((4, 4), Image.Resampling.BICUBIC))
    assert np.abs(bled[opaque].astype(int) - [200, 100, 50]).max() > 8


def test_masks_come_from_brightness_or_alpha(tmp_path):
    grey = np.array([[0, 127], [128, 255]], np.uint8)
    np.testing.assert_array_equal(load_mask(save(tmp_path / "g.png", grey), (2, 2)), [[False, False], [True, True]])
    rgba = np.dstack([np.zeros((2, 2, 3), np.uint8), grey])
    np.testing.assert_array_equal(load_mask(save(tmp_path / "a.png", rgba), (2, 2)), [[False, False], [True, True]])


@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n", b"GIF89a", b"II*\0" + b"\xff" * 40])
def test_what_is_no_picture_is_one_clear_line(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    for read in (picture_header, load_picture, lambda p: load_mask(p, (2, 2))):
        with pytest.raises(SceneError, match=r"a\.png: .*picture|a\.png: the mask") as caught:
            read(path)
        assert "\n" not in str(caught.value)


EPS = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"


def test_postscript_is_no_picture_whatever_its_suffix(tmp_path):
    # Pillow hands EPS to Ghostscript: a stranger's file would be executed.
    (tmp_path / "a.png").write_bytes(EPS)
    for read in (picture_header, load_picture, lambda p: load_mask(p, (2, 2))):
        with pytest.raises(SceneError, match="cannot identify image file"):
            read(tmp_path / "a.png")


def test_it_must_be_clear_which_file_is_meant(tmp_path):
    for name in ("a.png", "a.jpg", "b.jpg", "sub/b.jpg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    assert find_pictures(tmp_path, ["a.png", "b.JPG", "sub/b.png"]) == [
        tmp_path / "a.png", tmp_path / "b.jpg", tmp_path / "sub" / "b.jpg"
    ]  # fmt: skip
    with pytest.raises(SceneError, match=r"image 'a\.tif' is not there, and a\.jpg and a\.png could both stand for it"):
        find_pictures(tmp_path, ["a.tif"])
    with pytest.raises(SceneError, match=r"b\.jpg is the only file for two images, 'b\.png' and 'b\.jpg'"):
        find_pictures(tmp_path, ["b.png", "b.jpg"])


def test_links_in_a_ring_come_to_an_end(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "x.png").write_bytes(b"")
        for link in ("up", "again"):
            (tmp_path / name / link).symlink_to(tmp_path, target_is_directory=True)
    assert list_pictures(tmp_path) == ["a/x.png", "b/x.png"]


@pytest.mark.parametrize("name", ["y" * 400 + ".png", "a\nb.png", "\ud800.png", "\x1b[2J.png"])
def test_a_name_that_no_file_can_have_is_missing_in_one_printable_line(tmp_path, name):
    with pytest.raises(SceneError, match="1 of 1 images are missing") as caught:
        find_pictures(tmp_path, [name])
    assert str(caught.value).isprintable()


@pytest.mark.parametrize("name", ["/etc/x.png", "../x.png", "a/../../x.png", "..\\x.png", "", ".", "a\0.png"])
def test_names_that_lead_out_are_recognised(name):
    assert not is_inside(name)


@pytest.mark.parametrize("name", ["x.png", "a/b.png", "a..b.png", "..a/b.png", "./a.png", "ü/ b.png"])
def test_ordinary_names_are_inside(name):
    assert is_inside(name)


def test_pictures_of_more_pixels_than_the_limit_are_refused_by_their_header(tmp_path, monkeypatch):
    """6 kB of WebP may claim 164 megapixels, 2.7 GB for each thread that decodes."""
    path = tmp_path / "wide.png"
    Image.new("1", (9000, 8000)).save(path)
    for read in (picture_header, load_picture):
        with pytest.raises(SceneError, match=r"9000x8000 px, more than the 67,108,864 .* set SPLATWIZARD_MAX_PIXELS"):
            read(path)
    monkeypatch.setenv("SPLATWIZARD_MAX_PIXELS", "72000000")
    assert picture_header(path) == (9000, 8000, False)
    monkeypatch.setenv("SPLATWIZARD_MAX_PIXELS", "many")
    with pytest.raises(ConfigError, match="SPLATWIZARD_MAX_PIXELS is 'many'"):
        picture_header(path)
