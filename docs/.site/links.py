"""Links of the docs to files beside them (examples, sources): the site has no such pages, and names them instead."""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parent.parent
LINK = re.compile(r"(?<!!)\[([^]]*)\]\((\.\./[^)#\s]*)\)")


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return a page with the path in place of each link that leads out of the docs."""

    def named(found: re.Match[str]) -> str:
        target = (DOCS / page.file.src_path).parent.joinpath(found[2]).resolve()
        if target.is_relative_to(DOCS):
            return found[0]
        path = target.relative_to(DOCS.parent)
        if not target.exists():
            logging.getLogger("mkdocs").warning("%s: names %s, which is not there", page.file.src_path, path)
        text = found[1].strip("`")
        return f"`{path}`" if text in (str(path), path.name) else f"{found[1]} (`{path}`)"

    return LINK.sub(named, markdown)
