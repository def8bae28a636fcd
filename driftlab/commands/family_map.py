"""The map of a unit of which a part was soaked, by its own data and its family: `driftlab fit-map --family`."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path

import numpy as np

from driftlab import __version__
from driftlab.commands.console import say, say_lines, terminal
from driftlab.commands.inputs import Progress
from driftlab.commands.result import Result
from driftlab.config import Config, paths_of
from driftlab.family.file import load_family
from driftlab.family.mixed_model import Family
from driftlab.family.posterior_map import UnitPosterior, unit_posterior
from driftlab.family.unit_noise import soaked_of
from driftlab.maps.fit import USUAL, fit_gathered, gather, map_settings
from driftlab.reports import family_map as words
from driftlab.reports.charts import Chart
from driftlab.storage.json import plain
from driftlab.storage.map_file import check_place, save
from driftlab.units import tracked_unit
from fusion_core.contracts import FittedMap
from fusion_core.errors import ConfigError, DataError
from fusion_core.faults import Faults


class FamilyMapResult(Result):
    """The posterior map of a unit, as arrays over the family's domain: `temperature` (N,), `bias`, `sigma` (N, d).

    `family_sigma` (N, d) is the deviation before the unit was soaked, `own_bias` and `own_sigma` (N, d) are of its own
    map, NaN beyond what was soaked.

    Attributes
    ----------
    map : FittedMap
        Own data and family together.
    own : FittedMap or None
        The unit's own map; None where its soak is too short for one.
    known : Known
        What is known of the unit, and from where.
    written : tuple of Path
    """

    def __init__(
        self,
        config: Config,
        recordings: Sequence[str],
        family: str,
        known: UnitPosterior,
        own: FittedMap | None,
        faults: Faults,
    ) -> None:
        self.config, self.known, self.own, self.faults = config, known, own, faults
        self.unit = tracked_unit(config.filter)
        self.written: tuple[Path, ...] = ()
        units = known.family.units
        about = {
            "family": family, "units": str(units), "recordings": ", ".join(Path(r).name for r in recordings),
            "fitted_at": datetime.now(UTC).isoformat(timespec="seconds"), "driftlab": __version__,
        }  # fmt: skip
        self.map = known.map(about)
        record, T = self.map.record, known.T
        self.name = f"map of the {record.channel}, with the family of {units} units"
        of_own = np.full((2, len(T), record.d), np.nan)
        if own is not None:
            inside = (own.domain[0] <= T) & (own.domain[1] >= T)
            of_own[:, inside] = own.bias(T[inside]), own.sigma(T[inside])
        self._columns = {
            "temperature": T, "bias": self.map.bias(T), "sigma": known.sigma, "family_sigma": known.before,
            "own_bias": of_own[0], "own_sigma": of_own[1],
        }  # fmt: skip
        self.units = dict.fromkeys(self._columns, record.unit) | {"temperature": "degC"}
        self.labels = dict.fromkeys((name for name in self._columns if name != "temperature"), record.axes)
        self.summary = record.model_dump(mode="json") | {
            "verdict": words.sentences(self), "judged": plain(words.as_json(self)), "serial": config.serial
        }  # fmt: skip

    def lines(self) -> list[str]:
        """Return the verdict, and what one should know of the recordings."""
        return [*words.sentences(self), *self.faults.lines()]

    def _chart(self) -> Chart:
        """Return the map with its band, the unit's own map and the family's, and what each knows."""
        return words.chart(self)

    def save(self, out: str | PathLike[str]) -> None:
        """Write the map to the file `out`; raises ConfigError, Unwritable or MapError."""
        path = Path(out)
        check_place(path, [], "fit-map")
        save(self.map, path, "fit-map")
        self.written = (path,)


def family_of(config: Config, path: Path) -> Family:
    """Return the family of a config's tracked sensor; raises ConfigError, or MapError where it is another's."""
    if config.filter is None:
        raise ConfigError("filter: is missing, so it is not known whose bias the family is to tell; write one")
    tracked = config.filter.tracked
    return load_family(path, channel=tracked.channel, bias_unit=tracked.unit, axes=tuple(tracked.axes))


def fit_family_map(
    config: Config, recordings: Sequence[str], family: Path, lot: str, out: Path | None, progress: Progress | None
) -> FamilyMapResult:
    """Return the map that a unit's own soak and its family give; with `out`, write it there.

    Parameters
    ----------
    recordings : list of `PATH`, `PATH::START:STOP`, or samples in memory
        At rest, over any part of the family's range.
    family : Path
        `family.json` of a fleet.
    lot : str
        Of the unit; one that the family does not know is an unknown one.

    Raises
    ------
    ConfigError, MapError, DataError
        If the family is of another sensor, a recording cannot be used, or the map's file is in the way.
    """
    law, faults = family_of(config, family), Faults()
    if out is not None:
        check_place(out, [family, *config.files_to_fit(), *paths_of(recordings)], "fit-map")
    if lot and lot not in law.lots:
        faults.note(f"lot {lot}: is not one of the family's ({', '.join(law.lots) or 'it has none'}); taken as unknown")
    soak = gather(config, recordings, faults, progress, keep=True)
    own: FittedMap | None = None
    try:
        own = fit_gathered(config, map_settings(config, None if config.tracked_maps() else USUAL), soak)
    except DataError as error:
        faults.note(f"no map of its own: {error}")
    information, _ = soaked_of("", law.axes, soak.rows(law.channel), law.knots.step)
    posterior = unit_posterior(law, information, lot)
    result = FamilyMapResult(config, recordings, family.name, posterior, own, faults)
    if out is not None:
        result.save(out)
    return result


def show_family_map(result: FamilyMapResult) -> None:
    """Print the verdict, the deviations over the range and the notes."""
    say_lines(words.sentences(result))
    terminal().print(words.table(result))
    say_lines(result.faults.lines(), "note: ")
    say(f"written to {', '.join(map(str, result.written))}\n")
