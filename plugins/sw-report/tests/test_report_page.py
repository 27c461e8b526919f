"""The page as a file: valid, closed to the network, escaped, bounded, and honest about what is not there."""

import base64
import hashlib
import re
from html.parser import HTMLParser
from typing import Any

import pytest
from sw_report import pictures
from sw_report.page import PageOptions, render_page, write_page
from sw_report.runs import collect

from splatwizard_core.tooling import as_installed

VOID = {"meta", "img", "input", "br", "hr", "link"}
HOSTILE = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\"'&{{ 7*7 }}"


class Page(HTMLParser):
    """Elements with their attributes, and whatever is not nested as it should be."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.faults: list[str] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        self.faults += [f"<{tag}> is never closed" for tag in self._open]

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        names = [name for name, _ in attrs]
        if len(set(names)) < len(names):
            self.faults.append(f"<{tag}> has an attribute twice: {names}")
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if not self._open or self._open[-1] != tag:
            self.faults.append(f"</{tag}> closes {self._open[-3:]}")
        else:
            self._open.pop()

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


def page(*paths: Any, **options: Any) -> Page:
    return Page(render_page(collect(list(paths)), PageOptions(**options)))


@pytest.fixture
def kinds(make_run, make_curve, tmp_path):
    """A page about one run, and one about several methods and scenes."""
    one = make_run("r9", out=tmp_path / "one")
    for scene in ("a", "b"):
        make_curve("toy", scene=scene)
        make_curve("3dgs", 0.5, scene=scene)
    return [page(one), page(tmp_path / "out")]


def test_the_html_is_well_formed_and_its_anchors_lead_somewhere(kinds):
    for found in kinds:
        assert found.faults == []
        names = [a["id"] for _, a in found.elements if "id" in a]
        assert len(set(names)) == len(names)
        assert {a["href"] for a in found.all("a")} <= {f"#{name}" for name in names}
        assert [a.get("lang") for a in found.all("html")] == ["en"]
        assert len(found.all("h1")) == len(found.all("main")) == 1


def test_the_page_asks_nothing_of_the_network(kinds, tmp_path):
    for found in kinds:
        for tag, attributes in found.elements:
            for name in ("src", "href", "srcset", "data", "action", "poster", "xlink:href"):
                value = attributes.get(name)
                assert value is None or value.startswith(("data:", "#")), (tag, name, value)
        assert found.all("link") == []
    text = render_page(collect([tmp_path / "one"]), PageOptions())
    style = re.search(r"<style>(.*?)</style>", text, re.S)[1]
    assert "url(" not in style
    assert "@import" not in style
    script = re.search(r"<script>(.*?)</script>", text, re.S)[1]
    assert not re.search(r"fetch|XMLHttp|WebSocket|import\(|https?:|eval|innerHTML|document\.write", script)


def test_only_the_pages_own_script_may_run(kinds, tmp_path):
    text = render_page(collect([tmp_path / "one"]), PageOptions())
    (policy,) = (a["content"] for a in kinds[0].all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    script = re.search(r"<script>(.*?)</script>", text, re.S)[1]
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert "default-src 'none'" in policy
    assert f"script-src 'sha256-{digest}';" in policy
    assert len(kinds[0].all("script")) == 1


def test_pictures_have_texts_and_sizes_and_tables_have_headers(kinds):
    for found in kinds:
        assert len(found.all("img")) >= 3
        for image in found.all("img"):
            assert image["alt"]
            assert int(image["width"]) > 0
            assert int(image["height"]) > 0
        assert all(th.get("scope") in ("col", "row") for th in found.all("th"))
        assert all(svg.get("aria-label") or svg.get("aria-hidden") for svg in found.all("svg"))
        scrolls = [d for d in found.all("div") if "scroll" in (d.get("class") or "")]
        assert all(d.get("tabindex") == "0" and d.get("aria-label") and d.get("role") == "group" for d in scrolls)
        assert len(scrolls) == len(found.all("table"))


ONE = (
    "Renders beside the ground truth", "Scores view by view", "Bytes by section", "Training loss",
    "Number of Gaussians", "Time and memory", "Protocol", "Environment", "Configuration", "standard (BACKWARD)",
    "SHA-256 of the file",
)  # fmt: skip
MANY = (
    "Means over scenes", "Rate saved against the anchor", "The anchor is 3dgs.", "+100.0", "Rate and distortion",
    "PSNR, dB", "SSIM", "Bytes by section", "Training loss", "Scores view by view", "Protocol", "Environment",
)  # fmt: skip


def test_everything_asked_for_is_there(kinds):
    for found, wanted in zip(kinds, (ONE, MANY), strict=True):
        assert [words for words in wanted if words not in found.text] == []


def test_the_page_begins_with_the_answer(make_curve, tmp_path):
    make_curve("toy")
    make_curve("3dgs", 0.5)
    found = page(tmp_path)
    heads = [attributes["id"] for tag, attributes in found.elements if tag == "h2"]
    assert heads == [
        "results", "rate-and-distortion", "renders-beside-the-ground-truth", "bd", "bytes-by-section", "training",
        "scores-view-by-view", "provenance",
    ]  # fmt: skip
    assert "Bold: the best of its column." in found.text
    assert any((table.get("class") or "").split() == ["sortable"] for table in found.all("table"))
    assert "sw run --method 3dgs --scene garden --preset paper --rate r1 --set iterations=300" in found.text


def test_there_is_no_section_of_bd_values_where_there_are_none(make_run, tmp_path):
    make_run(method="toy")
    make_run(method="3dgs")
    found = page(tmp_path)
    assert "bd" not in [attributes.get("id") for _, attributes in found.elements]


def test_names_from_strangers_stay_text(make_run, make_curve, tmp_path):
    def rename(content):
        content["scene"] = content["method"] = content["rate"] = HOSTILE
        content["views"] = [HOSTILE, *content["views"][1:]]
        content["file"]["sections"] = {HOSTILE: 1000}
        content["environment"] = {HOSTILE: HOSTILE, "cpu": HOSTILE, "packages": {HOSTILE: HOSTILE}}
        content["protocol"]["id"] = content["protocol"][HOSTILE] = HOSTILE
        content["rasterizers"] = {"train": {HOSTILE: HOSTILE}}
        content["config"] = {"config": {HOSTILE: HOSTILE}, "provenance": {HOSTILE: HOSTILE}}
        content["metrics"][HOSTILE] = {"mean": None, "per_view": [], "direction": HOSTILE}
        content["unknown"][f"metrics.{HOSTILE}.mean"] = HOSTILE
        content["flags"] = [HOSTILE]
        content["date"] = HOSTILE

    hostile = make_run(change=rename)
    other = make_run("r2", change=lambda c: (rename(c), c.update(rate="r2")))
    for found in (page(hostile), page(hostile, other)):
        assert found.faults == []
        assert len(found.all("script")) == 1
        assert not any(name.startswith("on") for _, attributes in found.elements for name in attributes)
        assert all(image["src"].startswith("data:") for image in found.all("img"))
        assert HOSTILE in found.text


@pytest.mark.usefixtures("advice_as_installed")
def test_advice_on_the_page_is_that_of_the_terminal(make_run):
    """None of our packages is on an index: what is shown names the checkout, or the wheels, that this came from."""
    advice = "weights-missing: pip install 'sw-metrics[lpips]'"

    def without_weights(content):
        content["metrics"]["lpips_vgg"] = {"mean": None, "per_view": [], "direction": "lower"}
        content["unknown"]["metrics.lpips_vgg.mean"] = advice

    found = page(make_run(change=without_weights))
    assert as_installed(advice) != advice
    assert as_installed(advice) in found.text
    assert advice not in found.text


def test_a_run_without_its_files_says_what_is_missing(make_run):
    found = page(make_run(keep=()))
    assert found.all("img") == []
    for words in ("no ground truth: the run kept none", "its renders are not in its folder", "no log.jsonl"):
        assert words in found.text, words


def test_what_an_old_record_lacks_is_a_dash(make_run):
    def age(content):
        content["schema_version"] = 0
        for name in ("speed", "memory", "train", "codec", "environment", "rasterizers", "config", "views", "plan",
                     "counts", "visible_gaussians", "date", "flags"):  # fmt: skip
            del content[name]
        content["file"].pop("sections")
        for metric in content["metrics"].values():
            metric["per_view"] = []

    old = make_run(change=age)
    found = page(old)
    assert found.faults == []
    for words in ("record of schema 0", "The record holds no scores of single views", "lists no sections", "– FPS"):
        assert words in found.text, words
    assert page(old, make_run("r2", size=5000)).faults == []


def test_the_page_of_one_run_tells_the_psnr_of_training_views(make_run):
    def measure(content):
        content["training_psnr"] = {"mean": 35.294, "median": 35.3, "quantile_05": 33.52, "far_below": {}}

    told = "Training views: PSNR 35.29 dB in the mean; 5 % of them have 33.52 dB or less."
    one, other = make_run(change=measure), make_run("r2", change=measure)
    assert told in page(one).text
    assert told not in page(one, other).text
    assert "Training views" not in page(make_run("r3")).text


def test_different_protocols_stand_apart_and_are_flagged(make_run, tmp_path):
    make_run("r1")
    make_run("r2", change=lambda c: c["protocol"].update(id="colmap/images/r4/every8/black/pp-center/q8", resolution=4))
    found = page(tmp_path)
    assert "measured under 2 protocols, which are not comparable and stand apart" in found.text
    assert len([s for s in found.all("section") if (s["aria-labelledby"] or "").startswith("scene-")]) == 2
    assert "differs" in found.text


def test_the_page_stays_small(make_run, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures.PictureBudget.__init__, "__defaults__", (160, 60_000))
    for i in range(12):
        make_run(f"r{i}", noise=20.0, size=1000 + i, pixels=(200, 150))
    write_page(collect([tmp_path]), tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    held = sum(len(data) * 3 // 4 for data in re.findall(r"base64,([A-Za-z0-9+/=]+)", text))
    assert 20_000 < held <= 60_000
    assert "holds as many" in text


def test_no_pictures_when_none_are_wanted(make_run):
    assert page(make_run(), pictures=False).all("img") == []


def test_scenes_in_3d_are_linked_from_where_the_page_lies(make_run, tmp_path):
    runs = [make_run(rate, out=tmp_path / "out & more") for rate in ("r1", "r2", "r3")]

    def links(path, *of):
        write_page(collect(list(of)), path, PageOptions(pictures=False))
        return [a["href"] for a in Page(path.read_text()).all("a") if not a["href"].startswith("#")]

    assert links(runs[0] / "report.html", runs[0]) == []
    for run in runs[:2]:
        (run / "scene.html").write_text("")
    assert links(runs[0] / "report.html", runs[0]) == ["scene.html"]
    above = tmp_path / "report.html"
    found = links(above, *runs)
    assert len(found) == 2
    assert all("%20%26%20" in address and address.endswith("/scene.html") for address in found)
    assert "In 3D:" in Page(above.read_text()).text


def test_the_page_is_written_whole_or_not_at_all(make_run, tmp_path):
    target = tmp_path / "report.html"
    target.write_text("before")
    with pytest.raises(Exception, match="no run is of it"):
        write_page(collect([make_run("r1"), make_run("r2")]), target, PageOptions(anchor="nobody"))
    assert target.read_text() == "before"


def test_the_parser_of_these_tests_sees_faults():
    assert Page("<p><b>x</p>").faults
    assert Page("<div>").faults
    assert Page('<p id="a" id="b"></p>').faults
