"""Colours and markers: one style a method on every page, and colours that people with colour blindness tell apart."""

import itertools
import re
from importlib import resources

import numpy as np
import pytest
from sw_report.charts import STYLES
from sw_report.method_styles import METHOD_STYLES, style_of_method, styles_of
from sw_report.page import PageOptions, render_page
from sw_report.runs import collect

FIELD = ("3dgs", "2dgs", "flat-3dgs", "trim-3dgs", "trim-2dgs", "trim-2dgs-scratch", "hac", "hac-plus", "cat-3dgs",
         "c3dgs", "compact3dgs", "chimerags", "mesongs", "lightgaussian", "pup-3dgs", "speedy-splat",
         "trimming-the-fat")  # fmt: skip

# Linear RGB as people without one kind of cone see it (severity 1.0).
# Source: Machado et al., A Physiologically-based Model for Simulation of Color Vision Deficiency (2009), table 1.
SIGHT = {
    "usual": np.eye(3),
    "protanopia": np.array([[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
                            [-0.003882, -0.048116, 1.051998]]),
    "deuteranopia": np.array([[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
                              [-0.011820, 0.042940, 0.968881]]),
    "tritanopia": np.array([[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602],
                            [0.004733, 0.691367, 0.303900]]),
}  # fmt: skip


def linear(colour):
    values = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    to_xyz = np.array([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750],
                       [0.0193339, 0.1191920, 0.9503041]])  # fmt: skip
    x = to_xyz @ np.clip(rgb, 0, 1) / [0.95047, 1.0, 1.08883]
    f = np.where(x > 216 / 24389, np.cbrt(x), (24389 / 27 * x + 16) / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(first, second):
    """Distance of two CIELAB colours. Source: Sharma et al., The CIEDE2000 Color-Difference Formula (2005)."""
    mean_c = (np.hypot(*first[1:]) + np.hypot(*second[1:])) / 2
    stretch = 1 + 0.5 * (1 - np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7)))
    (l1, c1, h1), (l2, c2, h2) = (
        (L, np.hypot(a * stretch, b), np.degrees(np.arctan2(b, a * stretch)) % 360) for L, a, b in (first, second)
    )
    turn = (h2 - h1 + 180) % 360 - 180 if c1 * c2 else 0.0
    light, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    hue = (h1 + turn / 2) % 360 if c1 * c2 else h1 + h2
    cos = [np.cos(np.radians(angle)) for angle in (hue - 30, 2 * hue, 3 * hue + 6, 4 * hue - 63)]
    t = 1 - 0.17 * cos[0] + 0.24 * cos[1] + 0.32 * cos[2] - 0.20 * cos[3]
    d_l = (l2 - l1) / (1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2))
    d_c = (c2 - c1) / (1 + 0.045 * chroma)
    d_h = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * t)
    bend = 60 * np.exp(-(((hue - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(bend))
    return float(np.sqrt(d_l**2 + d_c**2 + d_h**2 + rotation * d_c * d_h))


def themes():
    sheet = resources.files("sw_report").joinpath("templates/style.css").read_text("utf-8")
    blocks = re.findall(r"\{\s*color-scheme: (?:light|dark);([^}]*)\}", sheet)
    assert len(blocks) == 4  # light, dark as the system says, dark by the button, paper
    found = [dict(re.findall(r"--(\w+): (#\w+);", block)) for block in blocks]
    return [{name: value if len(value) > 4 else "#" + "".join(2 * c for c in value[1:]) for name, value in each.items()}
            for each in found]  # fmt: skip


def test_the_distance_of_these_tests_is_the_published_one():
    pairs = [  # rows 1, 7, 17 and 24 of the formula's table of test data
        ((50, 2.6772, -79.7751), (50, 0, -82.7485), 2.0425), ((50, 0, 0), (50, -1, 2), 2.3669),
        ((50, 2.5, 0), (73, 25, -18), 27.1492), ((35.0831, -44.1164, 3.7933), (35.0232, -40.0716, 1.5901), 1.8645),
    ]  # fmt: skip
    for first, second, distance in pairs:
        assert ciede2000(np.array(first, float), np.array(second, float)) == pytest.approx(distance, abs=1e-4)


@pytest.mark.parametrize("sight", SIGHT)
def test_any_two_colours_are_more_than_10_apart(sight):
    for theme in themes():
        seen = [lab(SIGHT[sight] @ linear(theme[f"s{i}"])) for i in range(STYLES)]
        assert min(ciede2000(a, b) for a, b in itertools.combinations(seen, 2)) > 10


def test_every_colour_stands_out_from_the_paper():
    for theme in themes():
        paper, *series = (
            linear(theme[name]) @ [0.2126, 0.7152, 0.0722] for name in ("paper", *(f"s{i}" for i in range(STYLES)))
        )
        for luminance in series:
            assert (max(luminance, paper) + 0.05) / (min(luminance, paper) + 0.05) >= 3


def test_no_two_methods_of_the_field_look_alike():
    styles = [style_of_method(method) for method in FIELD]
    assert len(set(styles)) == len(styles)
    assert max(sum(style % STYLES == colour for style in styles) for colour in range(STYLES)) == 3
    together = FIELD[:1] + FIELD[6:14]
    assert len({style_of_method(method) % STYLES for method in together}) == STYLES  # nine methods
    surfaces = FIELD[1:6]
    assert len({style_of_method(method) % STYLES for method in surfaces}) == len(surfaces)


def test_a_method_looks_alike_whatever_stands_beside_it(make_curve, tmp_path):
    make_curve("3dgs")
    alone = styles_of(collect([tmp_path]).runs)
    for method in ("hac", "another", "lightgaussian"):
        make_curve(method)
    together = styles_of(collect([tmp_path]).runs)
    assert alone["3dgs"] == together["3dgs"] == style_of_method("3dgs")
    assert len(set(together.values())) == 4


def test_configurations_of_a_method_share_its_colour_and_nothing_else(make_run, tmp_path):
    for preset in ("paper", "quick", "slow"):
        make_run(out=tmp_path / preset, change=lambda c, preset=preset: c.update(preset=preset))
    styles = styles_of(collect([tmp_path]).runs)
    assert len(styles) == len(set(styles.values())) == 3
    assert {style % STYLES for style in styles.values()} == {style_of_method("toy") % STYLES}


def test_methods_of_one_number_are_told_apart(make_run, tmp_path):
    other = next(name for name in map(str, range(10_000)) if style_of_method(name) == style_of_method("toy"))
    for method in ("toy", other):
        make_run(method=method)
    styles = styles_of(collect([tmp_path]).runs)
    assert sorted(style == style_of_method("toy") for style in styles.values()) == [False, True]
    assert max(styles.values()) < METHOD_STYLES


def test_a_method_has_one_colour_through_the_whole_page(make_curve, tmp_path):
    for method in ("3dgs", "toy"):
        make_curve(method)
    text = render_page(collect([tmp_path]), PageOptions(pictures=False))
    for method in ("3dgs", "toy"):
        name = rf"{method}(?: \((?:r\d(?:, )?)+\)| r\d)?"
        keys = re.findall(rf'swatch s(\d)"(?:(?!<li>).)*?</svg> {name}</li>', text, re.S)
        assert len(keys) > 4  # curves, trainings, views
        assert set(keys) == {str(style_of_method(method) % STYLES)}
