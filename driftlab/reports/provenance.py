"""The provenance of a page: the things that its numbers stand on, the part that is signed for.

Serial number and date of the unit, the config and its hash, the recordings and theirs, the versions that computed, the
map that was used. A template prints it by the macros of `pages/sheet.html`: `head` at the top of a page, `whole` at
its end, `limits` for the verdicts, `signatures` for paper.
"""

from __future__ import annotations

import hashlib
import platform
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import Config, paths_of, with_recording
from driftlab.evaluation.limits import RULE, LimitResult, outcome, verdict
from driftlab.recordings.identity import identity, of_source, sha256
from driftlab.storage.recorder import started_at
from driftlab.units import YEARS, BiasUnit, tracked_unit
from fusion_core.contracts import FileSource, FittedMap, Source
from fusion_core.errors import FusionError
from fusion_core.faults import Faults
from fusion_core.host.provenance import Participant, participants

LIBRARIES = ("numpy", "scipy", "numba", "h5py", "polars", "onnxruntime")  # whose code the numbers went through
FIRST = 100  # rows, of which one says when it was


@dataclass(frozen=True)
class Sheet:
    """The things that a page stands on.

    Attributes
    ----------
    serial : str
        Of the unit; empty where the config has none.
    date : str
        `2026-11-22`, of the recording where that is known, else of the page.
    dated : str
        Of which of the two: `recorded` or `page`.
    config, config_sha256 : str
        Its name, and the hash of the YAML as it is understood (`driftlab check CONFIG`).
    recordings : list of dict
        `name`, `bytes` and `sha256`; of what is not kept (a device, standard input) the name alone.
    versions : dict of str to str
        Of driftlab, Python and the libraries.
    plugins : list of dict
        Those that take part.
    maps : list of dict
        `kind`, `channel`, `file`, `sha256`, `fitted_on`, `fitted_at`, `residual` and `domain` as texts.
    limits : list of tuple
        Name, limit, measured, axis, verdict, note as texts.
    verdict : str
        Of all limits, one line; empty where there are none.
    """

    serial: str
    date: str
    dated: str
    config: str
    config_sha256: str
    recordings: list[dict[str, Any]]
    versions: dict[str, str]
    plugins: list[Participant]
    maps: list[dict[str, str]]
    limits: list[list[str]]
    verdict: str

    @property
    def rule(self) -> str:
        """The rule by which the limits are decided, and its risk."""
        return RULE

    @property
    def outcome(self) -> str:
        """The class of the verdict on a page: `pass`, `fail`, `undecided` or `unknown`."""
        return outcome(self.verdict)


def sheet_of(
    config: Config,
    recordings: Sequence[str] | None = None,
    *,
    judged: Sequence[LimitResult] = (),
    plugins: Iterable[Participant] | None = None,
) -> Sheet:
    """Return the sheet of a result.

    Parameters
    ----------
    config : Config
    recordings : list of `PATH`, `PATH::START:STOP`, or samples in memory, optional
        What was read; the config's own recording where it is left out.
    judged : list of LimitResult
        Its limits, held against what was measured.
    plugins : list of dict, optional
        Those that took part; those of the config where it is left out.

    Raises
    ------
    UnreadableFile
        If a recording cannot be read any more.
    """
    unit, text = tracked_unit(config.filter), config.as_yaml()
    sources = [] if config.source is None else [config.source]
    names = [identity(name) for name in recordings] if recordings is not None else list(map(of_source, sources))
    files = [source.path for source in sources if isinstance(source, FileSource) and source.path is not None]
    paths = files if recordings is None else paths_of(recordings)
    began = next((start for path in paths if (start := started_at(path)) is not None), None)
    if began is None:
        read = sources if recordings is None else (_source_of(config, name) for name in recordings)
        began = next((start for source in read if (start := _date(source)) is not None), None)
    day = datetime.now(UTC) if began is None else datetime.fromtimestamp(began, UTC)
    return Sheet(
        serial=config.serial or "",
        date=day.date().isoformat(),
        dated="page" if began is None else "recorded",
        config=config.name,
        config_sha256=hashlib.sha256(text.encode()).hexdigest(),
        recordings=names,
        versions={"driftlab": __version__, "Python": platform.python_version(), **{n: version(n) for n in LIBRARIES}},
        plugins=list(participants(config) if plugins is None else plugins),
        maps=[map_facts(m.load(), unit, m.path) for m in config.maps() if m.path and m.path.is_file()],
        limits=[row.cells(unit) for row in judged],
        verdict=verdict(judged),
    )


def _date(source: Source | None) -> float | None:
    """Return the time of the first rows of a file, s since 1970; None where it is no date."""
    if isinstance(source, FileSource) and source.path and source.path.is_file() and "time" in source.channels:
        with suppress(FusionError):
            t = next(iter(source.chunks(FIRST, Faults()))).t
            return next((float(moment) for moment in t if YEARS[0] < moment < YEARS[1]), None)
    return None


def _source_of(config: Config, recording: str) -> Source | None:
    """Return the source of a recording; None where the config's reads no file."""
    with suppress(FusionError):
        return with_recording(config, recording).source
    return None


def map_facts(fitted: FittedMap, unit: BiasUnit, path: Path | None = None) -> dict[str, str]:
    """Return the facts of a fitted map for the sheet, in the unit in which its bias is shown; `path` is of its file."""
    record = fitted.record
    shown = unit if record.unit == unit.si else BiasUnit(record.unit, record.unit)
    averages = f" in {record.averaged_over:g} s averages"
    residuals = ((record.averaged_residual, averages), (record.residual, " in samples"))
    texts = [
        f"{', '.join(f'{v * shown.factor:.3g}' for v in values)} {shown.shown}{of}"
        for values, of in residuals
        if values
    ]
    low, high = record.domain
    return {
        "kind": record.kind,
        "channel": record.channel,
        "file": "" if path is None else str(path),
        "sha256": "" if path is None else sha256(path),
        "fitted_on": record.provenance.get("recordings", "") or "not known",
        "fitted_at": record.provenance.get("fitted_at", ""),
        "residual": "; ".join(texts) or "not known",
        "domain": f"{low:.2f} to {high:.2f} °C",
    }
