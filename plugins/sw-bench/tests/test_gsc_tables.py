"""Tables of the protocol: columns as they were, parts that sum, BD-rates with closed forms."""

from __future__ import annotations

import csv
import io
import math

import pytest
from sw_bench.gsc.tables import BD_COLUMNS, COLUMNS, bd_rows, csv_text, parts_of, pooled, summary

GOLDEN = (
    "sequence,codec,rate,protocol,frames,views,splats_source,splats_decoded,bytes,bits_per_splat,bytes_position,bytes_sh0,"
    "bytes_sh1,bytes_sh2,bytes_sh3,bytes_rotation,bytes_scaling,bytes_opacity,bytes_metadata,kbps,psnr_rgb,psnr_rgb_min,"
    "psnr_rgb_max,psnr_rgb_pooled,psnr_yuv,psnr_yuv_min,psnr_yuv_max,ssim_yuv,ssim_yuv_min,ssim_yuv_max,om_psnr_rgb,"
    "om_ssim_yuv,occupancy,infinite_views,enc_s,dec_s,rss_enc_mb,rss_dec_mb,flags"
)


def view(mse: float, ssim: float = 0.9) -> dict:
    psnr = None if mse == 0 else 10 * math.log10(255**2 / mse)
    return {"mse_rgb": mse, "mse_yuv": mse, "psnr_rgb": psnr, "psnr_yuv": psnr, "ssim_yuv": ssim, "om_psnr_rgb": psnr,
            "om_ssim_yuv": ssim, "occupancy": 50.0}  # fmt: skip


def curve(codec: str, factor: float = 1.0, infinite: int = 0, sequence: str = "chair", points: int = 5) -> list[dict]:
    """A codec whose quality grows with the logarithm of its bytes; `factor` multiplies these."""
    rows = []
    for i in range(points):
        quality = {"psnr_rgb": 30.0 + 3 * i, "psnr_yuv": 33.0 + 3 * i, "ssim_yuv": 0.9 + 0.01 * i}
        rows.append({"sequence": sequence, "codec": codec, "rate": f"r{i + 1}", "bytes": round(1000 * 2**i * factor),
                     "infinite_views": infinite, "psnr_rgb_pooled": 29.0 + 3 * i, "psnr_yuv_pooled": 32.0 + 3 * i,
                     **quality})  # fmt: skip
    return rows


def test_the_columns_are_the_ones_of_the_protocol():
    assert csv_text(COLUMNS, []) == GOLDEN + "\n"
    assert BD_COLUMNS[-1] == "note"


def test_what_is_not_known_is_empty_and_no_text_is_a_formula():
    row = {"sequence": "=cmd()", "codec": "spz", "bytes": 7, "psnr_rgb": None, "ssim_yuv": 1.0, "flags": 'a,"b"'}
    (found,) = csv.DictReader(io.StringIO(csv_text(COLUMNS, [row])))
    assert (found["sequence"], found["psnr_rgb"], found["kbps"], found["ssim_yuv"]) == ("'=cmd()", "", "", "1")
    assert found["flags"] == 'a,"b"'


def test_a_mean_is_over_the_views_that_differ_and_the_pooled_one_over_all():
    found = summary([view(1.0), view(100.0), view(0.0, 1.0)])
    assert (found["views"], found["infinite_views"]) == (3, 1)
    assert found["psnr_rgb"] == pytest.approx((48.1308 + 28.1308) / 2, abs=1e-4)
    assert (found["psnr_rgb_min"], found["psnr_rgb_max"]) == pytest.approx((28.1308, 48.1308), abs=1e-4)
    assert found["psnr_rgb_pooled"] == pytest.approx(10 * math.log10(255**2 / (101 / 3)))
    assert summary([view(0.0, 1.0)])["psnr_rgb_pooled"] is None
    assert pooled([2.0, 2.0]) == pytest.approx(10 * math.log10(255**2 / 2))


def test_parts_sum_to_the_bytes_or_are_all_unknown():
    sections = {"header": 900, "position": 50, "sh0": 30, "rotation": 5, "scaling": 6, "opacity": 7}
    parts = parts_of(sections, 998)
    assert sum(parts.values()) == 998
    assert parts["bytes_metadata"] == 900
    assert parts["bytes_sh3"] == 0
    assert set(parts_of({"header": 1, "file": 99}, 100).values()) == {None}


def test_a_codec_against_itself_is_0_and_with_twice_the_bytes_100_percent():
    rows = curve("anchor") + curve("same") + curve("twice", 2.0)
    found = {(row["sequence"], row["codec"]): row for row in bd_rows(rows, "anchor")}
    for name in ("psnr_rgb", "psnr_yuv", "ssim_yuv"):
        assert found["chair", "same"][f"bd_{name}"] == pytest.approx(0, abs=1e-9)
        assert found["chair", "twice"][f"bd_{name}"] == pytest.approx(100, abs=1e-9)
        assert found["mean", "twice"][f"bd_{name}"] == pytest.approx(100, abs=1e-9)
    assert found["mean", "same"]["note"] == "scenes: psnr_rgb 1 of 1, psnr_yuv 1 of 1, ssim_yuv 1 of 1"


def test_the_mean_is_over_the_scenes_that_have_a_value():
    rows = curve("anchor") + curve("c", 2.0) + curve("anchor", sequence="lego") + curve("c", sequence="lego", points=3)
    found = bd_rows(rows, "anchor")
    assert [(row["sequence"], row["codec"]) for row in found] == [("chair", "c"), ("mean", "c")]
    fallen = curve("c", 2.0, sequence="lego")
    fallen[4]["psnr_rgb"] = 30.5
    found = bd_rows(curve("anchor") + curve("c", 2.0) + curve("anchor", sequence="lego") + fallen, "anchor")
    (lego,) = (row for row in found if row["sequence"] == "lego")
    assert lego["bd_psnr_rgb"] is None
    assert "a larger file is not better" in lego["note"]
    assert found[-1]["note"].startswith("scenes: psnr_rgb 1 of 2, psnr_yuv 2 of 2")


def test_views_without_a_psnr_make_all_codecs_pooled():
    rows = curve("anchor") + curve("c", 2.0, infinite=1)
    rows[4]["psnr_rgb_pooled"] = rows[4]["psnr_yuv_pooled"] = None  # the anchor's best: every view equal
    (found, _) = bd_rows(rows, "anchor")
    assert found["bd_psnr_rgb"] == pytest.approx(100, abs=1e-6)
    assert found["note"].startswith("pooled PSNR; psnr_rgb: 1 points of anchor without a value")


def test_a_codec_without_a_dial_has_no_curve():
    assert bd_rows(curve("anchor") + curve("c", points=1), "anchor") == []
