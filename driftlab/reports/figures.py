"""A chart by matplotlib: for a notebook, a file, or a paper."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

from driftlab.reports.charts import LOOKS, Chart, Line, Panel
from fusion_core.escaping import line as on_one_line

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIMITS = (-4, 5)  # powers of ten beyond which an axis gets its factor written above: wide numbers push the label out
DASHES = {"line": "-", "dashed": "--", "dotted": ":", "points": ""}


def figure_of(chart: Chart) -> Figure:
    """Draw the panels of a chart below one another, with one legend above."""
    from matplotlib.figure import Figure

    heights = [panel.height for panel in chart.panels]
    figure = Figure(figsize=(10, 2.1 * sum(heights) + 0.9))
    width, height = figure.get_size_inches()
    layout: dict[str, Any] = {  # fixed, in inches: one fitted to the labels draws everything once more, 0.3 s a figure
        "left": 0.8 / width, "right": 1 - 0.1 / width, "bottom": 0.5 / height, "top": 1 - 0.6 / height,
        "hspace": 0.08, "height_ratios": heights,
    }  # fmt: skip
    grid = figure.subplots(len(heights), 1, sharex=True, squeeze=False, gridspec_kw=layout)
    panels: list[Axes] = list(grid[:, 0])
    for axes, panel in zip(panels, chart.panels, strict=True):
        _draw(axes, panel, chart.log)
    panels[-1].set_xlabel(plain_label(chart.label))
    handles: dict[str, Any] = {}
    for axes in panels:
        for handle, text in zip(*axes.get_legend_handles_labels(), strict=True):
            handles.setdefault(text, handle)
    if handles:
        panels[0].legend(
            list(handles.values()), list(handles), loc="lower left", bbox_to_anchor=(0, 1.0), ncols=5, fontsize=8,
            frameon=False,
        )  # fmt: skip
    return figure


def _draw(axes: Axes, panel: Panel, log: bool) -> None:
    if log:
        axes.set_xscale("log")
    if panel.log:
        axes.set_yscale("log")
    else:
        axes.ticklabel_format(axis="y", scilimits=LIMITS)
    for shade in panel.shades:
        axes.axvspan(
            shade.start, shade.stop, color=LOOKS[shade.role].light, alpha=0.16, lw=0, label=plain_label(shade.text)
        )
    for line in panel.lines:
        _line(axes, line)
    for rule in panel.rules:
        look: dict[str, Any] = {"color": LOOKS[rule.role].light}
        axes.axhline(rule.y, lw=1, ls="--", **look)
        axes.annotate(
            plain_label(rule.text), (1, rule.y), xycoords=("axes fraction", "data"), textcoords="offset points",
            xytext=(-3, 2), ha="right", fontsize=8, **look,
        )  # fmt: skip
    if panel.span is not None:
        axes.set_ylim(*panel.span)
    axes.set_ylabel(plain_label(panel.label), fontsize=9)
    axes.grid(alpha=0.25)


def _line(axes: Axes, line: Line) -> None:
    look, name = LOOKS[line.role], plain_label(line.name)
    if line.low is not None and line.high is not None:
        label = name if line.y is None else None
        axes.fill_between(line.x, line.low, line.high, color=look.light, alpha=0.18, lw=0, label=label)
    if line.y is not None:
        points: dict[str, Any] = {"marker": ".", "ms": 3} if line.style == "points" else {}
        axes.plot(line.x, line.y, color=look.light, lw=look.width, label=name, ls=DASHES[line.style], **points)


def svg(figure: Figure) -> str:
    """Return a figure as SVG text, the same for the same data."""
    import matplotlib as mpl

    buffer = io.StringIO()
    with mpl.rc_context({"svg.hashsalt": "driftlab", "svg.fonttype": "none"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": "driftlab"})
    return buffer.getvalue()[buffer.getvalue().index("<svg") :]


def plain_label(name: str) -> str:
    """Return a name for a legend: matplotlib takes what is between two $ for a formula, SVG no control characters."""
    return on_one_line(name).replace("$", r"\$")
