"""A thermal map fitted on recordings at rest: `driftlab fit-map`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.commands.console import print_verdict, say, say_lines, terminal
from driftlab.commands.family_map import FamilyMapResult, fit_family_map, show_family_map
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, Units, config_of, recordings_of
from driftlab.commands.triad_map import COMMAND, MapResult, TriadMapResult, fit_triad_map, names_beside, show_triad_map
from driftlab.config import Config, paths_of
from driftlab.maps.assessment import MapVerdict
from driftlab.maps.fit import GatheredSoak, axes_of, fit_gathered, gather, map_settings, usual_settings
from driftlab.maps.kind_selection import KindComparison, candidates, divide
from driftlab.maps.kind_selection import compare as compare_kinds
from driftlab.maps.network_size import Selection, check_selection, settings_selected
from driftlab.reports import map_selection
from driftlab.reports.certificate import Certificate
from driftlab.reports.charts import Chart
from driftlab.reports.figures import figure_of, svg
from driftlab.reports.map import chart, page_of
from driftlab.reports.provenance import Sheet
from driftlab.soak.blocks import means, runs
from driftlab.storage.json import plain, text_of
from driftlab.storage.map_file import check_all
from fusion_core.chunk import Array
from fusion_core.contracts import ThermalMap
from fusion_core.errors import ConfigError
from fusion_core.faults import Faults, in_doubt
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry

MAX_BLOCKS = 4096  # of all recordings, where kinds are compared


class FitMapResult(MapResult):
    """A fitted map, as arrays over its domain: `temperature` (N,), `bias`, `slope` and `sigma` (N, d).

    Attributes
    ----------
    map : FittedMap
        The map itself: `map.bias(T)`, `map.slope(T)`, `map.sigma(T)` at any temperatures.
    verdict : MapVerdict
        How good it is: sigma, misfits, what differs between up and down, coverage.
    comparison : KindComparison or None
        How its kind was chosen, if it was.
    """

    def __init__(
        self,
        config: Config,
        recordings: Sequence[str],
        verdict: MapVerdict,
        faults: Faults,
        selection: Selection | None = None,
        comparison: KindComparison | None = None,
    ) -> None:
        super().__init__(config, recordings, fitted := verdict.map, faults)
        self.verdict, self.selection, self.comparison = verdict, selection, comparison
        self.plugins = participants(verdict.settings)
        record, T = fitted.record, np.linspace(*fitted.domain, 400)
        self.name = f"map {record.kind} of the {record.channel}"
        self._columns = {"temperature": T, "bias": fitted.bias(T), "slope": fitted.slope(T), "sigma": fitted.sigma(T)}
        self.units = {"temperature": "degC", "bias": record.unit, "slope": f"{record.unit}/K", "sigma": record.unit}
        self.labels = dict.fromkeys(("bias", "slope", "sigma"), axes_of(fitted))
        self.summary = record.model_dump(mode="json") | {
            "verdict": verdict.sentences(self.unit),
            "judged": plain(verdict.as_json()),
            "serial": config.serial,
            "limits": plain([row.as_json(self.unit) for row in self.limits]),
        }
        if selection is not None:
            self.summary["selection"] = plain(map_selection.selection_document(selection, self.unit))
        if comparison is not None:
            self.summary["compare"] = plain(map_selection.comparison_document(comparison, self.unit))

    def lines(self) -> list[str]:
        """Return the verdict on the map, and the notes on its recordings, a sentence each."""
        return [*self.verdict.sentences(self.unit), *self.faults.lines(doubts=False)]

    def _chart(self) -> Chart:
        """Return samples and curve over temperature, the residuals, how sure it is and on how many samples."""
        return chart(self.verdict, self.unit)

    def _texts(self, sheet: Sheet) -> list[str]:
        page = page_of(self.verdict, self.unit, self.faults.lines(doubts=False), sheet, self.comparison)
        if self.selection is None:
            return [page]
        drawn = figure_of(map_selection.chart(self.selection, self.unit))
        return [page, text_of(map_selection.selection_document(self.selection, self.unit)), svg(drawn)]

    def _certificate(self, sheet: Sheet) -> Certificate:
        verdict, paths = self.verdict, [str(one["name"]).partition("::")[0] for one in sheet.recordings]
        soak = verdict.soak if len(set(paths)) == len(paths) else None  # parts of one recording are no power-ups
        remarks = in_doubt(verdict.doubts)
        remarks += filter(None, [verdict.used.sentence() if verdict.used else None])
        return Certificate(
            COMMAND, self.config, sheet, self.limits, self.measured, self.map, soak, verdict.placements,
            self.map.record.lasted, remarks=remarks,
        )  # fmt: skip


def fit_map(
    config: ConfigLike,
    data: DataLike = None,
    *,
    units: Units | None = None,
    kind: str | None = None,
    out: Place | None = None,
    neurons: range | None = None,
    compare: bool = False,
    channel: str | None = None,
    report: Place | None = None,
    family: Place | None = None,
    lot: str | None = None,
    certificate: bool = False,
    terms: str | None = None,
    stimulus: str | None = None,
    progress: Progress | None = None,
) -> FitMapResult | FamilyMapResult | TriadMapResult:
    """Fit a thermal map on a soak at rest, and say how good it is.

    Writes the map's file, and a page beside it.

    Parameters
    ----------
    config : as that of `run`
        Its source says how recordings are read; where no data are given, it is the recording.
    data : as that of `run`, or a list of them
        A recording; may be repeated.
        The soak. Earth rate is removed.
    units : as that of `run`
    kind : str, optional
        Kind of map, instead of the config's; else spline.
    out : path, optional
        Its file, instead of the config's; else CONFIG.map.json.
        A program writes nothing where it is left out, also if the config names a path.
    neurons : range, optional
        Sizes of a network to choose from first, as `--select`.
    compare : bool
        Choose among all installed kinds first, by what is left out of their fits.
    channel : str, optional
        Sensor whose bias it is about, e.g. accel; default: the config's.
    report : path, optional
        Folder for report.html and what --select shows; default: beside the map.
        It needs `out`.
    family : path, optional
        Of a fleet: then a part of the range is soak or stimulus enough.
        Its `family.json`.
    lot : str, optional
        Of the unit, where --family knows lots.
    certificate : bool
        Write a certificate too: one sheet with results, uncertainty and limits.
        Beside the map or in `report`, as certificate.html and certificate.json; it needs `out`.
    terms : str, optional
        Terms to fit by a stimulus: bias,scale,misalignment,g_sensitivity.
        Without bias, that stays as the config's map has it.
    stimulus : str, optional
        Stimulus of --terms: rate_table, positions, tumble or a plugin's; default: the config's.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far, then with texts.

    Returns
    -------
    FitMapResult
        `temperature` (N,), `bias`, `slope`, `sigma` (N, d) over the map's domain; `map` is the map itself.
    FamilyMapResult
        With `family`: `temperature` (N,), `bias`, `sigma`, `own_bias`, `own_sigma` (N, d) over the family's domain.
    TriadMapResult
        With `terms`: `temperature` (N,), `terms`, `sigma` (N, 12 or 21); `map.corrected(reading, T)` gives the input.

    Raises
    ------
    DataError, ConfigError, UnitError
        If a recording cannot be used, its temperature moves too little, or the config names no map.
    MapError
        If the family is of another sensor.
    Unwritable
        Before anything is read, if the files cannot be written.
    """
    understood = config_of(config).tracking(channel)
    recordings = [] if data is None else recordings_of(data, units, "data")
    place, folder, known = (None if path is None else Path(path) for path in (out, report, family))
    _check_family(known, lot, terms is None and bool(kind or neurons or compare or report or certificate))
    if certificate and place is None:
        raise ConfigError("--certificate: is a file beside the map; give --out, the map's file")
    if _asks_for_triad(terms, stimulus, bool(neurons or compare or lot)):
        return fit_triad_map(
            understood, recordings, str(terms), stimulus, kind, place, folder, certificate=certificate, family=known
        )
    if known is not None:
        return fit_family_map(understood, recordings, known, lot or "", place, progress)
    for option, value in (("--kind", kind), ("--select", neurons)):
        if compare and value is not None:
            raise ConfigError(f"--compare: tries all kinds, and {option} asks for one; give one of the two")
    if place is not None:
        read = [*understood.files_to_fit(), *paths_of(recordings)]
        check_all(place, folder, read, names_beside(selected=neurons is not None, certificate=certificate), COMMAND)
    result = _fitted(understood, recordings, kind, neurons, compare, progress)
    if place is not None:
        result.save(place, report=folder, certificate=certificate)
    return result


def _fitted(
    config: Config,
    recordings: Sequence[str],
    kind: str | None,
    neurons: range | None,
    compare: bool,
    progress: Progress | None,
) -> FitMapResult:
    faults, selection, comparison, more = Faults(), None, None, {}
    if not compare:
        settings = usual_settings(config, faults) if kind is None else map_settings(config, kind)
    if neurons is not None:
        check_selection(settings, neurons)
    soak = gather(config, recordings, faults, progress)
    if compare:
        settings, comparison, tried = _compared(config, soak, progress)
        more = {"comparison": tried}
    elif neurons is not None:
        settings, selection, tried = settings_selected(settings, soak.T, soak.of_both_ways, neurons, progress)
        more = {"selection": tried}
    fitted = fit_gathered(config, settings, soak, more, of_both_ways=True)
    known = soak.placements, soak.used, faults.doubts, soak.memory, comparison is not None
    verdict = MapVerdict(fitted, settings, soak.summary, *known)
    return FitMapResult(config, recordings, verdict, faults, selection, comparison)


def _compared(config: Config, soak: GatheredSoak, progress: Progress | None) -> tuple[ThermalMap, KindComparison, str]:
    """Return the settings that the samples ask for among all installed kinds, the comparison, and a map's note on it.

    Raises
    ------
    ConfigError
        If no kind can be fitted.
    """
    T, bias = _blocks(soak)

    def report(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} maps fitted")

    tried = candidates(config.tracked_maps(), registry().classes(ThermalMap).values())
    comparison = compare_kinds(tried, np.concatenate(T), np.concatenate(bias), divide(T), report)
    settings = comparison.chosen.settings
    assert settings is not None
    return settings, comparison, f"{comparison.chosen.name}, of {len(tried)} kinds and sizes"


def _blocks(soak: GatheredSoak) -> tuple[list[Array], list[Array]]:
    """Return T (K_r,) and bias (K_r, d) of each recording's blocks, all of about the same number of samples.

    The coldest and the warmest block stand at the lowest and the highest temperature of the recording.
    """
    n = 2 ** max(int(np.ceil(np.log2(len(soak.T) / MAX_BLOCKS))), 0)
    T, bias = [], []
    for start, stop in pairwise([*soak.starts, len(soak.T)]):
        own_T, cuts = soak.T[start:stop], runs([0], stop - start, n)
        T.append(means(own_T, cuts))
        bias.append(means(soak.of_both_ways[start:stop], cuts))
        if len(cuts) > 1:
            T[-1][[np.argmin(T[-1]), np.argmax(T[-1])]] = np.min(own_T), np.max(own_T)
    return T, bias


def _check_family(family: Place | None, lot: str | None, more: bool) -> None:
    """Raise ConfigError where something is asked for that a family does not give, or a lot of none."""
    if family is None and lot is not None:
        raise ConfigError("--lot: is of a unit that has a family; name its family.json with --family")
    if family is not None and more:
        gives = "gives a spline over the family's range, and no page"
        raise ConfigError(f"--family: {gives}; leave --kind, --select, --compare, --report and --certificate out")


def _asks_for_triad(terms: str | None, stimulus: str | None, others: bool) -> bool:
    """Return True where a triad's terms are asked for; raises ConfigError where an option does not go with them."""
    if terms is None and stimulus is not None:
        raise ConfigError("--stimulus: is that of --terms; say which to fit, e.g. --terms bias,scale,misalignment")
    if terms is not None and others:
        raise ConfigError("--terms: tries the curves of one kind, of no lot; leave --select, --compare and --lot out")
    return terms is not None


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Say which sizes are tried, and where the map is written: where the config says, or beside the config."""
    config, kind, compare = arguments["config"], arguments.get("kind"), arguments["compare"]
    more = any(
        (kind, arguments.get("report"), compare, options["select"], options["enforce_limits"], arguments["certificate"])
    )
    out = arguments.get("out")
    _check_family(arguments.get("family"), arguments.get("lot"), more and not arguments.get("terms"))
    if arguments.get("family") is None:
        if options["select"]:
            arguments["neurons"] = range(1, options["neurons_max"] + 1)
        named = config.tracked_maps() if compare or kind is None else [map_settings(config, kind)]
        out = out or next((settings.path for settings in named), None)
        if out is None and _names_a_path(config):
            raise ConfigError(
                "--out is missing, and the config names no path for a map of this kind; give one of the two"
            )
    usual = ".".join(filter(None, (config.file.stem, arguments.get("channel"), "map.json")))
    return {**arguments, "out": out or config.file.with_name(usual)}


def _names_a_path(config: Config) -> bool:
    return any(settings.path for settings in config.tracked_maps())


def show(result: FitMapResult | FamilyMapResult | TriadMapResult, given: Mapping[str, Any]) -> None:
    """Print the choice of size or kind, the map, and where it was written."""
    if isinstance(result, FamilyMapResult):
        show_family_map(result)
        return
    if isinstance(result, TriadMapResult):
        show_triad_map(result, given)
        return
    unit, axes = result.unit, result.verdict.axes
    if (selection := result.selection) is not None:
        terminal().print(map_selection.selection_table(selection, unit))
        say_lines(map_selection.comparison(selection, unit))
    if (choice := result.comparison) is not None:
        terminal().print(map_selection.comparison_table(choice, unit, axes))
        say_lines([*map_selection.verdict(choice, unit, axes), *map_selection.failures(choice)])
        say(f"in the config: {map_selection.config_line(choice, result.written[0])}\n\n")
    _print_map(result)
    say(f"written to {', '.join(map(str, result.written))}\n")
    if result.sensor is not None and not _names_a_path(result.config) and result.comparison is None:
        say(f"to use it, write in the config: {result.line_for(given['config'])}\n")


def _print_map(fitted: FitMapResult) -> None:
    record = fitted.map.record
    low, high = record.domain
    say(f"{record.kind}: fitted on {record.samples:,} samples from {low:.2f} to {high:.2f} °C\n")
    unit, factor, spec = fitted.unit.columns[0]
    white = [f"{v * factor:{spec}} {unit}" for v in fitted.verdict.soak.white]
    for axis, residual, alone in zip(fitted.verdict.axes, record.residual or (), white, strict=False):
        widths = zip(fitted.unit.columns, ("10", ""), strict=False)
        texts = [f"{residual * factor:{width}{spec}} {unit}" for (unit, factor, spec), width in widths]
        say(f"  residual {axis}: {'  '.join(texts)} (rms of the samples; white noise alone {alone})\n")
    say_lines(fitted.verdict.sentences(fitted.unit))
    print_verdict(fitted.limits_verdict, "limits: ")
    say_lines((row.line(fitted.unit) for row in fitted.limits), "  ")
    say_lines(fitted.faults.lines(doubts=False), "note: ")
