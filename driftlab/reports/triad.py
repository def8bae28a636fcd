"""Terms of a triad over temperature, bias to g-sensitivity: sentences, a table, a chart, JSON."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from driftlab.reports.charts import Chart, Line, axis_panels, band
from driftlab.reports.tables import TextTable
from driftlab.triad.fit import TriadFit
from driftlab.triad.model import AXES, SCALE, TERMS
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

GRAVITY = 9.80665  # m/s^2, in a g


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
        if not fit.told[j]:
            of_term[0], of_range, curve = "-", ["-", "-"], "not told"
        elif high - low < np.ptp(fit.grid) or fit.untold_changes[j]:
            of_range = ["not told", "-"]
        elif curve == "constant":
            of_range = ["none", "-"]
        rows.append([f"{fit.names[j]} [{name}]", *of_term, *of_range, curve])
    heads = ("term", f"at {T[0]:.1f} °C", "sigma", "change", "sigma", "curve")
    return TextTable(heads, rows, f"terms from {low:.1f} to {high:.1f} °C", framed=False, rigid=True)


def frame_line(fit: TriadFit) -> str:
    """Return the frame of the terms, in a sentence."""
    if fit.stimulus.sensor_frame:
        return "frame: the sensor's own, z along its z axis and y in the plane of y and z (6 terms of M)"
    return "frame: that of the stimulus, with the mounting of the unit in it (9 terms of M)"


def chart(fit: TriadFit, unit: BiasUnit) -> Chart:
    """Return, of each axis, its scale factor and its misalignments with their bands."""
    T = fit.grid
    values, sigma = fit.terms.at(T), fit.sigma(T)

    def lines(k: int) -> Iterator[Line]:
        for j, other in enumerate(AXES):
            at = 3 + 3 * k + j
            if fit.free[at]:
                what = "scale" if j == k else f"misalignment to {other}"
                yield band(T, values[:, at] * 1e3, 2 * sigma[:, at] * 1e3, what, f"series:{j}")

    panels = axis_panels(tuple(AXES), lines, "scale (0.1 %) and misalignment", "mrad")
    return Chart(panels, "temperature [°C]", "Scale factor and misalignment", "bands: two sigma")


def as_json(fit: TriadFit, unit: BiasUnit) -> dict[str, Any]:
    """Return the terms in SI over the grid of temperatures."""
    T: Array = fit.grid
    change, of_change = fit.change()
    values, sigma = fit.terms.at(T), fit.sigma(T)
    return {
        "frame": "sensor" if fit.stimulus.sensor_frame else "given",
        "temperature": T.tolist(),
        "verdict": fit.verdict(),
        "terms": {
            name: {
                "unit": si_unit_of(j, unit), "told": bool(fit.told[j]), "free": bool(fit.free[j]),
                "change_told": bool(fit.told[j] and not fit.untold_changes[j] and np.ptp(fit.domain) >= np.ptp(T)),
                "curve": fit.terms.curves[j].name, "value": values[:, j].tolist(), "sigma": sigma[:, j].tolist(),
                "change": float(change[j]), "change_sigma": float(of_change[j]),
            }
            for j, name in enumerate(fit.names)
        },
    }  # fmt: skip
