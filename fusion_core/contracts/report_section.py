"""The contract of report sections: what a third party adds to the page of a run."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fusion_core.chunk import Array
from fusion_core.contracts.plugin import Plugin


@dataclass(frozen=True)
class Section:
    """One section of a page.

    Attributes
    ----------
    title : str
    text : str
        Plain text; an empty line begins a paragraph.
    html : str
        What follows the text, as it is.
    svg : str
        A figure, `<svg ...>...</svg>`.
    """

    title: str
    text: str = ""
    html: str = ""
    svg: str = ""


class ReportSection(Plugin):
    """A section of the report of every run; it has no settings that a user must give."""

    @abstractmethod
    def section(self, summary: Mapping[str, Any], curves: Mapping[str, Array]) -> Section | None:
        """Return the section, from the content of `summary.json` and thinned estimates; None where there is none.

        The curves have N rows each, named as in `estimates.h5`: t (N,) in s, bias (N, d), ...
        """
