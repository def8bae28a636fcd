"""What the soaks of a fleet say with the common effects in the model, found once and gone through often."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import BinaryIO, Self, cast

from driftlab.family.common_effect import CommonEffect, Noise, without_effects
from driftlab.family.common_effects import CommonEffects
from driftlab.family.each import Each
from driftlab.family.soaked import Soaked
from driftlab.fleets.kept import Kept, Place


class Spooled:
    """Units with the effects in the model, in their order; a `Units`, and a context manager.

    They lie in a file without a name, which ends with this: effects are taken apart once a unit, and memory does not
    grow with the units. All but `whole` lie there without their rows, which nobody needs who fits a family.

    Parameters
    ----------
    kept : Kept
    common : CommonEffects
    each : Each
        Who takes them apart.
    whole : collection of int
        Places of the units that keep their rows.
    """

    def __init__(self, kept: Kept, common: CommonEffects, each: Each, whole: Collection[int] = ()) -> None:
        self._kept, self._whole, self._starts = kept, sorted(whole), list[int]()
        self._file = cast(BinaryIO, tempfile.TemporaryFile(dir=kept.folder))  # noqa: SIM115 - closed at the end of this
        rows = set(whole)
        units = ((place, common.noise.get(place.unit), k in rows) for k, place in enumerate(kept.places()))
        for content in each(partial(_apart, common.effects), units):
            self._starts.append(self._file.tell())
            self._file.write(content)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ended: object) -> None:
        self._file.close()

    def __len__(self) -> int:
        return len(self._kept)

    def __iter__(self) -> Iterator[tuple[Soaked, str]]:
        return map(self._read, range(len(self)))

    def with_rows(self) -> list[tuple[Soaked, str]]:
        """Return the units that keep their rows."""
        return [self._read(k) for k in self._whole]

    def _read(self, k: int) -> tuple[Soaked, str]:
        self._file.seek(self._starts[k])
        found: tuple[Soaked, str] = pickle.load(self._file)
        return found


def _apart(effects: Sequence[CommonEffect], unit: tuple[Place, Noise | None, bool]) -> bytes:
    """Return a unit with the effects in the model, and its lot, as they lie in the file."""
    place, noise, whole = unit
    soaked, lot = place.read()
    if effects:
        soaked = without_effects(soaked, lot, effects, noise)
    return pickle.dumps((soaked if whole else replace(soaked, recordings=()), lot), pickle.HIGHEST_PROTOCOL)
