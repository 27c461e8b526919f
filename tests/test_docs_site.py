"""The pages as a site: links out of docs/ become text, and mkdocs builds it strictly where it is installed."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from import_graph import ROOT

DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def without_links_out():
    spec = importlib.util.spec_from_file_location("site_links", ROOT / "tools" / "site_links.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.without_links_out


@pytest.mark.parametrize(
    ("page", "text", "wanted"),
    [
        ("guide.md", "see [runs](runs.md#one-writer)", None),
        ("methods/hac.md", "see [runs](../runs.md)", None),
        ("guide.md", "[below](#here), [there](https://example.org/x)", None),
        ("guide.md", "![curves](images/report.png)", None),
        ("guide.md", "the [README](../plugins/sw-view/README.md) of it", "the README of it"),
        ("guide.md", "in [methods](methods)", "in methods"),
        ("guide.md", "[gone](gone.md)", "gone"),
    ],
)
def test_a_link_out_of_the_site_becomes_its_text(without_links_out, page, text, wanted):
    assert without_links_out(text, page, DOCS) == (wanted or text)


def test_pages_link_no_page_that_is_not_there():
    """What the site turns into text leads somewhere in the repository."""
    dead = []
    for page in (*DOCS.glob("*.md"), *DOCS.glob("methods/*.md")):
        text = re.sub(r"^```.*?^```|`[^`\n]*`", "", page.read_text("utf-8"), flags=re.M | re.S)
        for target in re.findall(r"\]\(([^()\s#]+)(?:#[^()\s]*)?\)", text):
            if not re.match(r"[a-z]+:", target) and not (page.parent / target).exists():
                dead.append(f"{page.relative_to(ROOT)}: {target}")
    assert dead == []


def test_the_first_page_leads_to_pages_that_are_there():
    told = set(re.findall(r"\]\((\w+\.(?:md|ipynb))\)", (DOCS / "index.md").read_text("utf-8")))
    assert {"guide.md", "cli.md", "api.md", "plugins.md", "tutorial.md"} <= told
    assert all((DOCS / name).is_file() for name in told)


def test_mkdocs_builds_the_site_strictly(tmp_path: Path):
    pytest.importorskip("mkdocs")
    pytest.importorskip("material")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    page = (tmp_path / "guide.html").read_text("utf-8")
    assert "first_steps.ipynb" in page
    assert "../plugins/" not in page
