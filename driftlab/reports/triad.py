"""Terms of a triad over temperature, bias to g-sensitivity: sentences, a table, charts, a page, JSON."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from driftlab.reports.charts import Chart, Line, Panel, Rule, axis_panels, band
from driftlab.reports.pages import page
from driftlab.reports.provenance import Sheet
from driftlab.reports.tables import TextTable
from driftlab.triad.consistency import excess, untested
from driftlab.triad.estimate import SURE, TriadFit
from driftlab.triad.model import AXES, BIAS, GRAVITY, GROUPS, NARROW, PARABOLA, SCALE, TERMS
from driftlab.units import BiasUnit, number
from fusion_core.chunk import Array

CROSS = GROUPS["misalignment"]
TEMPERATURE = "temperature [°C]"
MOTIONS = {  # by the unit of the bias: a motion, its size in the unit of the error, and where the errors are
    "rad/s": ("a turn of 360 deg", 360.0, "deg", "about its axis", "about another"),
    "m/s^2": ("a change of velocity by 10 m/s", 1e4, "mm/s", "along it", "across it"),
}
HOURLY = {"rad/s": (3600 * 180 / np.pi, "deg an hour"), "m/s^2": (1e3, "mm/s a second")}
FOREIGN = 1e-3  # share of units beyond which one is not of its family
TermsOfAxis = Callable[[int], Iterable[tuple[int, str, str]]]  # place, name in a chart and role of each that is drawn
POOR = 0.1  # of a usual size: a term that is known better is well known


def verdict(fit: TriadFit) -> list[str]:
    """Return a sentence for each term that is not observable, with the reason and the remedy."""
    lines = []
    low, high = fit.domain
    known = np.min(fit.sigma(np.array([low, (low + high) / 2, high])), axis=0)
    if drowned := [name for name, own in zip(fit.names, fit.free & fit.drowned, strict=True) if own]:
        lines.append(
            f"{', '.join(drowned)}: not observable, and taken as zero, since the fit leaves {fit.noise[0]:.2g} in SI "
            f"of the equations (rms), where {SURE * fit.usual[0]:.2g} is usual: the stimulus is not that of the "
            "recording, or contradicts itself; check axes, signs, units and times"
        )
    for j, name in enumerate(fit.names):
        if not fit.free[j] or fit.drowned[j]:
            continue
        if not fit.observable[j]:
            lines.append(f"{name}: not observable, and taken as zero, since {fit.stimulus.lacking(j)}")
        elif known[j] > POOR * fit.usual[j]:
            lines.append(f"{name}: poorly observable, {known[j] / fit.usual[j]:.0%} of a usual size, since "
                         f"{fit.stimulus.lacking(j)}")  # fmt: skip
    hidden = [fit.names[j] for j in np.flatnonzero(fit.unobservable_changes)]
    if high - low < NARROW:
        lines.append(
            f"no change over temperature is observable: all of it lies at {np.mean(fit.domain):.1f} °C; repeat it at "
            "other temperatures, 20 K apart or more"
        )
    elif hidden:
        lines.append(
            f"change from {low:.1f} to {high:.1f} °C: not observable for {', '.join(hidden)}, whose part of the "
            "stimulus lies at too few temperatures; repeat that part near both ends"
        )
    return lines


def untested_lines(fit: TriadFit) -> list[str]:
    """Return sentences: segments that contradict one another, a curve not tested between temperatures, one rate."""
    lines = excess(fit)[1]
    k, names = len(fit.temperatures), [c.name for c, own in zip(fit.terms.curves, fit.observable, strict=True) if own]
    said = f"{k} temperatures: the curve between them is not tested"
    if k == PARABOLA and names and "family" not in names:
        lines.append(
            f"{said}; a curvature of usual size (1 %, 10 mrad) counts in sigma there, add a temperature between"
        )
    if k > PARABOLA and f"order {k - 1}" in names:
        lines.append(
            f"{said} where it has order {k - 1}, which meets any {k} points; what a term of usual size may do between "
            "counts in sigma there, add a temperature between"
        )
    return [*lines, *untested(fit)]


def unit_of(term: int, unit: BiasUnit) -> tuple[str, float]:
    """Return the unit in which a term is shown, and the factor to it."""
    if term < len(AXES):
        return unit.shown, unit.factor
    if term >= len(TERMS):
        return f"{unit.shown}/g", unit.factor * GRAVITY
    return ("ppm", 1e6) if term in SCALE else ("mrad", 1e3)


def si_unit_of(term: int, unit: BiasUnit) -> str:
    """Return the unit of a term in SI."""
    return unit.si if term < len(AXES) else "1" if term < len(TERMS) else f"{unit.si}/(m/s^2)"


def table(fit: TriadFit, unit: BiasUnit) -> TextTable:
    """Return each term in the middle of the range, its change over the range, how sure both are, and its curve."""
    low, high = fit.domain
    T = np.array([(low + high) / 2])
    values, sigma, (change, of_change) = fit.terms.at(T)[0], fit.sigma(T)[0], fit.change()
    rows = []
    for j in map(int, np.flatnonzero(fit.free)):
        name, factor = unit_of(j, unit)
        spec = "+.0f" if name == "ppm" else "+.3f" if name == "mrad" else f"+{unit.digits}"
        of_term = [f"{values[j] * factor:{spec}}", f"{sigma[j] * factor:.2g}"]
        of_range = [f"{change[j] * factor:{spec}}", f"{of_change[j] * factor:.2g}"]
        curve = fit.terms.curves[j].name
        if not fit.observable[j]:
            of_term[0], of_range, curve = "-", ["-", "-"], "not observable"
        elif high - low < np.ptp(fit.grid) or fit.unobservable_changes[j]:
            of_range = ["not observable", "-"]
        elif curve == "constant":
            of_range = ["none", "-"]
        rows.append([f"{fit.names[j]} [{name}]", *of_term, *of_range, curve])
    heads = ("term", f"at {T[0]:.1f} °C", "sigma", "change", "sigma", "curve")
    return TextTable(heads, rows, f"terms from {low:.1f} to {high:.1f} °C", framed=False)


def frame_line(fit: TriadFit) -> str:
    """Return the frame of the terms, in a sentence."""
    if fit.stimulus.sensor_frame:
        return "frame: the sensor's own, z along its z axis and y in the plane of y and z (6 terms of M)"
    return "frame: that of the stimulus, with the mounting of the unit in it (9 terms of M)"


def level_lines(fit: TriadFit, unit: BiasUnit) -> list[str]:
    """Return the deviation of the level of the bias between recordings, in a sentence; none where they are too few."""
    size = fit.level * unit.factor
    line = f"level of the bias: it differs by {size:.2g} {unit.shown} from one recording to another (one sigma)"
    return [f"{line}, and the map holds the mean"] if fit.level else []


def family_line(fit: TriadFit, units: int) -> str:
    """Return the agreement of a stimulus with the family of so many units, in a sentence."""
    from scipy.special import chdtrc

    assert fit.distance is not None, "it was fitted with a family"
    square, count = fit.distance
    away = f"chi-square of the stimulus {square:.3g}, {count} expected"
    if float(chdtrc(count, square)) < FOREIGN:
        return (
            f"family: this unit is not like its {units} units ({away}); M holds at the temperatures of the stimulus "
            "alone, turn the unit at others too"
        )
    return f"family: {units} units, and this one is like them ({away})"


def result(fit: TriadFit, unit: BiasUnit, channel: str) -> str:
    """Return the number of terms that are known, and how well, in a sentence."""
    M, (low, high) = [*SCALE, *CROSS], fit.domain
    sigma = np.max(fit.sigma(fit.grid), axis=0)
    known_terms, free = int(np.sum(fit.observable[M])), int(np.sum(fit.free[M]))
    parts = [f"{channel}: {known_terms} of {free} terms of scale factor and misalignment are known"]
    strained = range(len(TERMS), len(fit.names))
    for name, some in (("scale factors", SCALE), ("misalignments", CROSS), ("g-sensitivities", strained)):
        known = [j for j in some if fit.observable[j]]
        if known:
            shown, factor = unit_of(known[0], unit)
            parts.append(f"{name} to {np.max(sigma[known]) * factor:.2g} {shown}")
    over = f"from {low:.1f} to {high:.1f} °C" if high - low >= NARROW else f"at {(low + high) / 2:.1f} °C"
    return f"{', '.join(parts)} (one sigma, where it is largest {over})" if known_terms else parts[0]


def use(fit: TriadFit, unit: BiasUnit) -> str:
    """Return the error of an angle after a turn, or of a velocity after a change, by the terms, in sentences.

    A motion along axis j is off by M_ij times its size about axis i; the worst axis and temperature count.
    """
    if unit.si not in MOTIONS:
        return ""
    motion, size, shown, about, others = MOTIONS[unit.si]
    terms, sigma = np.max(np.abs(fit.terms.at(fit.grid)), axis=0), np.max(fit.sigma(fit.grid), axis=0)
    scale, cross = list(SCALE), [j for j in CROSS if fit.free[j]]
    along, across = (2 * size * float(np.max(sigma[some], initial=0.0)) for some in (scale, cross))
    alone = size * float(np.max(terms[scale + cross]))
    text = f"{motion} is right within {number(along)} {shown} {about}"
    text += f" and {number(across)} {shown} {others}" if cross else ""
    text += f" (two sigma); with the bias alone taken off, up to {number(alone)} {shown} of it were wrong."
    if np.any(fit.free & ~fit.observable):
        text += " Terms that are not observable count as 1 % or 10 mrad."
    if not fit.has_bias:
        return f"{text} The bias is that of the map which the config names."
    hour, hourly = HOURLY[unit.si]
    level = 2 * float(np.max(sigma[list(BIAS)])) * hour
    return f"{text} The bias adds up to {number(level)} {hourly} (two sigma), and what it wanders afterwards."


def charts(fit: TriadFit, unit: BiasUnit) -> list[Chart]:
    """Return the charts of scale factor and misalignment, of the bias, of g-sensitivity, and of the residuals."""
    charts = [chart(fit)]
    if fit.has_bias:
        charts.append(_term_chart(fit, "Bias", "bias", unit_of(0, unit), lambda k: [(k, "bias", "estimate")]))
    if len(fit.names) > len(TERMS):
        along = [(f"force along {other}", f"series:{j}") for j, other in enumerate(AXES)]
        terms: TermsOfAxis = lambda k: [(len(TERMS) + 3 * k + j, *along[j]) for j in range(3)]  # noqa: E731
        charts.append(_term_chart(fit, "g-sensitivity", "g-sensitivity", unit_of(len(TERMS), unit), terms))
    return [*charts, _residual_chart(fit, unit)]


def _term_chart(fit: TriadFit, title: str, quantity: str, unit: tuple[str, float], terms: TermsOfAxis) -> Chart:
    """Return terms of each axis with their bands."""
    T, (shown, factor) = fit.grid, unit
    values, reach = fit.terms.at(T) * factor, 2 * fit.sigma(T) * factor

    def lines(k: int) -> Iterator[Line]:
        return (band(T, values[:, at], reach[:, at], name, role) for at, name, role in terms(k))

    return Chart(axis_panels(tuple(AXES), lines, quantity, shown), TEMPERATURE, title, "Bands: two sigma.")


def _residual_chart(fit: TriadFit, unit: BiasUnit) -> Chart:
    """Return the residuals of the equations, over the number of their segment or placement."""
    e = fit.stimulus.equations(fit.terms.at(fit.stimulus.T))
    panels, last = [], None
    for g in np.unique(e.group):
        left, T, t = (values[e.group == g] for values in (e.left, e.T, e.t))
        a_place = int(np.argmax(np.append(t[1:] != t[:-1], True))) + 1  # equations of one moment
        place = np.arange(1, len(left) // a_place + 1) + 0.5 * g  # turns are between placements
        name, shown, factor = (
            ("residual", unit.shown, unit.factor) if g == 0 else ("direction after a turn", "mrad", 1e3)
        )
        names = AXES if a_place == len(AXES) else [name] * a_place
        points = tuple(
            Line(place, left[k::a_place] * factor, names[k], f"series:{k}", style="points") for k in range(a_place)
        )
        noise = fit.noise[g] * factor
        panels.append(Panel(points, f"{name} [{shown}]", rules=(Rule(-noise, ""), Rule(noise, f"noise {noise:.3g}"))))
        last = last or (place, T[::a_place])
    assert last is not None, "a stimulus has equations"
    warm = Panel((Line(*last, "temperature", "temperature"),), "temperature [°C]", height=0.7)
    caption = "What the terms leave of each segment or placement, in their order; the walk of the bias is in it."
    return Chart((*panels, warm), "segment or placement", "Residuals", caption)


def chart(fit: TriadFit) -> Chart:
    """Return, of each axis, its scale factor and its misalignments with their bands."""

    def terms(k: int) -> Iterator[tuple[int, str, str]]:
        for j, other in enumerate(AXES):
            if fit.free[at := 3 + 3 * k + j]:
                yield (at, "scale", "series:3") if j == k else (at, f"misalignment to {other}", f"series:{j}")

    title = "Scale factor and misalignment"
    return _term_chart(fit, title, "scale (0.1 %) and misalignment", ("mrad", 1e3), terms)


def page_of(
    fit: TriadFit, unit: BiasUnit, channel: str, lead: str, doubts: Sequence[str], notes: Sequence[str], sheet: Sheet
) -> str:
    """Return the page of a fit."""
    strained = len(fit.names) > len(TERMS)
    terms = "scale factor, misalignment and g-sensitivity" if strained else "scale factor and misalignment"
    return page(
        "triad",
        title=f"{', '.join(['bias'] * fit.has_bias + [terms]).capitalize()} of the {channel}",
        lead=lead,
        sheet=sheet,
        result="; ".join([*doubts, result(fit, unit, channel)]),
        use=use(fit, unit),
        hidden=verdict(fit),
        terms=table(fit, unit),
        frame=frame_line(fit),
        charts=charts(fit, unit),
        notes=notes,
    )


def as_json(fit: TriadFit, unit: BiasUnit, doubts: Sequence[str]) -> dict[str, Any]:
    """Return the terms in SI over the grid of temperatures, and the verdict behind doubts and remarks."""
    T: Array = fit.grid
    change, of_change = fit.change()
    values, sigma = fit.terms.at(T), fit.sigma(T)
    moves = fit.observable & ~fit.unobservable_changes & (np.ptp(fit.domain) >= np.ptp(T))
    return {
        "frame": "sensor" if fit.stimulus.sensor_frame else "given",
        "temperature": T.tolist(),
        "verdict": [*doubts, *verdict(fit)],
        "terms": {
            name: {
                "unit": si_unit_of(j, unit), "told": bool(fit.observable[j]), "free": bool(fit.free[j]),
                "change_told": bool(moves[j]),
                "curve": fit.terms.curves[j].name, "value": values[:, j].tolist(), "sigma": sigma[:, j].tolist(),
                "change": float(change[j]), "change_sigma": float(of_change[j]),
            }
            for j, name in enumerate(fit.names)
        },
    }  # fmt: skip
