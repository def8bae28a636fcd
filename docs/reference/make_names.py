"""Write the table of modules in names.md from the first line of each module's docstring.

`python docs/reference/make_names.py` rewrites it; `lines()` is what tests compare it with.
"""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).with_name("names.md")
HEAD = "## Modules\n"


def lines() -> str:
    """Return the section of names.md that lists every module, a table a room."""
    text = [HEAD, "Each module and its subject, by `python docs/reference/make_names.py`."]
    for top in ("fusion_core", "plugins", "driftlab"):
        for folder in sorted({path.parent for path in (ROOT / top).rglob("*.py")}):
            rows = [_row(path) for path in sorted(folder.glob("*.py")) if path.stem not in ("__init__", "__main__")]
            if rows:
                text += [f"\n### {folder.relative_to(ROOT)}\n", "| module | subject |", "|---|---|", *rows]
    return "\n".join(text) + "\n"


def _row(path: Path) -> str:
    first = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").split("\n\n")[0].split("\n")
    return f"| `{path.stem}` | {' '.join(first).replace('|', '/')} |"


if __name__ == "__main__":
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.partition(HEAD)[0].rstrip() + "\n\n" + lines(), encoding="utf-8")
