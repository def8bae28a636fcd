"""The reports as pages: one HTML file each that opens without a network, from templates with one look.

Figures are drawn by uPlot (https://github.com/leeoniya/uPlot, MIT), which each page holds.
"""

from __future__ import annotations

import re
import sys
from contextlib import suppress
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup, escape

from driftlab import __version__
from driftlab.reports.charts import LOOKS, Chart, content
from fusion_core.escaping import css_text, line, lines, script_json

if TYPE_CHECKING:
    from jinja2 import Environment, bccache


def write_page(path: Path, template: str, **values: Any) -> None:
    """Fill a template of this package (`report`, `compare`, `allan`) with values, and write the page."""
    path.write_text(page(template, **values), encoding="utf-8")


def page(template: str, **values: Any) -> str:
    """Return a template of this package, filled; a value that is a Chart is printed with `{{ interactive(chart) }}`."""
    return environment().get_template(f"{template}.html").render(version=__version__, **values)


@cache
def environment() -> Environment:
    """Return the templates; what they are compiled to is kept beside Python's own bytecode, where that is kept.

    One that is kept has the results of our filters on its constants in it, so each version has its own.
    """
    import jinja2

    class Kept(jinja2.FileSystemBytecodeCache):
        def dump_bytecode(self, bucket: bccache.Bucket) -> None:
            with suppress(OSError):
                super().dump_bytecode(bucket)

    loader = jinja2.PackageLoader("driftlab.reports", "pages")
    # texts with the codes of characters that are invisible, or that turn what is beside them
    escaped = lambda value: lines(value) if type(value) is str else value  # noqa: E731
    beside = str(Path(__file__).parent / "__pycache__")
    kept = None if sys.dont_write_bytecode else Kept(beside, f"__jinja2_{__version__}_%s.cache")
    environment = jinja2.Environment(loader=loader, autoescape=True, finalize=escaped, bytecode_cache=kept)
    environment.globals |= {"asset": _asset, "interactive": interactive, "looks": embedded(looks()), "quoted": quoted}
    environment.filters["prose"] = prose
    return environment


def looks() -> dict[str, dict[str, str | float]]:
    """Return the look of each role, for `charts.js`."""
    return {role: vars(look) for role, look in LOOKS.items()}


def interactive(chart: Chart) -> Markup:
    """Return the figure of a chart as a page holds it; `charts.js` draws it."""
    caption = Markup("<figcaption>{}</figcaption>").format(prose(lines(chart.caption))) if chart.caption else ""
    return Markup(
        '<figure class="chart" aria-label="{title}"><div class="tools"><span class="keys"></span>'
        '<button class="reset" type="button" title="also: double click">whole range</button></div>'
        '<div class="panels"></div><div class="x-label">{label}</div><div class="read">&nbsp;</div>{caption}'
        '<script type="application/json">{content}</script></figure>'
    ).format(
        title=line(chart.title or chart.label),
        label=line(chart.label),
        caption=caption,
        content=embedded(content(chart)),
    )


def prose(text: str) -> Markup:
    """Return a sentence as a page shows it: commands and keys, which stand in backticks, as code."""
    return Markup(re.sub("`([^`]+)`", r"<code>\1</code>", str(escape(text))))


def embedded(value: Any) -> Markup:
    """Return JSON that a page may hold in a script: no text in it can end the script."""
    return Markup(script_json(value))


def quoted(text: str) -> Markup:
    """Return text as a string of CSS that a page may hold: letters, digits and spaces, and the code of all else."""
    return Markup(css_text(text))


def drawing(svg: str) -> Markup:
    """Return SVG text that a page may hold as it is."""
    return Markup(svg)


def _asset(name: str) -> Markup:
    return Markup(files("driftlab.reports.pages").joinpath(name).read_text(encoding="utf-8"))
