"""The certificate of a unit: one sheet of A4 as a page, and the same as JSON.

It is what ISO/IEC 17025:2017 lists in 7.8.2 and 7.8.4, as far as a program knows it: what was done with what, results
with expanded uncertainty and its budget (`driftlab.evaluation.uncertainty`), limits with the rule that decides them
(`driftlab.evaluation.limits`), and for what they hold. What the laboratory alone knows is taken from the config
(`certificate:`), or is a line to fill in by hand. The page shows the texts of the JSON, and computes nothing.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.config import CertificateTexts, Config
from driftlab.evaluation.limits import OF_M, RULE, LimitResult, Measured, outcome, verdict
from driftlab.evaluation.uncertainty import K, UncertaintyBudget, bias_budget, expanded, matrix_budget
from driftlab.maps.fit import axes_of
from driftlab.noise.local_level import walk_of
from driftlab.reports.pages import page
from driftlab.reports.provenance import Sheet
from driftlab.soak.blocks import SoakSummary
from driftlab.soak.placements import Placements
from driftlab.storage.json import plain, text_of
from driftlab.triad.estimate import TriadFit
from driftlab.triad.model import AXES, GRAVITY, PAIRS
from driftlab.units import EARTH, BiasUnit, default_unit, duration, tracked_unit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap

FILES = ("certificate.html", "certificate.json")
LARGE = {"rad/s": (np.deg2rad(1.0), "deg/s"), "m/s^2": (GRAVITY, "m/s^2")}  # beyond which another unit is the usual
USUAL = {"rad/s": "deg/h", "m/s^2": "mg"}
MAX_RECORDINGS = 3  # that are listed on the sheet; of more it has one hash of all
MAX_DECIMALS = 6  # of a number without a power of ten
SOURCES = {
    "curve": "noise and walk of the recording in the curve, smoothing, misfit",
    "mean": "noise of the mean level, s / √n",
    "memory": "hysteresis or lag, half of warming less cooling",
    "placements": "level, by the placements",
    "power-ups": "level from one power-up to another",
    "thermometer": "thermometer, slope times its uncertainty",
    "equations": "noise, walk of the bias",
    "choice": "choice of curve and walk",
    "input": "size of the input",
    "temperatures": "curve between temperatures, or beyond one, not measured",
    "stimulus": "fit to the stimulus",
}
NAMES = {
    "swing": "swing over temperature, as found",
    "residual": "residual of 30 s averages, after the map",
    "hysteresis": "warming less cooling, largest",
    "noise": "white noise",
    "bias_instability": "bias instability, after the map",
    "coast": "prediction over 10 min, rms of its error",
    "bias": "bias at the end, by the filter",
}
TEXTS = {  # of the laboratory, as the sheet calls them
    "laboratory": "laboratory, address",
    "location": "place of calibration",
    "customer": "customer, contact",
    "item": "manufacturer, type",
    "condition": "condition as received",
    "received": "received on",
    "procedure": "procedure, deviations",
    "equipment": "equipment",
    "traceability": "traceability",
    "environment": "humidity, pressure, supply",
}


def stated(value: float, uncertainty: float) -> tuple[str, str]:
    """Return a value and its expanded uncertainty of two significant digits, both with the same last digit."""
    if not (math.isfinite(uncertainty) and uncertainty > 0):
        return f"{value:.4g}", "not known"
    decimals = 1 - math.floor(math.log10(float(f"{uncertainty:.1e}")))
    if decimals > MAX_DECIMALS:
        digits = max(decimals + math.floor(math.log10(max(abs(value), uncertainty))), 0)
        return f"{value:.{digits}e}", f"{uncertainty:.1e}"
    both = (round(number, decimals) + 0.0 for number in (value, uncertainty))  # no zero has a sign
    first, second = (f"{number:.{max(decimals, 0)}f}" for number in both)
    return first, second


def two_digits(uncertainty: float) -> str:
    """Return an uncertainty with two significant digits, or 0."""
    return stated(0.0, uncertainty)[1] if uncertainty > 0 else "0"


def trade_unit(si: str, largest: float, unit: BiasUnit) -> BiasUnit:
    """Return the unit that the trade has for biases up to the largest, in an SI unit: deg/h or deg/s, mg or m/s^2."""
    if si not in USUAL:
        return unit
    limit, large = LARGE[si]
    return BiasUnit(si, large if largest >= limit else USUAL[si])


def statements(values: Array, widths: Array, factors: Array) -> list[str]:
    """Return values (d,) times factors, each with its expanded uncertainty (d,), as the sheet has them.

    NaN: it is not known.
    """
    pairs = (stated(float(v), float(w)) for v, w in zip(values * factors, widths * factors, strict=True))
    return [f"{value} ± {width}" if width != "not known" else f"{value}, U not known" for value, width in pairs]


@dataclass(frozen=True, eq=False)
class Certificate:
    """A certificate of one unit.

    Attributes
    ----------
    command : str
        By which the results were made.
    config : Config
    sheet : Sheet
        The things that the results stand on.
    judged : sequence of LimitResult
        The config's limits, held against what was measured.
    measured : mapping of str to Measured
        What was measured, by the names of the limits.
    fitted : FittedMap, optional
        The map, where there is one.
    soak, placements : SoakSummary, Placements, optional
        Of the fit, where they are known.
    seconds : float
        How long the unit was measured at rest.
    domain : (float, float), optional
        Lowest and highest temperature of the recordings, degC; those of the map where they are left out.
    name : str
        The unit's name in a fleet.
    remarks : sequence of str
        What one should know of it besides.
    fit : TriadFit, optional
        Of scale factor and misalignment, where it is at hand.
    levelled : bool
        Whether the stimulus shows the level of the bias.
    """

    command: str
    config: Config
    sheet: Sheet
    judged: Sequence[LimitResult]
    measured: Mapping[str, Measured]
    fitted: FittedMap | None = None
    soak: SoakSummary | None = None
    placements: Placements | None = None
    seconds: float = 0.0
    domain: tuple[float, float] | None = None
    name: str = ""
    remarks: Sequence[str] = ()
    fit: TriadFit | None = None
    levelled: bool = False

    @property
    def texts(self) -> CertificateTexts:
        """Those that the laboratory has written into the config."""
        return self.config.certificate or CertificateTexts()

    @property
    def axes(self) -> list[str]:
        """Names of the axes."""
        if self.fitted is not None:
            return list(axes_of(self.fitted))
        return list(self.config.filter.tracked.axes) if self.config.filter is not None else []

    @cached_property
    def budget(self) -> UncertaintyBudget | None:
        """The bias over temperature with its budget; None without a map."""
        if self.fitted is None:
            return None
        thermometer = self.texts.temperature_uncertainty
        level = self.fit.level if self.fit is not None and self.levelled else 0.0
        soak, placements = self.soak, self.placements
        return bias_budget(self.fitted, thermometer=thermometer, soak=soak, placements=placements, level=level)

    @cached_property
    def si(self) -> str:
        """SI unit of the bias."""
        return tracked_unit(self.config.filter).si if self.fitted is None else self.fitted.record.unit

    def unit(self, *values: Array | float) -> BiasUnit:
        """Return the trade's unit for biases of such a size, SI."""
        own = tracked_unit(self.config.filter)
        sizes = [np.max(np.abs(v), initial=0.0, where=np.isfinite(v)) for v in values]
        return trade_unit(self.si, float(max(sizes)), own if own.si == self.si else default_unit(self.si))

    @cached_property
    def content(self) -> dict[str, Any]:
        """The content as JSON has it: numbers in SI, and the texts of the sheet; `identification` is of all but today.

        The date of issue is no part of it, so the same results have the same one.
        """
        issued = {"issued": datetime.now(UTC).date().isoformat()}
        own, domain = self.texts.model_dump(mode="json"), None if self.fitted is None else self.fitted.domain
        if own["number"] and self.name:
            own["number"] = f"{own['number']}/{self.name}"
        content = plain({
            "schema": 1,
            "program": f"driftlab {self.command}",
            "driftlab": __version__,
            "laboratory": {name: own[name] for name in (*TEXTS, "number", "performed", "operator", "authorised_by")},
            "item": {"serial": self.sheet.serial or self.name or None, "unit": self.name or None, **self._sensor()},
            "method": self._method(),
            "temperature_degC": self.domain or domain,
            "valid_degC": _within(domain, self.domain) if self.command == "run" else domain or self.domain,
            "coverage_factor": K,
            "bias": self._bias(),
            "matrix": self._matrix(),
            "figures": [self._figure(name, one) for name, one in self.measured.items() if name not in OF_M],
            "limits": [row.as_json(self.unit(row.limit)) for row in self.judged],
            "verdict": verdict(self.judged) or None,
            "rule": RULE if self.judged else None,
            "not_covered": list(self._missing()),
            "remarks": list(self.remarks),
        })  # fmt: skip
        digest = hashlib.sha256(text_of(content).encode()).hexdigest()
        return {**content, "identification": digest[:16], **issued}

    def text(self) -> str:
        """Return the certificate as JSON."""
        return text_of(self.content)

    def page(self) -> str:
        """Return the certificate as a page of one sheet."""
        matrix = self.content["matrix"]
        return page(
            "certificate",
            content=self.content,
            texts=TEXTS,
            sensed=[k for k, one in enumerate(matrix["terms"]) if one["free"]] if matrix else [],
            limits=[row.cells(self.unit(row.limit)) for row in self.judged],
            outcome=outcome(verdict(self.judged)),
            listed=MAX_RECORDINGS,
        )

    def _sensor(self) -> dict[str, Any]:
        channel = self.fitted.record.channel if self.fitted is not None else ""
        if not channel and self.config.filter is not None:
            channel = self.config.filter.tracked.channel
        return {"channel": channel, "axes": self.axes, "si": self.si}

    def _method(self) -> dict[str, Any]:
        sheet, recordings, fitted = self.sheet, self.sheet.recordings, self.fitted
        own = (one for one in sheet.maps if fitted is not None and one["channel"] == fitted.record.channel)
        lines = "".join(f"{one.get('sha256', '')}  {one['name']}\n" for one in recordings)
        dated = sheet.date if sheet.dated != "page" else None
        stimulus = None if self.fit is None or self.config.stimulus is None else self.config.stimulus.kind
        return {
            "performed": self.texts.performed or dated,
            "seconds": self.seconds or None,
            "lasted": duration(self.seconds) if self.seconds else None,
            "recordings": [{**one, "file": Path(str(one["name"])).name} for one in recordings],
            "recordings_sha256": hashlib.sha256(lines.encode()).hexdigest(),
            "config": sheet.config or None,
            "config_sha256": sheet.config_sha256,
            "map": next(({**one, "name": Path(one["file"]).name} for one in own), None),
            "kind": None if fitted is None else fitted.record.kind,
            "samples": None if fitted is None else fitted.record.samples,
            "reference": self._reference(),
            "stimulus": stimulus,
            "placements": None if self.fit is None else len(self.fit.stimulus.T),
            "plugins": sheet.plugins,
            "versions": sheet.versions,
        }

    def _reference(self) -> str:
        """Return the known input of the sensor, which was taken off."""
        if self.si == "m/s^2":
            return "gravity of the latitude" if self.config.latitude is not None else "gravity of 9.80665 m/s²"
        if self.si != "rad/s":
            return "its known input"
        parts = {"vertical": self._vertical, "horizontal": self._vertical and self.config.heading is not None}
        known = " and ".join(name for name, there in parts.items() if there)
        return f"Earth rate, {known} part" if known else "no Earth rate"

    @property
    def _vertical(self) -> bool:
        """True if the vertical part of the Earth rate is known: latitude, and accelerometers that show the vertical."""
        sensors = () if self.config.filter is None else self.config.filter.sensors
        return self.config.latitude is not None and any(sensor.unit == "m/s^2" for sensor in sensors)

    @property
    def _turned(self) -> bool:
        """True if the axis of a turntable points up at a known latitude: the Earth rate is known, or averages out."""
        stimulus = self.config.stimulus
        of_table = stimulus is not None and stimulus.kind == "rate_table"
        return self.levelled and of_table and self.config.latitude is not None

    def _bias(self) -> dict[str, Any] | None:
        """Return the bias over temperature with its expanded uncertainty, and the budget where that is largest."""
        budget = self.budget
        if budget is None:
            return None
        unit = self.unit(budget.values)
        d = budget.values.shape[1]
        return {"shown_unit": unit.shown, **_table(budget, np.full(d, unit.factor))}

    @cached_property
    def matrix_budget(self) -> UncertaintyBudget | None:
        """Scale factor and misalignment over temperature with their budget; None of a map without."""
        matrix = None if self.fitted is None else self.fitted.record.matrix
        if matrix is None:
            return None
        fit, thermometer = self.fit, self.texts.temperature_uncertainty
        return matrix_budget(matrix, thermometer=thermometer, parts=None if fit is None else partial(_of_matrix, fit))

    def _matrix(self) -> dict[str, Any] | None:
        """Return the terms of M over temperature with their expanded uncertainty, and the budget of each."""
        budget = self.matrix_budget
        if budget is None or self.fitted is None or self.fitted.record.matrix is None:
            return None
        matrix, axes = self.fitted.record.matrix, self.axes
        pairs = [(i, j) for i in range(len(axes)) for j in range(len(axes))]
        units = [OF_M["scale" if i == j else "misalignment"] for i, j in pairs]
        terms = [
            {"term": f"{axes[i]}{axes[j]}", "of": "scale" if i == j else "misalignment", "shown_unit": unit.shown,
             "told": matrix.told[k], "free": bool(matrix.free[k])}
            for k, ((i, j), unit) in enumerate(zip(pairs, units, strict=True))
        ]  # fmt: skip
        table = _table(budget, np.array([unit.factor for unit in units]))
        for row in table["rows"]:
            row["shown"] = [
                text if told else "not observable" for text, told in zip(row["shown"], matrix.told, strict=True)
            ]
        return {"frame": matrix.frame, "terms": terms, **table}

    def _figure(self, name: str, measured: Measured) -> dict[str, Any]:
        """Return a measured quantity, or why there is none."""
        values, nothing = np.asarray(measured.values, dtype=np.float64), np.full(len(measured.axes), np.nan)
        why = measured.missing or (measured.otherwise if not np.all(np.isfinite(values)) else "")
        widths = expanded(measured)
        hidden = (values == 0) & (measured.high is not None)  # what does not show has an upper limit
        highs = np.where(hidden, nothing if measured.high is None else measured.high, np.nan)
        widths = nothing if widths is None or why else np.where(hidden, np.nan, widths)
        unit = self.unit(values, highs)
        texts = [f"not measured: {why}"] if why else statements(values, widths, np.full(len(values), unit.factor))
        if not why:
            bounds = [f"≤ {two_digits(v * unit.factor)}" if np.isfinite(v) else "not known" for v in highs]
            texts = [bound if below else text for below, bound, text in zip(hidden, bounds, texts, strict=True)]
        per = "/sqrt(Hz)" if name == "noise" else ""
        return {
            "name": name, "of": NAMES.get(name, name.replace("_", " ")), "unit": self.si + per,
            "shown_unit": unit.shown + per, "value": values, "U": widths, "at_most": highs,
            "stands_on": measured.stands_on, "missing": why or None, "shown": texts,
        }  # fmt: skip

    def _missing(self) -> Iterator[str]:
        """Yield the sources that the uncertainties do not cover, in words."""
        yield from () if self.budget is None else self.budget.missing
        yield from () if self.matrix_budget is None else self.matrix_budget.missing
        strained = None if self.fitted is None else self.fitted.record.sensitivity
        if strained is not None:
            G = GRAVITY * float(np.max(np.linalg.norm(strained.at(np.array(strained.T)), axis=2)))
            yield f"the g-sensitivity: the bias is that without a force, to which 1 g adds up to {self._size(G)}"
        if self.si == "rad/s" and not self._turned and not (self._vertical and self.config.heading is not None):
            part = math.cos(self.config.latitude or 0.0) if self._vertical else 1.0
            which = "horizontal part of the " if self._vertical else ""
            yield f"the {which}Earth rate, which is in the bias: up to {self._size(EARTH * part)} an axis"
        if self.si == "m/s^2" and self.fitted is not None and self.placements is None and not self.levelled:
            yield "the level: the map's file does not keep what the placements say of it"
        sensor = None if self.config.filter is None else self.config.filter.tracked
        walk = None if sensor is None else walk_of(sensor)
        if walk is not None and (largest := float(np.max(walk))) > 0:
            yield f"what the bias wanders afterwards: {self._size(largest * 60)} in 1 h by the config's walk"
        yield "other conditions than those of the recording: motion, vibration, supply, ageing"

    def _size(self, value: float) -> str:
        unit = self.unit(value)
        return f"{two_digits(value * unit.factor)} {unit.shown}"


