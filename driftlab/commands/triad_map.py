"""The map of a triad with scale factor, misalignment and g-sensitivity, by a stimulus: `driftlab fit-map --terms`."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from os.path import relpath
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from driftlab.commands.console import print_verdict, say, say_lines, terminal
from driftlab.commands.family_map import family_of
from driftlab.commands.result import Result
from driftlab.config import Config, paths_of
from driftlab.evaluation.limits import check_limits
from driftlab.evaluation.limits import verdict as verdict_line
from driftlab.evaluation.measurements import of_map
from driftlab.family.terms import TermsLaw
from driftlab.filtering.setup import check_map
from driftlab.maps.fit import USUAL, map_settings, of_sensor, provenance
from driftlab.maps.network_size import Selection
from driftlab.reports import triad as words
from driftlab.reports.certificate import FILES as CERTIFICATE
from driftlab.reports.certificate import Certificate
from driftlab.reports.charts import Chart
from driftlab.reports.provenance import Sheet, map_facts, sheet_of
from driftlab.storage.json import plain
from driftlab.storage.map_file import check_all, save, write_beside
from driftlab.triad.consistency import contradictions, excess, unsteady
from driftlab.triad.estimate import TriadFit
from driftlab.triad.fit import fit_triad
from driftlab.triad.model import BIAS, GROUPS, SENSITIVITIES, TERMS
from driftlab.triad.samples import Gathered, stimulus_of
from driftlab.units import tracked_unit
from fusion_core.chunk import Flags
from fusion_core.contracts import FittedMap, MapRecord, Stimulus, ThermalBias, ThermalMap
from fusion_core.errors import ConfigError, MapError, quote
from fusion_core.faults import DOUBT, Faults, in_doubt
from fusion_core.host.provenance import Participant
from fusion_core.host.registry import registry
from fusion_core.thermal.record_texts import recorded

ASKED = {**GROUPS, "g_sensitivity": [len(TERMS) + j for j in range(len(SENSITIVITIES))]}
USUAL_BIAS = {"rad/s": np.deg2rad(1.0), "m/s^2": 0.5}  # of a unit of which nothing is known
POINTS = 400  # temperatures of the curve
COMMAND = "fit-map"  # by which its files are known


class MapResult(Result):
    """A fitted map of a sensor, held against the limits of its config; subclasses say what stands on its page.

    Attributes
    ----------
    map : FittedMap
    recordings : list of str or None
        Those that were given; None: the config's own.
    limits : list of LimitResult
        The config's limits, held against the map.
    sensor, unit : Sensor or None, BiasUnit
        Whose map it is, and in which unit it is shown.
    selection : Selection or None
        How its size was chosen, if it was.
    plugins : list of dict, or None
        Those that took part; None: those of the config.
    written : tuple of Path
        The files that were written.
    """

    selection: Selection | None = None
    plugins: list[Participant] | None = None

    def __init__(self, config: Config, recordings: Sequence[str], fitted: FittedMap, faults: Faults) -> None:
        self.config, self.recordings, self.map, self.faults = config, list(recordings) or None, fitted, faults
        self.sensor, self.unit = None if config.filter is None else config.filter.tracked, tracked_unit(config.filter)
        self.measured = of_map(fitted, self.unit)
        self.limits = check_limits(config.limits, self.measured, faults.doubts)
        self.limits_verdict = verdict_line(self.limits)
        self.written: tuple[Path, ...] = ()

    def line_for(self, config: Config) -> str:
        """Return the line of a config by which its filter takes the map that was written, by where it has maps."""
        assert self.sensor is not None, "it is of a sensor"
        kind, path = self.map.record.kind, relpath(self.written[0], config.file and config.file.parent)
        place = f"{self.sensor.section}.{'bias.map' if isinstance(self.sensor.bias, ThermalBias) else 'calibration'}"
        there = any(settings.kind == kind for settings in config.tracked_maps())  # with its order or interval
        return f"{place}.path: {path}" if there else f"{place}: {{kind: {kind}, path: {path}}}"

    @abstractmethod
    def _texts(self, sheet: Sheet) -> list[str]:
        """Return the texts of the files beside the map, in the order of `names_beside`, but for a certificate's."""

    @abstractmethod
    def _certificate(self, sheet: Sheet) -> Certificate:
        """Return the certificate of the map."""

    def save(
        self, out: str | PathLike[str], *, report: str | PathLike[str] | None = None, certificate: bool = False
    ) -> None:
        """Write the map to the file `out`, and its page; where its size was chosen, `select.json` and `select.svg` too.

        Those, and a `certificate` where it is asked for, are beside the map, or in the folder `report`. Raises
        ConfigError, Unwritable or MapError.
        """
        path, folder = Path(out), None if report is None else Path(report)
        names = names_beside(selected=self.selection is not None, certificate=certificate)
        check_all(path, folder, [], names, COMMAND)
        save(self.map, path, COMMAND)
        sheet = sheet_of(self.config, self.recordings, judged=self.limits, plugins=self.plugins)
        sheet = replace(sheet, maps=[map_facts(self.map, self.unit, path)])
        texts = self._texts(sheet)
        if certificate:
            signed = self._certificate(sheet)
            texts += [signed.page(), signed.text()]
        written = dict(zip(names, texts, strict=True))  # a certificate of an earlier map is not of this one
        self.written = (path, *write_beside(path, folder, written, COMMAND, CERTIFICATE))


