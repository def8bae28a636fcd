"""`family.json`: the law of a family, as it is kept and read back.

d axes, q coefficients; all in SI, temperatures in degC. Of a symmetric matrix the file has the upper triangle, row by
row.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, ValidationError, model_validator

from driftlab import __version__
from driftlab.family.bands import Bands
from driftlab.family.basis import SplineBasis
from driftlab.family.mixed_model import Family, LotEffect
from driftlab.family.tail_law import TailLaws
from fusion_core.budget import read_whole
from fusion_core.chunk import Array
from fusion_core.errors import MapError, Unwritable, shown
from fusion_core.thermal.fitted_map import COLDEST, HOTTEST
from fusion_core.thermal.map_file import expect_covariance, write_whole
from fusion_core.thermal.record_texts import AxisNames, Name, Plain, SiUnit, check_tree, parse_json

Vectors = tuple[tuple[FiniteFloat, ...], ...]
Count = Annotated[int, Field(ge=0, le=10**12)]
Share = Annotated[float, Field(ge=0, le=1e30)]
LOT_DIGITS = 9  # significant ones of a lot's covariance, of which there are many


class LotFile(BaseModel):
    """A lot: its `shift` and `sigma` (d, q), and the covariance (d, q (q + 1) / 2) of the mean of its units."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    units: Count
    shift: Vectors
    sigma: Vectors
    mean_covariance: Vectors


class FamilyFile(BaseModel):
    """The content of the file.

    Attributes
    ----------
    first, intervals, step : int, int, float
        Of the knots: `first` times `step` is the lower end of the domain, degC.
    mu, mu_sigma : (d, q)
        Mean, and its deviations.
    mu_covariance, Sigma, Lambda : (d, q (q + 1) / 2)
        Covariance of the mean, of units about their lot's mean, and of the lots' means about the family's.
    lots : dict of str to LotFile
    units, sampled : int
        How many there were, and how many Sigma is of.
    weights : dict of str to (d,)
        Of units that were weighted down.
    steps, moved : (d,)
        Of EM, and by what share of its deviations Sigma changed in the last.
    map_kind, config : str
        Kind of the units' own maps, and the config (YAML).
    bands : Bands or None
        How wide bands must be, as measured on units that were left out.
    common_effects : dict or None
        What the units have in common (`driftlab.family.shared_effects`), in whose presence mu and Sigma are.
    odd_lots : tuple of str
        Why lots are off the others as a whole, a sentence each.
    laws : Laws or None
        What is usual of the units' curves and figures, by which new units are judged.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    driftlab: Plain
    channel: Name
    bias_unit: SiUnit
    axes: Annotated[AxisNames, Field(min_length=1)]
    first: int
    intervals: int
    step: FiniteFloat
    units: Count
    sampled: Count
    mu: Vectors
    mu_sigma: Vectors
    mu_covariance: Vectors
    Sigma: Vectors
    Lambda: Vectors
    lots: dict[Plain, LotFile]
    weights: dict[Plain, tuple[Share, ...]]
    steps: tuple[Count, ...]
    moved: tuple[FiniteFloat, ...]
    map_kind: Plain
    config: str
    bands: Bands | None = None
    common_effects: Annotated[dict[str, Any], AfterValidator(check_tree)] | None = None
    odd_lots: tuple[Plain, ...] = ()
    laws: TailLaws | None = None

    @model_validator(mode="after")
    def _shapes(self) -> FamilyFile:
        if self.intervals < 1 or self.step <= 0:
            raise ValueError("knots have no width")
        if not COLDEST <= self.first * self.step < (self.first + self.intervals) * self.step <= HOTTEST:
            raise ValueError(f"its knots are beyond {COLDEST:g} to {HOTTEST:g} °C")
        d, q = len(self.axes), self.knots.q
        vectors = [self.mu, self.mu_sigma, *(part for lot in self.lots.values() for part in (lot.shift, lot.sigma))]
        matrices = [self.mu_covariance, self.Sigma, self.Lambda, *(lot.mean_covariance for lot in self.lots.values())]
        sizes = [(part, q) for part in vectors] + [(part, q * (q + 1) // 2) for part in matrices]
        if any(len(part) != d or any(len(row) != size for row in part) for part, size in sizes):
            raise ValueError(f"what it has does not fit {d} axes of {q} coefficients")
        if any(np.linalg.eigvalsh(_square(row))[0] <= 0 for row in self.Sigma):
            raise ValueError("Sigma is no covariance")
        for name, part in (("mu_covariance", self.mu_covariance), ("Lambda", self.Lambda)):
            expect_covariance(name, _squares(part))
        for lot in self.lots.values():
            expect_covariance("mean_covariance", _squares(lot.mean_covariance), 1e3 * 10.0**-LOT_DIGITS)
        return self

    @property
    def knots(self) -> SplineBasis:
        """Over the family's domain."""
        return SplineBasis(self.first, self.intervals, self.step)

    def family(self) -> Family:
        """Return the family."""
        lots = {
            name: LotEffect(np.array(lot.shift), np.array(lot.sigma), _squares(lot.mean_covariance), lot.units)
            for name, lot in self.lots.items()
        }
        return Family(
            self.knots, self.axes, self.channel, self.bias_unit, np.array(self.mu), _squares(self.mu_covariance),
            _squares(self.Sigma), _squares(self.Lambda), lots, self.units, self.sampled,
            {name: np.array(w) for name, w in self.weights.items()}, np.array(self.steps), np.array(self.moved),
            self.bands, self.laws,
        )  # fmt: skip


