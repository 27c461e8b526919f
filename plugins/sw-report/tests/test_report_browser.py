"""The page in a browser: what can be moved moves, nothing runs over, nothing complains, and it can be printed.

Needs a Chromium; skips without one. Screenshots stay in pytest's temporary folder, to be looked at.
"""

import json
import os
from pathlib import Path

import pytest
from headless_chromium import Chromium, find_chromium
from sw_report.page import PageOptions, write_page
from sw_report.runs import collect

pytestmark = [pytest.mark.slow, pytest.mark.skipif(find_chromium() is None, reason="no Chromium is installed")]

PHONE, TABLET, DESKTOP = 390, 768, 1280
AXE = Path(os.environ.get("SPLATWIZARD_AXE", "node_modules/axe-core/axe.min.js"))
# Of every text, the contrast with what it stands on, by WCAG 2.1; texts over pictures have a ground of their own.
CONTRAST = """
(() => {
  const rgb = c => c.match(/[\\d.]+/g).map(Number);
  const light = c => { const [r, g, b] = rgb(c).map(v => v / 255).map(
    v => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4); return 0.2126 * r + 0.7152 * g + 0.0722 * b; };
  const ground = e => { for (; e; e = e.parentElement) { const c = getComputedStyle(e).backgroundColor;
    if (rgb(c).length < 4 || rgb(c)[3] > 0.5) return c; } return 'rgb(255, 255, 255)'; };
  const found = [];
  for (const e of document.querySelectorAll('body *')) {
    if (e.closest('.stage') || ![...e.childNodes].some(n => n.nodeType === 3 && n.data.trim())) continue;
    if (!e.checkVisibility() || ['SCRIPT', 'STYLE', 'TITLE', 'title'].includes(e.tagName)) continue;
    const style = getComputedStyle(e), ink = e.closest('svg') ? style.fill : style.color;
    const [a, b] = [light(ink), light(ground(e))].sort((x, y) => y - x);
    const ratio = (a + 0.05) / (b + 0.05);
    if (ratio < 4.5) found.push(`${e.tagName} ${e.className.baseVal ?? e.className} ${ratio.toFixed(2)}`);
  }
  return [...new Set(found)];
})()
"""
OVERFLOW = """
[...document.querySelectorAll('body *')].filter(
  e => e.checkVisibility() && !e.closest('.scroll, .pictures, .stage, svg, .skip')
    && e.getBoundingClientRect().right > innerWidth + 1
).map(e => e.outerHTML.slice(0, 90))
"""


# Words of the heads of tables that stand on more than one line.
BROKEN = """
[...document.querySelectorAll('thead th')].flatMap(th => {
  const walker = document.createTreeWalker(th, NodeFilter.SHOW_TEXT), found = [];
  for (let node; (node = walker.nextNode());) for (const word of node.data.matchAll(/\\S+/g)) {
    const range = document.createRange();
    range.setStart(node, word.index);
    range.setEnd(node, word.index + word[0].length);
    if (new Set([...range.getClientRects()].map(box => Math.round(box.top))).size > 1) found.push(word[0]);
  }
  return found;
})
"""


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    found = Chromium(find_chromium(), tmp_path_factory.mktemp("profile"))
    yield found
    found.close()


@pytest.fixture
def pages(make_run, make_curve, tmp_path):
    """A page about one run, and one about two methods on two scenes with long names."""
    one = tmp_path / "one.html"
    write_page(collect([make_run("r9", out=tmp_path / "one", pixels=(300, 200))]), one)
    for scene in ("a", "a-scene-with-a-very-long-name-that-nothing-can-break-in-two"):
        make_curve("toy", scene=scene, pixels=(120, 160))
        make_curve("a-method-with-a-very-long-name", 0.5, scene=scene, pixels=(120, 160))
    many = tmp_path / "many.html"
    write_page(collect([tmp_path / "out"]), many, PageOptions(anchor="toy"))
    return [one, many]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [DESKTOP, TABLET, PHONE])
