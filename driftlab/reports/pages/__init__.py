"""The reports as pages: one HTML file each that opens without a network, from templates with one look."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from driftlab import __version__


def write_page(path: Path, template: str, **values: Any) -> None:
    """Fill a template of this package (`report`, `compare`, `allan`) with values, and write the page."""
    import jinja2

    environment = jinja2.Environment(loader=jinja2.PackageLoader("driftlab.reports", "pages"), autoescape=True)
    html = environment.get_template(f"{template}.html").render(version=__version__, **values)
    path.write_text(html, encoding="utf-8")


def drawing(svg: str) -> Any:
    """Return SVG text that a page may hold as it is."""
    from markupsafe import Markup

    return Markup(svg)
