"""A thermal map fitted on recordings at rest: `driftlab fit-map`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from driftlab.config import Config, part_of
from driftlab.files.estimates import write_json
from driftlab.files.map_file import check_place, check_report, save
from driftlab.maps.fit import fit_map as fit
from driftlab.maps.fit import map_settings
from driftlab.maps.network_size import Selection, fit_selected
from fusion_core.contracts import FittedMap
from fusion_core.errors import ConfigError, Unwritable
from fusion_core.faults import Faults


@dataclass(frozen=True)
class Fitted:
    """What a fit leaves: the map, what was wrong with the recordings, and how its size was chosen, if it was."""

    map: FittedMap
    faults: Faults
    selection: Selection | None = None


def fit_map(
    config: Config,
    recordings: Sequence[str] = (),
    *,
    kind: str | None = None,
    neurons: range | None = None,
    progress: Callable[..., None] | None = None,
) -> Fitted:
    """Fit the map that the config names on recordings at rest; nothing is written.

    Parameters
    ----------
    config : Config
        Its source says how recordings are read; where none is named, it is the recording.
    recordings : list of `PATH` or `PATH::START:STOP`
        Recordings at rest, Earth rate is removed.
    kind : str, optional
        Of the map, in place of the config's.
    neurons : range, optional
        Sizes of a network to choose from first.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far, then with texts.

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used, its temperature moves too little, or the config names no map.
    """
    faults = Faults()
    if neurons is None:
        return Fitted(fit(config, recordings, kind, faults, progress), faults)
    fitted, selection = fit_selected(config, recordings, kind, neurons, faults, progress)
    return Fitted(fitted, faults, selection)


def fit_map_to_file(
    config: Config,
    recordings: Sequence[str] = (),
    out: Path | None = None,
    *,
    kind: str | None = None,
    neurons: range | None = None,
    report: Path | None = None,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
) -> tuple[Fitted, list[Path]]:
    """Fit a map as `fit_map`, write it, and return it with the names of the files that were written.

    Parameters
    ----------
    out : Path, optional
        The map's file; the config's where it is left out.
    report : Path, optional
        Folder for `select.json` and `select.svg`; beside the map where it is left out.
    read : collection of Path
        Files that are needed beside the config's and the recordings: none of them may be `out`.

    Raises
    ------
    ConfigError, Unwritable
        Before anything is read, if the files cannot be written; and as `fit_map`.
    """
    path = out or map_settings(config, kind).path
    if path is None:
        raise ConfigError("--out is missing, and the config names no path for the map; give one of the two")
    if report is not None and neurons is None:
        raise ConfigError("--report is of the selection, and --select is missing; give both, or neither")
    own = config.model_copy(update={"filter": None}).files()
    check_place(path, [*read, *own, *(part_of(name)[0] for name in recordings)])
    if neurons is not None:
        check_report(_stem(path, report))
    fitted = fit_map(config, recordings, kind=kind, neurons=neurons, progress=progress)
    return fitted, write_map(fitted, path, report)


def write_map(fitted: Fitted, path: Path, report: Path | None = None) -> list[Path]:
    """Write the map and, where its size was chosen, why; return the names of the files."""
    save(fitted.map, path)
    return [path] if fitted.selection is None else [path, *_write_selection(fitted.selection, _stem(path, report))]


def _stem(path: Path, report: Path | None) -> Path:
    """Return what the files of the selection are called: in the folder, or beside the map under its name."""
    return path.with_name(f"{path.stem}.select") if report is None else report / "select"


def _write_selection(found: Selection, stem: Path) -> list[Path]:
    """Write select.json and select.svg."""
    from driftlab.reports.network_size import as_json, figure
    from driftlab.reports.plots import svg

    names = [stem.with_name(stem.name + end) for end in (".json", ".svg")]
    try:
        write_json(names[0], as_json(found))
        names[1].write_text(svg(figure(found)), encoding="utf-8")
    except OSError as error:
        raise Unwritable(f"{names[0]}: cannot be written ({error.strerror}); name a folder that can be") from None
    return names
