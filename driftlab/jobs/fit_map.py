"""A thermal map fitted on recordings at rest: `driftlab fit-map`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, TypeGuard, TypeVar

import numpy as np

from driftlab.config import Config, paths_of
from driftlab.evaluation.limits import check_limits as limits_kept
from driftlab.evaluation.limits import verdict as one_line
from driftlab.evaluation.measurements import of_map
from driftlab.jobs.compare_maps import check_comparison, settings_compared
from driftlab.maps.assessment import MapVerdict, judge
from driftlab.maps.fit import axes_of, fit_gathered, gather, map_settings
from driftlab.maps.kind_selection import KindComparison
from driftlab.maps.network_size import Selection, check_selection, settings_selected
from driftlab.results import Result
from driftlab.storage.json import plain, write_json
from driftlab.storage.map_file import check_page, check_place, check_report, save, write_page
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.errors import ConfigError, Unwritable
from fusion_core.faults import Faults
from fusion_core.host.provenance import participants

if TYPE_CHECKING:
    from matplotlib.figure import Figure

F = TypeVar("F")
USUAL = "spline"  # kind of a map where neither the config nor the user names one: it bends where the sensor does


class FitMapResult(Result):
    """A fitted map, as arrays over its domain: `temperature` (N,), `bias`, `slope` and `sigma` (N, d).

    Attributes
    ----------
    map : FittedMap
        The map itself: `map.bias(T)`, `map.slope(T)`, `map.sigma(T)` at any temperatures.
    verdict : Verdict
        How good it is: sigma, misfits, what differs between up and down, coverage.
    selection : Selection or None
        How its size was chosen, if it was.
    comparison : Comparison or None
        How its kind was chosen, if it was.
    limits : list of Judged
        The config's limits, held against the map.
    kept : str
        Whether they are kept, in one line; empty where there are none.
    sensor, unit : Sensor or None, BiasUnit
        Whose map it is, and in which unit it is shown.
    written : tuple of Path
        The files that were written.
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
        self.config, self.recordings, model = config, list(recordings) or None, config.filter
        fitted, self.comparison = verdict.map, comparison
        self.map, self.verdict, self.faults, self.selection = fitted, verdict, faults, selection
        self.sensor, self.unit = None if model is None else model.tracked, tracked_unit(model)
        self.limits = limits_kept(config.limits, of_map(fitted, self.unit))
        self.kept = one_line(self.limits)
        self.written: tuple[Path, ...] = ()
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
            from driftlab.reports.map_selection import selection_document

            self.summary["selection"] = plain(selection_document(selection, self.unit))
        if comparison is not None:
            from driftlab.reports import map_selection

            self.summary["compare"] = plain(map_selection.comparison_document(comparison, self.unit))

    def lines(self) -> list[str]:
        """Return the verdict on the map, and what one should know of its recordings, a sentence each."""
        return [*self.verdict.sentences(self.unit), *self.faults.lines()]

    def plot(self) -> Figure:
        """Draw samples and curve over temperature, what the curve leaves, how sure it is and on how many samples."""
        from driftlab.reports.figures import figure_of
        from driftlab.reports.map import chart

        return figure_of(chart(self.verdict, self.unit))

    def save(self, out: str | PathLike[str], *, report: str | PathLike[str] | None = None) -> None:
        """Write the map to the file `out`, and its page; where its size was chosen, `select.json` and `select.svg` too.

        Those are beside the map, or in the folder `report`. Raises ConfigError, Unwritable or MapError.
        """
        path, folder = Path(out), None if report is None else Path(report)
        _check(path, folder, [], selected=self.selection is not None)
        self._write(path, folder)

    def _write(self, path: Path, report: Path | None) -> None:
        from driftlab.reports.map import page_of
        from driftlab.reports.provenance import map_facts, sheet_of

        save(self.map, path)
        page = _page(path, report)
        sheet = sheet_of(self.config, self.recordings, judged=self.limits, plugins=participants(self.verdict.settings))
        sheet = replace(sheet, maps=[map_facts(self.map, self.unit, path)])
        write_page(page, page_of(self.verdict, self.unit, self.faults.lines(), sheet, self.comparison))
        more = [] if self.selection is None else _write_selection(self.selection, self.unit, _stem(path, report))
        self.written = (path, page, *more)


