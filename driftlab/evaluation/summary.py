"""The summary of a run: for programs as JSON, for people as sentences and as rows of errors."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.evaluation.overview import ScoredRun, map_of
from driftlab.evaluation.scores import FIRST, HORIZONS, LONGEST_FIRST, WHOLE, Scores, over_axes
from driftlab.filtering.segment import RunLog
from driftlab.filtering.setup import noise_remarks, turned
from driftlab.units import EARTH, axis_name, number
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap
from fusion_core.errors import moment

SHORT = min(HORIZONS.values())  # s after the alignment: with less there is no score
COMPLETE = 0.9  # of the time: a score that stands on less says why
# deviations of a prediction: by chi square of one degree of freedom, a right model is off by more in one of 15,000, and
# more degrees make it rarer, however they depend on one another (Szekely and Bakirov 2003)
FAR_OFF = 4.0
UNSEEN = 1.0  # s in gaps: a unit may have been turned in as much
CHANCE = 1e-3  # probability that innovations of a right model are said to add up
SMALL = 1.3  # times that a deviation of the bias is too small: with less nothing is said
AXES = 3  # of a gyro whose turns are seen
GAP = 1.5  # times the length of an epoch between two: the unit may have been turned unseen
NOTICED = 0.05  # of the nis: by less than that it is outside its bounds only because a long run has narrow ones
Rows = Sequence[tuple[str, list[Array]]]  # of a table: a label, and for each run the errors (d,) in SI


def summarise(run: ScoredRun) -> dict[str, Any]:
    """Return the content of `summary.json`."""
    overview, model, journal, first = run.overview, run.model, run.journal, run.alignment
    scores, nis, unit = run.yardsticks, overview.nis, run.unit
    heading = {"coast_heading_error_rad": scores.heading} if model.tracked.integral else {}
    return {
        "t": {
            "first_row_s": journal.faults.first_row,
            "start_s": overview.start,
            "aligned_s": first.t,
            "end_s": overview.end,
        },
        "updates": {"count": overview.count, "interval_s": first.dt, "used": overview.used},
        "axes": {sensor.channel: list(sensor.axes) for sensor in model.sensors},
        "states": dict(zip(model.space.labels, model.space.units, strict=True)),
        **unit.note,
        unit.key("bias"): {"end": overview.bias, "sigma": overview.sigma},
        unit.key("filter_rmse"): {FIRST: scores.filter_first, WHOLE: scores.filter_whole},
        unit.key("coast_rmse"): scores.coast,
        unit.key("coast_sigma"): scores.coast_sigma,
        **heading,
        "share": {**scores.share, "moved": scores.moved},
        "nis": {"mean_per_component": nis.mean, "low": nis.low, "high": nis.high, "consistent": nis.consistent},
        "whiteness_p": overview.whiteness_p,
        "noise_ratio": first.noise_ratio,
        "aligned_again_s": [a.t for a in journal.alignments[1:]],
        "motion_s": journal.moving.spans,
        "motion_axes": journal.moving.worst(),
        "refused_s": journal.refused.spans,
        "refused_axes": journal.refused.worst(),
        "temperature_swing_K": overview.swing,
        "faults": {what: {"count": f.count, "first": f.first} for what, f in journal.faults.found.items()},
    }


def remarks(run: ScoredRun) -> list[str]:
    """Return the remarks on a run for its user, one sentence each."""
    overview, model, journal = run.overview, run.model, run.journal
    lines = [*journal.faults.lines(), *_rejected(run), *_scored(run), *mispredicted(run)]
    first, *again = journal.alignments
    if again:
        when = f"at {moment(again[0].t, journal.faults.first_row)}"
        times = when if len(again) == 1 else f"{len(again)} times, first {when}"
        other = "attitude or bias" if model.tracked.integral else "bias"
        lines.append(f"aligned again {times}: still, but at another {other} than before")
    lasted, nis = run.span, overview.nis
    if overview.used == 0:
        lines.append("no update was used: nothing is known of the bias; check the channels' units and paths, and noise")
    elif lasted < SHORT:
        lines.append(
            f"only {lasted:.1f} s after the alignment: too short to judge by; "
            f"record {SHORT:.0f} s or more at rest after it"
        )
    if not nis.consistent and abs(nis.mean - 1) >= NOTICED:
        expected = f"{nis.low:.3g} to {nis.high:.3g} was expected"
        lines.append(f"NIS {nis.mean:.3g} per component, {expected}: {inconsistency(nis.mean)}")
    lines += wandering(run)
    updates = model.align / first.dt
    noises = (noise_remarks(s, first.noise_ratio[s.channel], updates=updates) for s in model.sensors)
    return [*lines, *chain.from_iterable(noises), *_seen(run)]


def _seen(run: ScoredRun) -> list[str]:
    names = (name.partition("::")[0] for name in in_sample(map_of(run.config), [run.config.recording]))
    text = "the map was fitted on {}: where that is this file, judge the prediction by another recording"
    return [text.format(name) for name in names]


def in_sample(fitted: FittedMap | None, recordings: Iterable[str]) -> list[str]:
    """Return the names of recordings without their folders, of those that are named as one that a map was fitted on."""
    known = "" if fitted is None else fitted.record.provenance.get("recordings", "")
    seen = {name.partition("::")[0] for name in known.split(", ") if name}
    return [name for name in (Path(path).name for path in recordings) if name.partition("::")[0] in seen]


def wandering(run: ScoredRun) -> list[str]:
    """Return a remark where innovations add up, since the bias moves by more than its walk allows; none where not.

    An error e of the bias is e^2 tau / N^2 of the square of an innovation, N the declared white noise and tau the
    update's length. Of innovations of a mean square s a filter of deviation P that is at its best makes s P^2, and
    what adds up is beyond that. P is the least deviation: what others have of thermometer and map adds up as well.
    """
    overview, sensor = run.overview, run.sensor
    d = len(sensor.axes)
    ratio, rows, p, square = (column[-d:] for column in overview.slow)
    tau = run.alignment.dt
    own, deviation = overview.deviations
    error = square * (own**2 + np.maximum(ratio - 1, 0) / rows * sensor.noise**2 / tau)
    small = np.sqrt(np.divide(error, deviation**2, out=np.zeros(d), where=deviation > 0))
    seen = (p < CHANCE / d) & (small > SMALL)
    if not np.any(seen):
        return []
    k = int(np.argmax(np.where(seen, small, 0)))
    names = [axis_name(sensor.channel, axis) for axis in sensor.axes]
    wandering_axes = ", ".join(name for name, one in zip(names, seen, strict=True) if one)
    return [
        f"innovations of {wandering_axes} add up: over {rows[k] * tau:.3g} s {names[k]} has "
        f"{ratio[k]:.2g} times the square that the model says, so the bias moves by more than its walk allows, and its "
        f"sigma is about {small[k]:.2g} times too small; measure the walk with `driftlab allan`, or look for what "
        "moves the bias with `driftlab explain`"
    ]


def is_trusted(run: ScoredRun) -> bool:
    """Return True if the deviations of a run are large enough for its innovations, one by one and added up."""
    nis = run.overview.nis
    return (nis.consistent or nis.mean < 1 + NOTICED) and not wandering(run)


def inconsistency(mean: float) -> str:
    """Return the meaning of a mean NIS a component that is outside its bounds."""
    (size, deviations), root = ("larger", "small") if mean > 1 else ("smaller", "large"), np.sqrt(mean)
    by = f"{100 * abs(root - 1):.2g} % {size} than" if 0.5 <= root < 2 else f"{root:.2g} times as large as"
    return f"innovations are {by} the model says, so its deviations are too {deviations}"


def _rejected(run: ScoredRun) -> list[str]:
    """Return the motion of the unit, and the refusals without one."""
    journal, swing, lines = run.journal, run.overview.swing, []
    if journal.moving.spans:
        lines.append(
            f"motion, not used: {_extent(journal.moving.spans, journal)}, seen by {', '.join(journal.moving.worst())}"
        )
    refused, axes = _unexplained(journal), journal.refused.worst()
    if not refused:
        return lines
    advice = "the model does not fit there: its map, walk or noise is wrong"
    if all(axis.startswith("accel") for axis in axes):
        warmed = f", while the temperature moved by {swing:.1f} K" if swing >= 1 else ""
        advice = (
            f"that looks like an accelerometer whose bias drifts{warmed}, and not like motion; "
            "raise filter.accel.bias.walk, or write `accel: null` under filter"
        )
    still = "the unit stood still" if run.sensor.integral else "nothing moved"
    return [
        *lines,
        f"refused although {still}: {_extent(refused, journal)}, because of {', '.join(axes)}; "
        f"{advice}. The scores count it all the same",
    ]


def _unexplained(journal: RunLog) -> list[tuple[float, float]]:
    """Return the spans refused at rest, but for those between a motion and the alignment after it: it was turned."""
    first, *again = journal.alignments
    aligned, ends = [a.t for a in again], [stop for _, stop in journal.moving.spans]
    return [
        (start, stop)
        for start, stop in journal.refused.spans
        if not (stop in aligned and any(0 < start - end < 1.5 * first.dt for end in ends))
    ]


def _extent(spans: Sequence[tuple[float, float]], journal: RunLog) -> str:
    total = sum(stop - start for start, stop in spans) + len(spans) * journal.alignments[0].dt
    count = "1 stretch" if len(spans) == 1 else f"{len(spans)} stretches"
    return f"{total:.1f} s in {count} (first at {moment(spans[0][0], journal.faults.first_row)})"


def _scored(run: ScoredRun) -> list[str]:
    """Return the scores that have no value although the recording is long enough, and the time that others stand on."""
    scores, lasted = run.yardsticks, run.span
    lengths = {FIRST: 30.0, WHOLE: SHORT, **HORIZONS, "to the end": SHORT}
    missing = [
        f"{name} ({100 * scores.share[name]:.0f} %)"
        for name, values in {FIRST: scores.filter_first, WHOLE: scores.filter_whole, **scores.coast}.items()
        if lasted >= lengths[name] and not np.all(np.isfinite(values))
    ]
    lines = []
    if missing:
        brackets = "of that time, the share in brackets was measured at rest, too little"
        lines.append(f"no score for {', '.join(missing)}: {brackets}")
    share, moved = scores.share[WHOLE], scores.moved
    if share < COMPLETE and lasted >= SHORT:
        parts = (("gaps", max(0.0, 1 - share - moved)), ("motion", moved))
        why = [f"{100 * part:.0f} % {what}" for what, part in parts if part >= 0.005]
        lines.append(
            f"the scores stand on {100 * share:.0f} % of the time after the alignment ({', '.join(why)}); "
            "in between the error is taken to go straight"
        )
    return lines


def mispredicted(run: ScoredRun) -> list[str]:
    """Return the longest prediction that is off by far more than its deviation, and what may be the cause."""
    unit = run.unit
    for name, (error, _, ratio) in run.predictions.items():
        if np.any(ratio > FAR_OFF) and not _turned(run):  # one that was turned is another matter
            k = int(np.nanargmax(ratio))
            by = f"{axis_name(run.sensor.channel, run.yardsticks.axes[k])} {error[k] * unit.factor:.3g} {unit.shown}"
            mapped = "map or walk do not fit this recording; check that unit, axes and thermometer are those of the map"
            bare = "the walk does not fit this recording; fit a map of the temperature with driftlab fit-map"
            so = f"so {mapped if run.config.tracked_maps() else bare}, and see with driftlab explain what is missing"
            times = f"{ratio[k]:.2g} times its sigma and the reference's noise together"
            return [f"prediction, {name}: off by {by}, {times}, {so}"]
    return []


def _turned(run: ScoredRun) -> bool:
    """Return True if the unit was aligned again, and may have been turned before, seen or unseen."""
    (first, *again), scores = run.journal.alignments, run.yardsticks
    seen = bool(run.journal.moving.spans) or (1 - scores.share[WHOLE] - scores.moved) * run.span > UNSEEN
    return bool(again) and (seen or any(turned(first, one, run.sensor.channel) for one in again))


def jumps(run: ScoredRun, columns: Mapping[str, Array]) -> list[str]:
    """Return a sentence on each rest of a gyro triad that is at another bias, and at no other attitude, than the last.

    The sizes of its readings since that rest add up to the largest angle that it may have turned by, which moves an
    Earth rate by less than the readings of the new rest are off.
    """
    sensor, lines = run.sensor, []
    if not sensor.integral or len(sensor.axes) != AXES:
        return []
    for again in run.journal.alignments[1:]:
        stop = int(np.searchsorted(columns["t"], again.t, side="right"))
        used = np.flatnonzero(columns["used"][:stop])
        before = int(used[-1]) if len(used) else stop
        rows = slice(before + 1, stop)
        t, tau = columns["t"][before:stop], columns["tau"][rows]
        if before + 2 > stop or np.any(np.diff(t) > GAP * tau):
            continue
        off = columns["rate"][rows] - columns["bias"][rows]
        angle = float(tau @ np.linalg.norm(off, axis=1))
        rest = t[1:] > again.t - run.model.patience.realign_after / 2  # no later than it came to rest
        jump = np.mean(off[rest], axis=0)
        sigma = np.hypot(columns["bias_sigma"][stop - 1], sensor.noise / np.sqrt(np.sum(tau[rest])))
        if np.linalg.norm(jump) > EARTH * min(angle, 2.0) + FAR_OFF * np.linalg.norm(sigma):
            k = int(np.argmax(np.abs(jump)))
            when = moment(again.t, run.journal.faults.first_row)
            by = f"{number(jump[k] * run.unit.factor)} {run.unit.shown}"
            lines.append(
                f"{axis_name(sensor.channel, sensor.axes[k])} jumped by {by} before {when}, and no turn explains "
                f"it: by then the unit had turned by {np.rad2deg(angle):.2g}° at most; the bias jumped, or the unit is "
                "turned steadily: look at it and its supply there, or leave that part out with PATH::START:STOP"
            )
    return lines


def error_rows(runs: Sequence[Scores]) -> Rows:
    """Return the rows of the table of errors, what decides first: a label, and for each run the errors (d,) in SI."""
    rows = []
    for label, columns in error_pairs(runs):
        rows.append((label, [errors for errors, _ in columns]))
        if sigmas := [sigma for _, sigma in columns if sigma is not None]:
            rows.append(("  its sigma", sigmas))
    return rows


def error_pairs(runs: Sequence[Scores]) -> list[tuple[str, Sequence[tuple[Array, Array | None]]]]:
    """Return the rows of `error_rows` with the sigma of a prediction beside its error, None where there is none."""
    predicted = [(name, [(run.coast[name], run.coast_sigma[name]) for run in runs]) for name in LONGEST_FIRST]
    return [
        *((f"prediction, {name}", columns) for name, columns in predicted),
        ("bias, all", [(run.filter_whole, None) for run in runs]),
        ("bias, first 30 s", [(run.filter_first, None) for run in runs]),
    ]


def coasts_over_axes(rows: Rows) -> Rows:
    """Return the rows of `error_rows` on predictions, with the rms (1,) over the axes in place of the errors (d,)."""
    return [(label, [np.array([over_axes(v)]) for v in columns]) for label, columns in rows[: 2 * len(LONGEST_FIRST)]]
