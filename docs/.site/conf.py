"""Settings of the documentation's site for Sphinx: `make docs` fails where a link, an anchor or an image is missing."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from docutils.nodes import SkipNode
from latex2mathml.converter import convert
from sphinx.util.logging import getLogger

LOG = getLogger(__name__)
DOCS = Path(__file__).parent.parent
LINK = re.compile(r"(?<!!)\[([^]]*)\]\((\.\./[^)#\s]*)\)")
MODULE = re.compile(r"^::: (\S+)$", re.MULTILINE)
PAGES = {  # the side bar under a page, part by part: first pages in this order, then all others
    "README": {
        "Start": "gallery tutorial/first_run",
        "How to": "how-to/read_your_files how-to/read_a_serial_device how-to/fit_a_thermal_map how-to/plan_a_soak "
        "how-to/sign_a_calibration how-to/close_the_loop how-to/*",
        "Reference": "reference/config reference/command_line reference/output_files reference/* "
        "reference/plugins/README reference/api/*",
        "Explanation": "explanation/theory explanation/*",
        "Decisions": "adr/README",
    },
    "reference/plugins/README": {"Families": "*"},
    "adr/README": {"All": "0*"},
}

project = html_title = "driftlab"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_copybutton"]
root_doc = "README"
exclude_patterns = [".site", "reference/*.py", "reference/*.csv"]
default_role = "code"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
autodoc_default_options = {"members": True, "member-order": "bysource", "exclude-members": "model_config"}
autodoc_preserve_defaults = True
napoleon_use_ivar = True  # a field that is documented in two places is one
suppress_warnings = ["ref.python"]  # of types in docstrings: several classes have an attribute called `n`

html_theme = "furo"
html_additional_pages = {"index": "to_start.html"}  # opens gallery.html
templates_path = ["."]
html_math_renderer = "mathml"
html_copy_source = False


def setup(app: Any) -> None:
    """Have pages and docstrings prepared before they are parsed, and formulas written as MathML: nothing is fetched."""
    app.connect("source-read", prepare)
    app.connect("autodoc-process-docstring", keep_tables)
    app.add_html_math_renderer("mathml", (formula, None), (formula, None))


def prepare(_: Any, name: str, source: list[str]) -> None:
    """Name files outside the docs by their paths, let Sphinx import what `::: MODULE` documents, add the side bar."""
    source[0] = LINK.sub(lambda found: named(found, name), source[0])
    source[0] = MODULE.sub(r"## \1\n\n```{eval-rst}\n.. automodule:: \1\n```", source[0])
    for part, pages in PAGES.get(name, {}).items():
        listed = "\n".join(pages.split())
        source[0] += f"\n```{{toctree}}\n:hidden:\n:glob:\n:caption: {part}\n\n{listed}\n```\n"


def named(found: re.Match[str], name: str) -> str:
    """Return the path in place of a link that leads out of the docs: the site has no such page."""
    target = (DOCS / name).parent.joinpath(found[2]).resolve()
    if target.is_relative_to(DOCS):
        return found[0]
    path, text = target.relative_to(DOCS.parent), found[1].strip("`")
    if not target.exists():
        LOG.warning("%s: names %s, which is not there", name, path)
    return f"`{path}`" if text in (str(path), path.name) else f"{found[1]} (`{path}`)"


def keep_tables(_app: Any, _what: str, _name: str, _object: Any, _options: Any, lines: list[str]) -> None:
    """Show tables that the command line shows as they stand, and leave out what a named tuple says of its fields."""
    if lines and lines[0].startswith("Alias for field number"):
        lines.clear()
    while "\b" in lines:
        start = lines.index("\b")
        stop = lines.index("", start)
        lines[start:stop] = ["::", "", *(f"    {line}" for line in lines[start + 1 : stop])]


def formula(translator: Any, node: Any) -> None:
    """Write a formula as MathML, which browsers draw by themselves."""
    block = node.tagname == "math_block"
    text = re.sub(r"\\tag\{(\w+)\}", r"\\qquad (\1)", node.astext())
    translator.body.append(convert(text, display="block" if block else "inline"))
    raise SkipNode
