"""The summary of a run: for programs as JSON, for people as tables."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import zip_longest
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.evaluation.scores import HORIZONS, LONGEST_FIRST, Scores, over_axes
from driftlab.units import BiasUnit, axis_name, unit_of
from fusion_core.errors import moment
from fusion_core.faults import Fault

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.evaluation.overview import Overview
    from driftlab.filtering.segment import RunLog
    from fusion_core.chunk import Array
    from fusion_core.contracts import MeasurementModel, Sensor

SHORT = min(HORIZONS.values())  # s after the alignment: with less there is no yardstick
ENOUGH = 0.9  # of the time: a score that stands on less says why
NOTICED = 0.05  # of the nis: by less than that it is outside its bounds only because a long run has narrow ones
FEW, WIDE, NARROW = 3, 12, 9  # runs in a table, and characters that a name has in one line: beside few, beside many
Rows = Sequence[tuple[str, list["Array"]]]  # of a table: a label, and for each run the errors (d,) in SI


def summarise(found: Overview, model: MeasurementModel, journal: RunLog) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    first = journal.alignments[0]
    yardsticks, nis, unit = found.yardsticks, found.nis, unit_of(model.tracked)
    heading = {"coast_heading_error_rad": yardsticks.heading} if model.tracked.integral else {}
    return {
        "t": {
            "first_row_s": journal.faults.first_row,
            "start_s": found.start,
            "aligned_s": first.t,
            "end_s": found.end,
        },
        "updates": {"count": found.count, "interval_s": first.dt, "used": found.used},
        "axes": {sensor.channel: list(sensor.axes) for sensor in model.sensors},
        "states": dict(zip(model.space.labels, model.space.units, strict=True)),
        **unit.note,
        unit.key("bias"): {"end": found.bias, "sigma": found.sigma},
        unit.key("filter_rmse"): {"first 30 s": yardsticks.filter_first, "whole": yardsticks.filter_whole},
        unit.key("coast_rmse"): yardsticks.coast,
        unit.key("coast_sigma"): yardsticks.coast_sigma,
        **heading,
        "share": {**yardsticks.share, "moved": yardsticks.moved},
        "nis": {"mean_per_component": nis.mean, "low": nis.low, "high": nis.high, "consistent": nis.consistent},
        "whiteness_p": found.whiteness_p,
        "noise_ratio": first.noise_ratio,
        "aligned_again_s": [a.t for a in journal.alignments[1:]],
        "motion_s": journal.moving.spans,
        "motion_axes": journal.moving.worst(),
        "refused_s": journal.refused.spans,
        "refused_axes": journal.refused.worst(),
        "temperature_swing_K": found.swing,
        "faults": {what: {"count": f.count, "first": f.first} for what, f in journal.faults.found.items()},
    }


def remarks(summary: dict[str, Any], model: MeasurementModel) -> list[str]:
    """Return what a user should know of a run of a model, one sentence each."""
    lines = [Fault(**fault).line(what) for what, fault in summary["faults"].items()]
    lines += _standing(summary, model)
    again = summary["aligned_again_s"]
    if again:
        when = f"at {moment(again[0], summary['t']['first_row_s'])}"
        times = when if len(again) == 1 else f"{len(again)} times, first {when}"
        other = "attitude or bias" if model.tracked.integral else "bias"
        lines.append(f"aligned again {times}: still, but at another {other} than before")
    t, updates = summary["t"], summary["updates"]
    if updates["used"] == 0:
        lines.append("no update was used: nothing is known of the bias; check the channels' units and paths, and noise")
    elif t["end_s"] - t["aligned_s"] < SHORT:
        lines.append(
            f"only {t['end_s'] - t['aligned_s']:.1f} s after the alignment: too short to judge by; "
            f"record {SHORT:.0f} s or more at rest after it"
        )
    return [*lines, *_inconsistent(summary), *_noises(summary, model)]


def _inconsistent(summary: dict[str, Any]) -> list[str]:
    """Return what is to be said of a nis that is outside its bounds."""
    nis = summary["nis"]
    mean = nis["mean_per_component"]
    if nis["consistent"] or not abs(mean - 1) >= NOTICED:
        return []
    return [f"NIS {mean:.3g} a component, {nis['low']:.3g} to {nis['high']:.3g} was expected: {too_much(mean)}"]


def too_much(mean: float) -> str:
    """Return what a mean NIS a component that is outside its bounds says of the deviations."""
    off = 100 * abs(np.sqrt(mean) - 1)
    if mean > 1:
        return f"innovations are {off:.2g} % larger than the model says, so its deviations are too small"
    return f"innovations are {off:.2g} % smaller than the model says, so its deviations are too large"


def _noises(summary: dict[str, Any], model: MeasurementModel) -> list[str]:
    """Return which sensors are noisier or quieter than declared."""
    lines, sections = [], {sensor.channel: sensor.section for sensor in model.sensors}
    for name, ratios in summary["noise_ratio"].items():
        axes = summary["axes"][name]
        off = [f"{axis} {r:.2g}" for axis, r in zip(axes, ratios, strict=True) if not 0.5 <= r <= 2]
        off = [f"{r:.2g}" for r in ratios] if off and axis_name(name, axes[0]) == name else off
        if off:
            far = any(not 0.2 <= r <= 5 for r in ratios)
            lines.append(
                f"{name}: white noise is not as declared (measured / declared: {', '.join(off)}); "
                f"set {sections[name]}.noise{f', or correct unit and path of source.channels.{name}' if far else ''}"
            )
    return lines


def _standing(summary: dict[str, Any], model: MeasurementModel) -> list[str]:
    """Return what is to be said of motion, of what was refused at rest, and of the time that the scores stand on."""
    lines = []
    moving, refused = summary["motion_s"], _unexplained(summary)
    if moving:
        lines.append(f"motion, not used: {_stretches(moving, summary)}, seen by {', '.join(summary['motion_axes'])}")
    if refused:
        axes = summary["refused_axes"]
        still = "the unit stood still" if model.tracked.integral else "nothing moved"
        advice = "the model does not fit there: its map, walk or noise is wrong"
        if all(axis.startswith("accel") for axis in axes):
            swing = summary["temperature_swing_K"]
            warmed = f", while the temperature moved by {swing:.1f} K" if swing >= 1 else ""
            advice = (
                f"that looks like an accelerometer whose bias drifts{warmed}, and not like motion; "
                "raise filter.accel.bias.walk, or write `accel: null` under filter"
            )
        lines.append(
            f"refused although {still}: {_stretches(refused, summary)}, because of {', '.join(axes)}; "
            f"{advice}. The scores count it all the same"
        )
    lines += _unknown(summary, unit_of(model.tracked))
    share, moved = summary["share"]["whole"], summary["share"]["moved"]
    if share < ENOUGH and summary["t"]["end_s"] - summary["t"]["aligned_s"] >= SHORT:
        gaps = max(0.0, 1 - share - moved)
        why = [f"{100 * part:.0f} % {what}" for what, part in (("gaps", gaps), ("motion", moved)) if part >= 0.005]
        lines.append(
            f"the scores stand on {100 * share:.0f} % of the time after the alignment ({', '.join(why)}); "
            "in between the error is taken to go straight"
        )
    return lines


def _unknown(summary: dict[str, Any], unit: BiasUnit) -> list[str]:
    """Return which scores have no value although the recording is long enough for them, and why."""
    t, lengths = summary["t"], {"first 30 s": 30.0, "whole": SHORT, **HORIZONS, "to the end": SHORT}
    scores = {**summary[unit.key("filter_rmse")], **summary[unit.key("coast_rmse")]}
    missing = [
        f"{name} ({100 * summary['share'][name]:.0f} %)"
        for name, values in scores.items()
        if t["end_s"] - t["aligned_s"] >= lengths[name] and not np.all(np.isfinite(values))
    ]
    if not missing:
        return []
    return [f"no score for {', '.join(missing)}: of that time, the share in brackets was measured at rest, too little"]


def _unexplained(summary: dict[str, Any]) -> list[tuple[float, float]]:
    """Return what was refused at rest, but for what is between a motion and the alignment after it: it was turned."""
    again, interval = summary["aligned_again_s"], summary["updates"]["interval_s"]
    ends = [stop for _, stop in summary["motion_s"]]
    return [
        (start, stop)
        for start, stop in summary["refused_s"]
        if not (stop in again and any(0 < start - end < 1.5 * interval for end in ends))
    ]


def _stretches(spans: list[tuple[float, float]], summary: dict[str, Any]) -> str:
    interval = summary["updates"]["interval_s"]
    total = sum(stop - start for start, stop in spans) + len(spans) * interval
    count = "1 stretch" if len(spans) == 1 else f"{len(spans)} stretches"
    return f"{total:.1f} s in {count} (first at {moment(spans[0][0], summary['t']['first_row_s'])})"


def error_table(
    title: str,
    names: Sequence[str],
    rows: Rows,
    axes: Sequence[str],
    unit: BiasUnit,
    *,
    si: bool = False,
) -> Table:
    """Return a table of errors: a label, and for each name the errors (d,) of one row, given in SI.

    A number is never cut; a name is folded at what separates its words. With `si` in SI, where that is another unit
    than the one that is shown.
    """
    return _table(title, names, [(axes, rows)], unit, si=si)


def _table(
    title: str,
    names: Sequence[str],
    sections: Sequence[tuple[Sequence[str], Rows]],
    unit: BiasUnit,
    *,
    si: bool = False,
) -> Table:
    """Return the table of sections, each with the axes of its rows."""
    from rich.table import Table
    from rich.text import Text

    shown, factor, spec = unit.columns[-1 if si else 0]
    table = Table(title=title, title_justify="left")
    table.add_column("error", no_wrap=True, vertical="bottom")
    table.add_column("axis", justify="center", min_width=4, vertical="bottom")
    cells = [
        [[_cell(values[k] * factor, spec) for values in columns] for k in range(len(axes))]
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
            for k, line in enumerate(cells.pop(0)):
                table.add_row(label if k == 0 else "", axes[k], *line)
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
    """Return the table of several runs of a sensor side by side, the longest coast first.

    Of several runs and axes the rms over the axes comes before all, of a gyro the heading errors last.
    """
    found = list(runs.values())
    rows = error_rows(found)
    sections: list[tuple[Sequence[str], Rows]] = [(sensor.axes, rows)]
    if len(runs) > 1 and len(sensor.axes) > 1:
        coasts = [(label, [np.array([over_axes(v)]) for v in columns]) for label, columns in rows[: 2 * len(HORIZONS)]]
        sections = [(("rms",), coasts), *sections]
    table = _table(title, list(runs), sections, unit_of(sensor))
    if sensor.integral is None:
        return table
    for name in LONGEST_FIRST:
        table.add_row(f"heading, {name}", "[deg]", *(_cell(np.rad2deg(y.heading[name]), ".2f") for y in found))
    return table


def error_rows(runs: list[Scores]) -> Rows:
    """Return the rows of the table of errors, what decides first: a label, and for each run the errors (d,) in SI."""
    rows = []
    for name in LONGEST_FIRST:
        rows += [(f"coast, {name}", [y.coast[name] for y in runs])]
        rows += [("  its sigma", [y.coast_sigma[name] for y in runs])]
    return [
        *rows,
        ("bias, all", [y.filter_whole for y in runs]),
        ("bias, first 30 s", [y.filter_first for y in runs]),
    ]


def _cell(value: float, spec: str) -> str:
    return f"{value:{spec}}" if np.isfinite(value) else "-"
