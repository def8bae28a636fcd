"""Tables: of texts, heads and rows once for a terminal and a page; and of errors, for a terminal.

`pages/tables.html` prints them on a page.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np

from driftlab.evaluation.scores import LONGEST_FIRST, Scores
from driftlab.evaluation.summary import Rows, coasts_over_axes, error_rows
from driftlab.units import BiasUnit, formatted, unit_of
from fusion_core.contracts import Sensor

if TYPE_CHECKING:
    from rich.table import Table

FEW, WIDE, NARROW = 3, 12, 9  # runs in a table, and characters that a name has in one line: beside few, beside many


@dataclass(frozen=True)
class TextTable:
    """A table of texts.

    Attributes
    ----------
    heads : sequence of str
        Of the columns; the unit may stand on a line of its own.
    rows : sequence of sequences of str
    title : str
        On a terminal; a page has a heading.
    texts : int
        How many of the first columns are of texts, at the left; numbers are at the right.
    rigid, whole : bool
        Whether texts, and numbers, are never folded.
    framed : bool
        Whether columns are divided by lines.
    width : int, optional
        Of the first column at least, which is then folded last.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    texts: int = 1
    rigid: bool = False
    whole: bool = True
    framed: bool = True
    width: int | None = None

    def __rich__(self) -> Table:
        """Return the table for a terminal."""
        from rich import box
        from rich.table import Table
        from rich.text import Text

        table = Table(title=self.title, title_justify="left", box=box.HEAVY_HEAD if self.framed else box.SIMPLE_HEAD)
        for k, head in enumerate(self.heads):
            text = k < self.texts
            whole, least = (self.rigid, self.width) if text else (self.whole, None)
            table.add_column(Text(head), justify="left" if text else "right", no_wrap=whole, min_width=least)
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table


def error_table(
    title: str, names: Sequence[str], unit: BiasUnit, *sections: tuple[Sequence[str], Rows], si: bool = False
) -> Table:
    """Return a table of errors in sections, each of axes and rows: a label, and for each name the errors (d,), in SI.

    A number is never cut; a name is folded at what separates its words. With `si` in SI, where that is another unit
    than the one that is shown.
    """
    from rich.table import Table
    from rich.text import Text

    shown, factor, spec = unit.columns[-1 if si else 0]
    table = Table(title=title, title_justify="left")
    table.add_column("error", no_wrap=True, vertical="bottom")
    table.add_column("axis", justify="center", min_width=4, vertical="bottom")
    cells = [
        [[formatted(values[k] * factor, spec, "-") for values in columns] for k in range(len(axes))]
        for axes, rows in sections
        for _, columns in rows
    ]
    for k, name in enumerate(names):
        widest = max([8, *(len(line[k]) for row in cells for line in row)])
        width = max(widest, NARROW if len(names) > FEW else WIDE)
        heading = "\n".join([*folded(name, width), f"[{shown}]"])
        table.add_column(Text(heading), justify="right", no_wrap=True, vertical="bottom")
    for axes, rows in sections:
        for (label, _), (after, _) in zip_longest(rows, rows[1:], fillvalue=("", [])):
            lines = cells.pop(0)
            alike = len(axes) > 1 and all(line == lines[0] for line in lines)  # printed once
            for k, line in enumerate(lines[:1] if alike else lines):
                table.add_row(label if k == 0 else "", "each" if alike else axes[k], *line)
            # what belongs to a row stays with it, and rows of one line each stay together
            if not after or (len(axes) > 1 and not after.startswith(" ")):
                table.add_section()
    return table


def folded(name: str, width: int) -> list[str]:
    """Return a name in lines of at most `width`, broken after what separates its words where that is possible."""
    lines = [""]
    for piece in re.findall(r"[^\s_./-]*[\s_./-]?", name):
        if lines[-1] and len(lines[-1]) + len(piece) > width:
            lines.append("")
        whole = lines.pop() + piece
        lines += [whole[k : k + width] for k in range(0, len(whole), width)] or [""]
    return lines


def yardstick_table(runs: dict[str, Scores], title: str, sensor: Sensor) -> Table:
    """Return the table of several runs of a sensor side by side, the longest prediction first.

    Of several runs and axes the rms over the axes comes before all, of a gyro the heading errors last.
    """
    scores = list(runs.values())
    rows = error_rows(scores)
    sections: list[tuple[Sequence[str], Rows]] = [(sensor.axes, rows)]
    if len(runs) > 1 and len(sensor.axes) > 1:
        sections = [(("rms",), coasts_over_axes(rows)), *sections]
    table = error_table(title, list(runs), unit_of(sensor), *sections)
    if sensor.integral is not None:
        for name in LONGEST_FIRST:
            headings = [formatted(np.rad2deg(run.heading[name]), ".2f", "-") for run in scores]
            table.add_row(f"heading, {name}", "[deg]", *headings)
    return table
