"""Tables of texts: heads and rows once, printed on a terminal by rich and on a page by `pages/tables.html`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rich.table import Table


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
    texts : bool
        Whether the first column is one of texts, at the left; numbers are at the right.
    """

    heads: Sequence[str]
    rows: Sequence[Sequence[str]]
    title: str = ""
    texts: bool = True

    def rich(self, *, whole: bool = True, framed: bool = True, width: int | None = None) -> Table:
        """Return the table for a terminal.

        Parameters
        ----------
        whole : bool
            Whether numbers are never folded.
        framed : bool
            Whether columns are divided by lines.
        width : int, optional
            Of the first column at least, which is then folded last.
        """
        from rich import box
        from rich.table import Table
        from rich.text import Text

        table = Table(title=self.title, title_justify="left", box=box.HEAVY_HEAD if framed else box.SIMPLE_HEAD)
        for k, head in enumerate(self.heads):
            first = k == 0 and self.texts
            least = width if first else None
            table.add_column(
                Text(head), justify="left" if first else "right", no_wrap=whole and not first, min_width=least
            )
        for row in self.rows:
            table.add_row(*map(Text, row))
        return table
