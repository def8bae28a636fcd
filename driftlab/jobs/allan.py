"""Allan deviation of a recording at rest: `driftlab allan`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

from driftlab.allan.deviation import Analysis, analyse
from driftlab.config import Config
from driftlab.files.estimates import write_json
from driftlab.files.folders import output_folder
from fusion_core.faults import Faults


def allan(
    config: Config,
    out: Path | None = None,
    *,
    progress: Callable[[float, int], None] | None = None,
    read: Collection[Path] = (),
) -> Analysis:
    """Return the curves and coefficients of the config's recording; with `out`, write them into that folder too.

    Parameters
    ----------
    config : Config
        With the recording as its source.
    out : Path, optional
        Folder for `allan.json`, `summary.json`, `allan.svg` and `report.html`; it appears when all files are whole.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far.
    read : collection of Path
        Files that are needed beside the config's: none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If the recording cannot be used, or `out` must not be replaced.
    """
    if out is None:
        return _analysed(config, progress)
    with output_folder(out, "allan", [*read, *config.files()]) as folder:
        found = _analysed(config, progress)
        write_allan(folder, found)
    return found


def write_allan(folder: Path, found: Analysis) -> None:
    """Write the files of an analysis into a folder."""
    from driftlab.reports.allan import write_results

    write_results(folder, found, write_json)


def _analysed(config: Config, progress: Callable[[float, int], None] | None) -> Analysis:
    faults = Faults()
    found = analyse(config, faults, progress)
    found.notes[:0] = faults.lines()
    return found
