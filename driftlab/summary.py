"""The summary of a run: for programs as JSON, for people as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.yardsticks import HORIZONS, Yardsticks

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.overview import Overview
    from driftlab.tracker import Journal
    from driftlab.zupt import Zupt
    from fusion_core.chunk import Array

SHORT = min(HORIZONS.values())  # s after the alignment: with less there is no yardstick
DEG_H = np.rad2deg(1.0) * 3600  # deg/h in one rad/s


def summarise(found: Overview, model: Zupt, journal: Journal) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    first = journal.alignments[0]
    yardsticks, nis = found.yardsticks, found.nis
    return {
        "t": {"start_s": found.start, "aligned_s": first.t, "end_s": found.end},
        "updates": {"count": found.count, "interval_s": first.dt, "used": found.used},
        "axes": {triad.channel: list(triad.model.axes) for triad in model.triads},
        "states": dict(zip(model.labels, model.units, strict=True)),
        "bias_rad_s": {"end": found.bias, "sigma": found.sigma},
        "filter_rmse_rad_s": {"first 30 s": yardsticks.filter_first, "whole": yardsticks.filter_whole},
        "coast_rmse_rad_s": yardsticks.coast,
        "coast_heading_error_rad": yardsticks.heading,
        "nis": {"mean_per_component": nis.mean, "low": nis.low, "high": nis.high, "consistent": nis.consistent},
        "whiteness_p": found.whiteness_p,
        "noise_ratio": first.noise_ratio,
        "aligned_again_s": [a.t for a in journal.alignments[1:]],
        "motion_s": journal.moving,
        "faults": {what: {"count": f.count, "first": f.first} for what, f in journal.faults.found.items()},
    }


def remarks(summary: dict[str, Any]) -> list[str]:
    """Return what a user should know of a run, one sentence each."""
    lines = [f"{what}: {fault['count']} (first {fault['first']})" for what, fault in summary["faults"].items()]
    moving = summary["motion_s"]
    if moving:
        total = sum(stop - start for start, stop in moving) + len(moving) * summary["updates"]["interval_s"]
        count = "1 stretch" if len(moving) == 1 else f"{len(moving)} stretches"
        lines.append(f"motion: {total:.1f} s in {count} not used (first at t = {moving[0][0]:.1f} s)")
    again = summary["aligned_again_s"]
    if again:
        times = f"at t = {again[0]:.1f} s" if len(again) == 1 else f"{len(again)} times, first at t = {again[0]:.1f} s"
        lines.append(f"aligned again {times}: still, but at another attitude or bias than before")
    t, updates = summary["t"], summary["updates"]
    if updates["used"] == 0:
        lines.append("no update was used: nothing is known of the bias; check the channels' units and paths, and noise")
    elif t["end_s"] - t["aligned_s"] < SHORT:
        lines.append(
            f"only {t['end_s'] - t['aligned_s']:.1f} s after the alignment: too short to judge by; "
            f"record {SHORT:.0f} s or more at rest after it"
        )
    for name, ratios in summary["noise_ratio"].items():
        off = [f"{axis} {r:.2g}" for axis, r in zip(summary["axes"][name], ratios, strict=True) if not 0.5 <= r <= 2]
        if off:
            far = any(not 0.2 <= r <= 5 for r in ratios)
            lines.append(
                f"{name}: white noise is not as declared (measured / declared: {', '.join(off)}); "
                f"set filter.{name}.noise{f', or correct unit and path of source.channels.{name}' if far else ''}"
            )
    return lines


def error_table(
    title: str, names: Sequence[str], rows: Sequence[tuple[str, list[Array]]], axes: Sequence[str]
) -> Table:
    """Return a table of errors in rad/s, also in deg/h: a label, and for each name the errors (d,) of one row."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left")
    table.add_column("error", no_wrap=True)
    table.add_column("axis", justify="center", min_width=4)
    for name in names:
        table.add_column(Text(f"{name}\n[deg/h]"), justify="right", min_width=8)
        table.add_column(Text(f"{name}\n[rad/s]"), justify="right", min_width=9)
    for label, columns in rows:
        for k, axis in enumerate(axes):
            cells = [text for v in columns for text in (_cell(v[k] * DEG_H, ".2f"), _cell(v[k], ".3e"))]
            table.add_row(label if k == 0 else "", axis, *cells, end_section=k == len(columns[0]) - 1)
    return table


def yardstick_table(runs: dict[str, Yardsticks], title: str) -> Table:
    """Return the table of several runs side by side, in deg/h and rad/s, with the heading errors below."""
    axes = next(iter(runs.values())).axes
    table = error_table(title, list(runs), error_rows(list(runs.values())), axes)
    for name in HORIZONS:
        cells = [text for y in runs.values() for text in (_cell(np.rad2deg(y.heading[name]), ".2f"), "")]
        table.add_row(f"heading, {name} (deg)", "up", *cells)
    return table


def error_rows(runs: list[Yardsticks]) -> list[tuple[str, list[Array]]]:
    """Return the rows of the table of errors: a label, and for each run the errors (d,) in rad/s."""
    rows = [("bias, first 30 s", [y.filter_first for y in runs]), ("bias, all", [y.filter_whole for y in runs])]
    return rows + [(f"coast, {name}", [y.coast[name] for y in runs]) for name in HORIZONS]


def _cell(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "-"
