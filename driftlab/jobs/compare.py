"""Several configs on one recording: `driftlab compare`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftlab.config import Config
from driftlab.files.estimates import write_json
from driftlab.files.folders import output_folder
from driftlab.judging.compare import Comparison, as_json
from driftlab.judging.compare import compare as compare_all
from fusion_core.errors import ConfigError


@dataclass(frozen=True)
class Compared:
    """What a comparison leaves: each config's, by name, and the content of `summary.json`."""

    found: dict[str, Comparison]
    summary: dict[str, Any]


def compare(
    configs: Mapping[str, Config],
    out: Path | None = None,
    *,
    progress: Callable[[str], None] | None = None,
    read: Collection[Path] = (),
) -> Compared:
    """Run every config on the recording that they share; with `out`, write the comparison into that folder too.

    Parameters
    ----------
    configs : mapping of str to Config
        By the names that they have in tables; with the same recording as their source.
    out : Path, optional
        Folder for `summary.json` and `report.html`; it appears when both are whole.
    progress : callable, optional
        Called with what is being done.
    read : collection of Path
        Files that are needed beside the configs': none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If a config cannot be run on the recording, the recordings differ, or `out` must not be replaced.
    """
    recording = _shared_recording(configs)
    if out is None:
        return _compared(configs, recording, progress)
    used = [*read, *(path for config in configs.values() for path in config.files())]
    with output_folder(out, "compare", used) as folder:
        done = _compared(configs, recording, progress)
        write_compared(folder, done)
    return done


def write_compared(folder: Path, done: Compared) -> None:
    """Write the files of a comparison into a folder."""
    from driftlab.reports.compare import write_comparison

    write_json(folder / "summary.json", done.summary)
    write_comparison(folder / "report.html", done.found, done.summary["recording"])


def _shared_recording(configs: Mapping[str, Config]) -> str:
    sources = {config.source.name for config in configs.values() if config.source is not None}
    if len(sources) != 1:
        raise ConfigError(
            f"the configs read different recordings ({', '.join(sorted(sources))}); give one with --input"
        )
    return sources.pop()


def _compared(configs: Mapping[str, Config], recording: str, progress: Callable[[str], None] | None) -> Compared:
    found = compare_all(dict(configs), progress)
    return Compared(found, as_json(found, recording))
