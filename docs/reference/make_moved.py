"""Write moved.md, for authors of plugins, from the table moved.csv.

`python docs/reference/make_moved.py` rewrites it; `text()` is what tests compare it with.
"""

from __future__ import annotations

import csv
from pathlib import Path

HERE = Path(__file__).parent
HEAD = """# Moved names

Modules of `fusion_core` and members of its contracts were renamed once, before version 1.0. `fusion_core` and
`fusion_core.contracts` export the same names as before, so a plugin that imports from them needs no change but for the
members in the first rows. Written by `python docs/reference/make_moved.py` from `moved.csv`.

| was | is |
|---|---|
"""


def rows() -> list[list[str]]:
    """Return old place, old name, new place and new name of each."""
    with (HERE / "moved.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.reader(file))[1:]


def text() -> str:
    """Return the page."""
    return HEAD + "".join(f"| `{old}.{name}` | `{new}.{new_name}` |\n" for old, name, new, new_name in rows())


if __name__ == "__main__":
    (HERE / "moved.md").write_text(text(), encoding="utf-8")