def test_the_page_fits_is_readable_and_asks_for_nothing(browser, pages, tmp_path, width, scheme):
    for page in pages:
        browser.open(page, width=width, scheme=scheme)
        browser.picture(tmp_path / f"{page.stem}-{width}-{scheme}.png")
        assert browser.ask("document.documentElement.scrollWidth") == width
        assert browser.ask(OVERFLOW) == []
        assert browser.ask(BROKEN) == []
        assert browser.ask(CONTRAST) == []
        assert browser.requests() == [page.resolve().as_uri()]
        assert browser.complaints() == []
        assert browser.ask("[...document.images].every(i => i.naturalWidth > 0)")
        background = browser.ask("getComputedStyle(document.body).backgroundColor")
        assert (sum(map(int, background[4:-1].split(","))) < 200) == (scheme == "dark")


@pytest.mark.skipif(not AXE.exists(), reason="no axe-core (npm install axe-core, or SPLATWIZARD_AXE=axe.min.js)")
@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("width", [DESKTOP, PHONE])
def test_axe_finds_nothing_that_keeps_people_out(browser, pages, width, scheme):
    for page in pages:
        browser.open(page, width=width, scheme=scheme)
        browser.ask(AXE.read_text(encoding="utf-8") + "; true")
        browser.ask("axe.run().then(found => { window.findings = found.violations })")
        found = json.loads(browser.ask("JSON.stringify(window.findings)"))
        assert "\n".join(f"{v['id']}: {v['nodes'][0]['html'][:160]}" for v in found) == ""


def test_no_column_of_the_results_is_cut_on_a_desktop(browser, make_curve, tmp_path):
    def with_lpips(content):
        for name in ("lpips_vgg_3dgs", "lpips_vgg", "lpips_alex", "l1"):
            content["metrics"][name] = {"mean": 0.1234, "per_view": [], "direction": "lower"}

    for method in ("trimming-the-fat", "3dgs"):
        make_curve(method, change=with_lpips)
    write_page(collect([tmp_path / "out"]), tmp_path / "page.html", PageOptions(pictures=False))
    browser.open(tmp_path / "page.html", width=DESKTOP)
    assert browser.ask("(t => t.scrollWidth <= t.clientWidth)(document.querySelector('.sortable').parentElement)")


def test_the_names_of_methods_are_read_in_one_piece_on_a_phone(browser, make_curve, tmp_path):
    def with_lpips(content):
        for name in ("lpips_vgg_3dgs", "lpips_vgg", "lpips_alex", "l1"):
            content["metrics"][name] = {"mean": 0.1234, "per_view": [], "direction": "lower"}

    for method in ("trim-2dgs", "3dgs"):
        make_curve(method, change=with_lpips)
    write_page(collect([tmp_path / "out"]), tmp_path / "page.html", PageOptions(pictures=False))
    browser.open(tmp_path / "page.html", width=PHONE)
    heights = "[...document.querySelectorAll('.sortable tbody th')].map(th => th.getBoundingClientRect().height)"
    assert max(browser.ask(heights)) < 50  # one line, not a letter a line


def test_a_click_on_a_heading_sorts_the_results(browser, make_curve, tmp_path):
    for method, saving in (("toy", 1.0), ("3dgs", 0.5)):
        make_curve(method, saving)
    write_page(collect([tmp_path / "out"]), tmp_path / "page.html", PageOptions(pictures=False))
    browser.open(tmp_path / "page.html", width=DESKTOP)
    head = "[...document.querySelectorAll('.sortable th')].find(th => th.textContent === 'MB')"
    column = (
        f"(at => [...document.querySelectorAll('.sortable tbody tr')].map(r => +r.cells[at].textContent))"
        f"({head}.cellIndex)"
    )
    before = browser.ask(column)
    browser.ask(f"{head}.querySelector('button').click()")
    assert browser.ask(column) == sorted(before) != before
    assert browser.ask(f"{head}.getAttribute('aria-sort')") == "ascending"
    browser.ask(f"{head}.querySelector('button').click()")
    assert browser.ask(column) == sorted(before, reverse=True)


def test_these_checks_would_see_what_they_look_for(browser, pages, tmp_path):
    """Pale text, and a word that nothing can break."""
    text = pages[0].read_text().replace("--muted: #575c63", "--muted: #9a9fa6")
    bad = tmp_path / "bad.html"
    bad.write_text(text.replace('class="lede"', 'class="lede" style="min-width:2000px"'))
    browser.open(bad, width=DESKTOP)
    assert browser.ask(CONTRAST)
    assert browser.ask(OVERFLOW)
    assert browser.ask("document.documentElement.scrollWidth") > DESKTOP