def as_json(
    family: Family,
    *,
    map_kind: str = "",
    config: str = "",
    common_effects: dict[str, Any] | None = None,
    odd_lots: Sequence[str] = (),
) -> str:
    """Return the content of `family.json`; what is no part of the family as in `FamilyFile`."""
    found = {
        "schema": 1,
        "driftlab": __version__,
        "channel": family.channel,
        "bias_unit": family.bias_unit,
        "axes": family.axes,
        "first": family.knots.first,
        "intervals": family.knots.intervals,
        "step": family.knots.step,
        "units": family.units,
        "sampled": family.sampled,
        "mu": family.mu.tolist(),
        "mu_sigma": np.sqrt(np.diagonal(family.mu_covariance, axis1=1, axis2=2)).tolist(),
        "mu_covariance": _triangles(family.mu_covariance),
        "Sigma": _triangles(family.Sigma),
        "Lambda": _triangles(family.Lambda),
        "lots": {name: _lot(lot) for name, lot in family.lots.items()},
        "weights": {name: w.tolist() for name, w in family.weights.items()},
        "steps": family.steps.tolist(),
        "moved": family.moved.tolist(),
        "map_kind": map_kind,
        "config": config,
        "bands": None if family.bands is None else family.bands.model_dump(mode="json"),
        "common_effects": common_effects,
        "odd_lots": list(odd_lots),
        "laws": None if family.laws is None else family.laws.model_dump(mode="json"),
    }
    return json.dumps(found)


def save_family(
    path: Path,
    family: Family,
    *,
    map_kind: str = "",
    config: str = "",
    common_effects: dict[str, Any] | None = None,
    odd_lots: Sequence[str] = (),
) -> None:
    """Write a family, whole or not at all.

    Raises
    ------
    Unwritable
        If it cannot be written.
    """
    try:
        content = as_json(family, map_kind=map_kind, config=config, common_effects=common_effects, odd_lots=odd_lots)
        write_whole(path, content.encode())
    except OSError as error:
        raise Unwritable(
            f"{path} cannot be written ({error.strerror}); name a file in a folder that exists and can be written"
        ) from None


def read_family(path: Path) -> FamilyFile:
    """Return the content of a family's file.

    Raises
    ------
    MapError
        If it cannot be read, or is damaged.
    """
    try:
        text = read_whole(path).decode()
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise MapError(f"family {path} cannot be read ({why}); name the family.json of a fleet") from None
    try:
        return FamilyFile.model_validate(parse_json(text))
    except (ValueError, RecursionError) as error:
        if not isinstance(error, ValidationError):
            raise MapError(
                f"family {path} is damaged or no family's file ({shown(error, 120)}); fit the family again with "
                "driftlab fleet"
            ) from None
        first = error.errors(include_url=False)[0]
        at = shown(".".join(map(str, first["loc"]))) or "file"
        raise MapError(
            f"family {path} is damaged or no family's file: {at}: {shown(first['msg'])}; fit the family again with "
            "driftlab fleet"
        ) from None


def load_family(
    path: Path, *, channel: str | None = None, bias_unit: str | None = None, axes: tuple[str, ...] | None = None
) -> Family:
    """Return the family of a file; `channel`, `bias_unit` and `axes` are the config's, None where any will do.

    Raises
    ------
    MapError
        If it cannot be read, is damaged, or is of another sensor.
    """
    found = read_family(path)
    for what, has, wanted in (
        ("channel", found.channel, channel), ("unit", found.bias_unit, bias_unit),
        ("axes", " ".join(found.axes), None if axes is None else " ".join(axes)),
    ):  # fmt: skip
        if wanted is not None and has != wanted:
            raise MapError(
                f"family {path} has the {what} {shown(has)}, the config {shown(wanted)}; name a family of the sensor "
                "that the config is about"
            )
    return found.family()


def _lot(lot: LotEffect) -> dict[str, Any]:
    rounded = [[float(f"{value:.{LOT_DIGITS}g}") for value in row] for row in _triangles(lot.mean_covariance)]
    return {"units": lot.units, "shift": lot.shift.tolist(), "sigma": lot.sigma.tolist(), "mean_covariance": rounded}


def _triangles(matrices: Array) -> list[list[float]]:
    """Return the upper triangles of matrices (d, q, q)."""
    rows, columns = np.triu_indices(matrices.shape[1])
    found: list[list[float]] = matrices[:, rows, columns].tolist()
    return found


def _squares(triangles: Vectors) -> Array:
    return np.stack([_square(row) for row in triangles])


def _square(triangle: tuple[float, ...]) -> Array:
    """Return the symmetric matrix (q, q) of an upper triangle."""
    q = round((np.sqrt(8 * len(triangle) + 1) - 1) / 2)
    found = np.zeros((q, q))
    found[np.triu_indices(q)] = triangle
    return found + np.triu(found, 1).T