def fit_map(
    config: Config,
    recordings: Sequence[str] = (),
    *,
    kind: str | None = None,
    neurons: range | None = None,
    compare: bool = False,
    progress: Callable[..., None] | None = None,
) -> FitMapResult:
    """Fit the map that the config names on recordings at rest; nothing is written.

    Parameters
    ----------
    config : Config
        Its source says how recordings are read; where none is named, it is the recording.
    recordings : list of `PATH`, `PATH::START:STOP`, or samples in memory (`Held`)
        Recordings at rest, Earth rate is removed.
    kind : str, optional
        Of the map, in place of the config's.
    neurons : range, optional
        Sizes of a network to choose from first.
    compare : bool
        Whether to choose among all installed kinds first, by what is left out of their fits.
    progress : callable, optional
        Called with seconds from the first row and the number of samples so far, then with texts.

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used, its temperature moves too little, or the config names no map.
    """
    faults, selection, comparison, more = Faults(), None, None, {}
    if compare:
        check_comparison(kind, neurons)
    else:
        if kind is None and not config.tracked_maps():
            kind = USUAL
            faults.note(f"kind of map: {kind}, since the config names none; --compare tells which kind predicts best")
        settings = map_settings(config, kind)
    if neurons is not None:
        check_selection(settings, neurons)
    found = gather(config, recordings, faults, progress)
    if compare:
        settings, comparison, tried = settings_compared(config, found, progress)
        more = {"comparison": tried}
    elif neurons is not None:
        settings, selection, tried = settings_selected(settings, found.T, found.bias, neurons, progress)
        more = {"selection": tried}
    fitted = fit_gathered(config, settings, found, more)
    verdict = judge(fitted, settings, found.brief(), axes_of(fitted), found.placements, found.used)
    return FitMapResult(config, recordings, verdict, faults, selection, comparison)


def fit_map_to_file(
    config: Config,
    recordings: Sequence[str] = (),
    out: Path | None = None,
    report: Path | None = None,
    *,
    kind: str | None = None,
    neurons: range | None = None,
    compare: bool = False,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
) -> FitMapResult:
    """Fit a map as `fit_map`, and write it.

    Parameters
    ----------
    out : Path, optional
        The map's file; the config's where it is left out.
    report : Path, optional
        Folder for `report.html`, `select.json` and `select.svg`; beside the map, as `MAP.report.html` and so on, where
        it is left out.
    read : collection of Path
        Files that are needed beside the config's and the recordings: none of them may be `out`.

    Raises
    ------
    ConfigError, Unwritable
        Before anything is read, if the files cannot be written; and as `fit_map`.
    """
    if compare:
        check_comparison(kind, neurons)
    named = config.tracked_maps() if compare or kind is None else [map_settings(config, kind)]
    path = out or next((settings.path for settings in named), None)
    if path is None:
        raise ConfigError("--out is missing, and the config names no path for a map of this kind; give one of the two")
    _check(path, report, [*read, *config.files_to_fit(), *paths_of(recordings)], selected=neurons is not None)
    result = fit_map(config, recordings, kind=kind, neurons=neurons, compare=compare, progress=progress)
    result._write(path, report)
    return result


def _check(path: Path, report: Path | None, read: Collection[Path], *, selected: bool) -> None:
    check_place(path, read)
    check_page(_page(path, report))
    if selected:
        check_report(_stem(path, report))


def _page(path: Path, report: Path | None) -> Path:
    """Return the place of the page: in the folder, or beside the map under its name."""
    return path.with_name(f"{path.stem}.report.html") if report is None else report / "report.html"


def _stem(path: Path, report: Path | None) -> Path:
    """Return what the files of the selection are called: in the folder, or beside the map under its name."""
    return path.with_name(f"{path.stem}.select") if report is None else report / "select"


def _write_selection(found: Selection, unit: BiasUnit, stem: Path) -> list[Path]:
    """Write select.json and select.svg."""
    from driftlab.reports.figures import svg
    from driftlab.reports.map_selection import figure, selection_document

    names = [stem.with_name(stem.name + end) for end in (".json", ".svg")]
    try:
        write_json(names[0], selection_document(found, unit))
        names[1].write_text(svg(figure(found, unit)), encoding="utf-8")
    except OSError as error:
        raise Unwritable(f"{names[0]}: cannot be written ({error.strerror}); name a folder that can be") from None
    return names


def with_family(family: F | None, lot: str | None, *, more: bool) -> TypeGuard[F]:
    """Whether a family is asked for; raises ConfigError where something else is asked for that it does not give."""
    if family is None and lot is not None:
        raise ConfigError("--lot: is of a unit that has a family; name its family.json with --family")
    if family is not None and more:
        raise ConfigError(
            "--family: gives a spline over the family's range, and no page; leave --kind, --select, --compare and "
            "--report out"
        )
    return family is not None