def test_the_slider_moves_by_keyboard_pointer_and_finger(browser, pages):
    browser.open(pages[0], width=DESKTOP)
    cut = "document.querySelector('.stage img:nth-of-type(2)').style.clipPath"
    assert "50%" in browser.ask(cut)
    browser.ask("document.querySelector('.viewer input').focus()")
    for _ in range(5):
        browser.key("ArrowRight", 39)
    assert browser.ask("document.querySelector('.viewer input').value") == "55"
    assert "45%" in browser.ask(cut)
    where = (
        "(b => [b.left + b.width / 4, b.top + b.height / 2])(document.querySelector('.stage').getBoundingClientRect())"
    )
    browser.ask("document.querySelector('.stage').scrollIntoView({block: 'center', behavior: 'instant'})")
    x, y = browser.ask(where)
    for kind in ("mousePressed", "mouseReleased"):
        browser.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
    assert "75%" in browser.ask(cut)
    browser.open(pages[0], width=PHONE)
    browser.ask("document.querySelector('.stage').scrollIntoView({block: 'center', behavior: 'instant'})")
    x, y = browser.ask(where)
    for kind, points in (("touchStart", [{"x": x + 50, "y": y}]), ("touchMove", [{"x": x, "y": y}]), ("touchEnd", [])):
        browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    assert "75%" in browser.ask(cut)


def test_other_views_and_runs_can_be_chosen(browser, pages):
    browser.open(pages[1], width=DESKTOP)
    choose = """((n, text) => { const s = document.querySelectorAll('.viewer')[0].querySelectorAll('select')[n];
      s.value = [...s.options].findIndex(o => o.textContent === text); s.dispatchEvent(new Event('change')); })"""
    shown = "[...document.querySelector('.stage').querySelectorAll('img')].map(i => i.alt)"
    assert browser.ask(shown)[1].startswith("Photograph of view v0.png")
    browser.ask(f"{choose}(2, 'toy r4')")
    browser.ask(f"{choose}(0, 'v3.png')")
    under, over = browser.ask(shown)
    assert over == "Photograph of view v3.png"
    assert under.startswith("Render of view v3.png by toy r4")


def test_the_theme_can_be_turned_and_is_kept(browser, pages):
    browser.open(pages[0], width=DESKTOP, scheme="light")
    before = browser.ask("getComputedStyle(document.body).backgroundColor")
    browser.ask("document.getElementById('theme').click()")
    after = browser.ask("getComputedStyle(document.body).backgroundColor")
    assert before != after
    assert browser.ask("document.getElementById('theme').textContent") == "Light theme"
    browser.open(pages[0], width=DESKTOP, scheme="light")
    assert browser.ask("getComputedStyle(document.body).backgroundColor") == after
    browser.ask("localStorage.clear()")


def test_without_scripts_all_but_slider_and_toggle_is_there(browser, pages, tmp_path):
    browser.send("Emulation.setScriptExecutionDisabled", value=True)
    try:
        browser.open(pages[0], width=DESKTOP)
        browser.picture(tmp_path / "no-script.png")
        browser.send("DOM.enable")
        root = browser.send("DOM.getDocument")["root"]["nodeId"]

        def count(selector):
            return len(browser.send("DOM.querySelectorAll", nodeId=root, selector=selector)["nodeIds"])

        assert count(".viewer") == 0
        assert count(".gallery img") >= 12
        assert count("#theme[hidden]") == 1
        assert count("svg.chart") >= 4
    finally:
        browser.send("Emulation.setScriptExecutionDisabled", value=False)


def test_it_prints_in_light_and_with_everything_unfolded(browser, pages, tmp_path):
    browser.open(pages[0], width=DESKTOP, scheme="dark")
    browser.print(tmp_path / "one.pdf")
    assert (tmp_path / "one.pdf").read_bytes().startswith(b"%PDF-")
    assert browser.ask("[...document.querySelectorAll('details')].every(d => d.open)")
    browser.send("Emulation.setEmulatedMedia", media="print",
                 features=[{"name": "prefers-color-scheme", "value": "dark"}])  # fmt: skip
    assert browser.ask("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
    assert browser.ask("document.querySelector('.viewer').checkVisibility()") is False
    assert browser.ask("document.querySelector('nav').checkVisibility()") is False
