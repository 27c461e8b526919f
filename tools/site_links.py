"""Hook of mkdocs: links out of docs/, to packages and folders, become their text: the site has the pages alone."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

LINK = re.compile(r"(?<!!)\[([^\[\]]+)\]\(([^()\s]+)\)")


def on_page_markdown(markdown: str, *, page: Any, config: Any, **_: Any) -> str:
    """Called by mkdocs with the text of each page."""
    return without_links_out(markdown, page.file.src_uri, Path(config.docs_dir))


def without_links_out(markdown: str, page: str, docs: Path) -> str:
    """Replace links that lead to no file of the site by their text.

    page    path of the page below `docs`
    """

    def kept(link: re.Match[str]) -> str:
        target = link[2].partition("#")[0]
        if not target or re.match(r"[a-z]+:", target):
            return link[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        return link[0] if not path.startswith("..") and (docs / path).is_file() else link[1]

    return LINK.sub(kept, markdown)
