"""rd.svg: a picture that stands alone."""

from xml.etree import ElementTree

from sw_report.rd_file import rd_svg
from sw_report.runs import collect

SVG = "{http://www.w3.org/2000/svg}"
HOSTILE = "<script>alert('x')</script>&\""


def test_it_is_a_whole_svg_with_every_method_in_every_chart(make_curve, tmp_path):
    for i in range(10):
        make_curve(f"method-{i}", saving=1 - i / 20)
    tree = ElementTree.fromstring(rd_svg(collect([tmp_path]).runs, "Rate and distortion on garden"))
    assert tree.tag == f"{SVG}svg"
    charts = [e for e in tree.iter(f"{SVG}svg") if e.get("class") == "chart"]
    assert [c.get("aria-label", "").split(" against")[0] for c in charts] == ["PSNR dB", "SSIM"]
    assert all(c.get("width") and c.get("height") for c in charts)  # nested, without a size it would fill the whole
    for chart in charts:
        assert len([g for g in chart.iter(f"{SVG}g") if g.get("class") == "point"]) == 10 * 4
    legend = [e.text for e in tree.iter(f"{SVG}text") if e.get("class") == "name" and e.get("x") == "36"]
    assert legend == [f"method-{i}" for i in range(10)]
    moved = [e.get("transform") for e in tree.iter(f"{SVG}g") if e.get("transform", "").startswith("translate")]
    assert all(0 <= float(each[10:].partition(",")[0]) <= float(tree.get("width")) for each in moved)


def test_more_methods_than_colours_are_told_apart(make_curve, tmp_path):
    for i in range(10):
        make_curve(f"method-{i}", saving=1 - i / 20)
    tree = ElementTree.fromstring(rd_svg(collect([tmp_path]).runs, "x"))
    looks = [
        (swatch.get("class"), [path.get("d") for path in swatch.iter(f"{SVG}path")][1])
        for swatch in tree.iter(f"{SVG}svg")
        if "swatch" in swatch.get("class", "")
    ]
    assert len(set(looks)) == len(looks) == 10


def test_it_asks_for_nothing_and_knows_both_themes(make_curve, tmp_path):
    make_curve()
    text = rd_svg(collect([tmp_path]).runs, HOSTILE)
    assert "var(" not in text  # few drawing programs know variables
    assert "prefers-color-scheme: dark" in text
    assert "url(" not in text
    assert "href" not in text
    assert "<script" not in text
    assert ElementTree.fromstring(text).get("aria-label") == HOSTILE


def test_without_a_score_there_is_nothing_to_draw(make_run, tmp_path):
    make_run(change=lambda content: content.update(metrics={}))
    assert rd_svg(collect([tmp_path]).runs, "x") is None