def _of_matrix(fit: TriadFit, T: Array) -> dict[str, Array]:
    """Return the deviations (N, 9) of M at T (N,) by source."""
    M = slice(len(AXES), len(AXES) + len(PAIRS))
    return {name: sigma[:, M] for name, sigma in fit.parts(T).items()}


def _table(budget: UncertaintyBudget, factors: Array) -> dict[str, Any]:
    """Return quantities over temperature, and the budget of each where U is largest, with texts by the factors (d,)."""
    U = budget.U
    widths = np.full_like(budget.values, np.nan) if U is None else U
    rows = [
        {"temperature_degC": T, "value": value, "U": width, "shown": statements(value, width, factors)}
        for T, value, width in zip(budget.T, budget.values, widths, strict=True)
    ]
    if U is None or budget.u is None:
        return {"rows": rows, "budget": None}

    def texts(x: Array) -> list[str]:
        return [two_digits(value) for value in x * factors]

    worst = np.argmax(U, axis=0)
    at = worst, np.arange(len(worst))
    entries = [
        {"source": one.name, "of": SOURCES[one.name], "type": one.kind, "u": one.u[at], "shown": texts(one.u[at])}
        for one in budget.sources
    ]
    total = {"u": budget.u[at], "U": U[at], "shown_u": texts(budget.u[at]), "shown_U": texts(U[at])}
    return {"rows": rows, "budget": {"at_degC": budget.T[worst], "sources": entries, **total}}


def _within(first: tuple[float, float] | None, second: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the range that two ranges have in common; the one that is known where the other is not."""
    if first is None or second is None:
        return first or second
    low, high = max(first[0], second[0]), min(first[1], second[1])
    return (low, high) if low <= high else None