def names_beside(*, selected: bool = False, certificate: bool = False) -> list[str]:
    """Return the names of the page, of the files on a chosen size, and of the certificate."""
    return ["report.html", *["select.json", "select.svg"] * selected, *(CERTIFICATE if certificate else ())]


class TriadMapResult(MapResult):
    """The terms of a triad over `temperature` (N,): `terms` and `sigma` (N, 12), the bias, then M row by row.

    With g-sensitivity (N, 21), G row by row after them.

    Attributes
    ----------
    map : FittedMap
        `map.corrected(reading, T)` gives the input (N, 3), `map.bias(T)` the bias; with g-sensitivity
        `map.corrected(reading, T, force=f)`.
    fit : TriadFit
        Terms with their joint covariance, which of them are not observable is in `lines()`.
    """

    def __init__(
        self,
        config: Config,
        recordings: Sequence[str],
        gathered: Gathered,
        fit: TriadFit,
        fitted: FittedMap,
        faults: Faults,
        law: TermsLaw | None = None,
    ) -> None:
        super().__init__(config, recordings, fitted, faults)
        self.law, self.fit, self.rows = law, fit, gathered.rows
        self._doubts, self._untested = in_doubt(faults.doubts), words.untested_lines(fit)
        self.name = f"map of the {gathered.sensor.channel}, with scale factor and misalignment"
        T = np.linspace(*fitted.domain, POINTS)
        inside = np.clip(T, fit.grid[0], fit.grid[-1])
        self._columns = {"temperature": T, "terms": fit.terms.at(inside), "sigma": fit.sigma(inside)}
        each = tuple(words.si_unit_of(j, self.unit) for j in range(len(fit.names)))
        self.units = {"temperature": "degC", "terms": each, "sigma": each}
        self.labels = dict.fromkeys(("terms", "sigma"), tuple(name.replace(" ", "_") for name in fit.names))
        self.summary = fitted.record.model_dump(mode="json", exclude={"error", "matrix", "sensitivity"}) | {
            "triad": plain(words.as_json(fit, self.unit, [*self._doubts, *self._untested])),
            "serial": config.serial,
            "limits": plain([row.as_json(self.unit) for row in self.limits]),
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return the frame, what is not observable, and the notes on the recordings."""
        return [*self.verdict(), *self.faults.lines(doubts=False)]

    def verdict(self) -> list[str]:
        """Return doubts, frame, how far levels differ, family, what is not tested or observable, a sentence each."""
        of_family = [] if self.law is None else [words.family_line(self.fit, self.law.units)]
        levels, hidden = words.level_lines(self.fit, self.unit), words.verdict(self.fit)
        return [*self._doubts, words.frame_line(self.fit), *levels, *of_family, *self._untested, *hidden]

    def _chart(self) -> Chart:
        return words.chart(self.fit)

    def _texts(self, sheet: Sheet) -> list[str]:
        recordings = self.map.record.provenance.get("recordings", "") or "samples in memory"
        lead = f"{len(self.fit.stimulus.T)} segments or placements in {self.rows:,} samples of {recordings}"
        notes, channel = [*self._untested, *self.faults.lines(doubts=False)], self.map.record.channel
        return [words.page_of(self.fit, self.unit, channel, lead, self._doubts, notes, sheet)]

    def _certificate(self, sheet: Sheet) -> Certificate:
        none, T = {"residual", "hysteresis"}, self.fit.domain  # of a soak
        measured = {name: one for name, one in self.measured.items() if not (self.fit.has_bias and name in none)}
        return Certificate(
            COMMAND, self.config, sheet, self.limits, measured, self.map, domain=T, fit=self.fit,
            levelled=self.fit.has_bias,
            remarks=[*self._doubts, *self._untested, *words.verdict(self.fit)],
        )  # fmt: skip


def fit_triad_map(
    config: Config,
    recordings: Sequence[str],
    terms: str,
    stimulus: str | None,
    kind: str | None,
    out: Path | None,
    report: Path | None = None,
    *,
    certificate: bool = False,
    family: Path | None = None,
) -> TriadMapResult:
    """Return the map of a triad that a stimulus gives; with `out`, write it there, and its page beside or in `report`.

    Parameters
    ----------
    terms : str
        Of `bias`, `scale`, `misalignment`, `g_sensitivity`, with commas. Without bias, that stays the config's map's.
    stimulus : str, optional
        Kind of the stimulus, instead of the config's.
    kind : str, optional
        Kind of the curves, instead of the config's; else spline.
    family : Path, optional
        `family.json` of a fleet whose units had a stimulus; M is over its range then.

    Raises
    ------
    ConfigError, DataError, MapError
        If a recording does not hold the stimulus, or the config's map is of another sensor.
    """
    names = names_of_terms(terms, ASKED)
    own, faults = _with_stimulus(config, stimulus), Faults()
    settings = map_settings(own, kind if kind or own.tracked_maps() else USUAL)
    if out is not None:
        read = [*(own.files_to_fit() if "bias" in names else own.files()), *([] if family is None else [family])]
        check_all(out, report, [*read, *paths_of(recordings)], names_beside(certificate=certificate), COMMAND)
    if "g_sensitivity" in names and "bias" not in names:
        raise ConfigError(
            "--terms: g_sensitivity without bias is of no use, since the bias of a soak has its part of it; add bias"
        )
    law = None if family is None else _law_of(family, own, names)
    known = None if "bias" in names else _known_bias(own)
    if "g_sensitivity" in names and own.filter is not None and own.filter.tracked.channel != "gyro":
        raise ConfigError(f"--terms g_sensitivity: is a gyro's, not one of {own.filter.tracked.channel}; leave it out")
    gathered = stimulus_of(own, recordings, faults)
    walk, size = (gathered.sensor.bias.as_random_walk() or {}).get("walk"), USUAL_BIAS.get(gathered.sensor.unit, 1.0)
    fit = fit_triad(
        gathered.stimulus, settings, size, _wanted(names),
        None if walk is None else float(np.max(walk)), None if law is None else law.prior(),
    )  # fmt: skip
    for text in [*contradictions(gathered.stimulus, size), *unsteady(fit, gathered.sensor.unit)] or excess(fit)[0]:
        faults.doubt(text)
    fit = fit if known is None else fit.without_bias()
    fitted = _map_of(own, gathered, fit, settings, known, recordings, faults.doubts)
    result = TriadMapResult(own, recordings, gathered, fit, fitted, faults, law)
    if out is not None:
        result.save(out, report=report, certificate=certificate)
    return result


def _wanted(names: Collection[str]) -> Flags:
    """Return the terms (12 or 21,) of some groups, and the bias."""
    wanted = np.zeros(len(TERMS) + len(SENSITIVITIES) * ("g_sensitivity" in names), dtype=bool)
    for name in ("bias", *names):
        wanted[ASKED[name]] = True
    return wanted


def names_of_terms(terms: str, known: Collection[str] = GROUPS) -> list[str]:
    """Return the groups of terms that an option names; raises ConfigError where one is not known."""
    names = [name.strip() for name in terms.split(",")]
    if unknown := [name for name in names if name not in known]:
        raise ConfigError(f"--terms {quote(terms)}: '{quote(unknown[0])}' is none of {', '.join(known)}; name those")
    return names


def _with_stimulus(config: Config, kind: str | None) -> Config:
    if kind is None or (config.stimulus is not None and config.stimulus.kind == kind):
        return config
    known = registry().classes(Stimulus)
    if kind not in known:
        raise ConfigError(f"--stimulus {quote(kind)}: is none of {', '.join(known)}; name one of them")
    return config.model_copy(update={"stimulus": known[kind].model_validate({})})


def _law_of(family: Path, config: Config, names: Collection[str]) -> TermsLaw:
    """Return the law of the terms that a family has; raises ConfigError or MapError where it does not go with them."""
    if set(names) != {"scale", "misalignment"} or config.filter is None:
        raise ConfigError(
            "--family with --terms: tells scale and misalignment over its range, where a short stimulus does not tell "
            "the bias; give --terms scale,misalignment, and name a map of the bias in the config (fit-map --family)"
        )
    law = family_of(config, family).terms
    if law is None:
        raise ConfigError(
            f"--family {family}: has no terms of scale and misalignment; name one of which five units or more had "
            "recordings of the role stimulus over temperature"
        )
    return law


def _known_bias(config: Config) -> FittedMap:
    """Return the map of the bias that the config names; raises ConfigError or MapError."""
    settings = next((own for own in config.tracked_maps() if own.has_map), None)
    if settings is None or config.filter is None:
        raise ConfigError(
            "--terms: without bias it is taken from the config's map, and the config names none; add bias, or a map"
        )
    known = settings.load()
    check_map(known, config.filter.tracked)
    return known


def _map_of(
    config: Config,
    gathered: Gathered,
    fit: TriadFit,
    settings: ThermalMap,
    known: FittedMap | None,
    recordings: Sequence[str],
    doubts: Sequence[str],
) -> FittedMap:
    """Return the map: the bias of the fit, or one that is known, and the matrix."""
    try:
        parts = {"matrix": fit.matrix(), "sensitivity": fit.sensitivity()}
    except ValidationError as error:
        raise MapError(
            f"the fit gives no map: {error.errors()[0]['msg']}; "
            f"{doubts[0] if doubts else 'check the units of the config against the stimulus'}"
        ) from None
    doubt = {DOUBT: doubts[0]} if doubts else {}
    if known is not None:
        return known.noting(**parts, provenance=recorded({**known.record.provenance, **doubt}))
    about = {**provenance(settings, recordings or [config.recording]), **doubt}
    T = np.linspace(fit.grid[0], fit.grid[-1], POINTS)
    record = MapRecord(
        kind=settings.kind, domain=(float(T[0]), float(T[-1])), channel=gathered.sensor.channel,
        unit=gathered.sensor.unit, residual=(fit.noise[0],) * 3, samples=gathered.rows,
        error=fit.curve_error(slice(0, 3)), provenance=recorded(about), **parts,
    )  # fmt: skip
    fitted = settings.from_curve(T, fit.terms.at(T)[:, :3], record)
    return of_sensor(config, replace(fitted, record=fitted.record))


def show_triad_map(result: TriadMapResult, given: Mapping[str, Any]) -> None:
    """Print the terms, what is not observable, and where the map was written."""
    terminal().print(words.table(result.fit, result.unit))
    say_lines(result.verdict())
    print_verdict(result.limits_verdict, "limits: ")
    say_lines((row.line(result.unit) for row in result.limits), "  ")
    say_lines(result.faults.lines(doubts=False), "note: ")
    say(f"written to {', '.join(map(str, result.written))}\n")
    if not np.any(result.fit.observable[len(BIAS) :]):
        say("no term of scale factor and misalignment is known: the map is of no use\n")
        return
    say(f"to use it, write in the config: {result.line_for(given['config'])}\n")
