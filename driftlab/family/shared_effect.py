"""An effect that the units of a family have in common, and what it is in each.

d axes, q coefficients an axis.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import TypeAdapter

from driftlab.family.contrasts import chunks_of, seen_temperatures, shown
from driftlab.family.unit_information import UnitInformation
from driftlab.family.unit_noise import densities_of
from driftlab.identification.result import parameters
from driftlab.noise.local_level import log_determinant, whitened
from fusion_core.chunk import Array
from fusion_core.contracts import Effect
from fusion_core.host.registry import Installed


class UnitDensities(NamedTuple):
    """Densities of the white noise and of the walk (d,) of a unit, SI."""

    white: Array
    walk: Array


@dataclass(frozen=True, eq=False)
class EffectDistribution:
    """How the coefficients (d, q) are spread over units: N(mean, spread^2), `sigma` of the mean; SI."""

    mean: Array
    sigma: Array
    spread: Array

    def shrunken(self, c: Array, v: Array) -> tuple[Array, Array]:
        """Return a unit's coefficients and deviations, its own c with variances v (infinite: unseen) and the law."""
        prior = np.maximum(self.spread**2, 1e-12 * (self.mean**2 + self.sigma**2) + 1e-300)
        weight = 1 / (1 / prior + 1 / v)
        return (self.mean / prior + np.where(np.isfinite(v), c / v, 0.0)) * weight, np.sqrt(weight)

    def as_json(self) -> dict[str, Any]:
        """Return it for `family.json`."""
        return {"mean": self.mean.tolist(), "mean_sigma": self.sigma.tolist(), "spread": self.spread.tolist()}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return what `as_json` wrote."""
        return cls(*(np.array(content[name], dtype=float) for name in ("mean", "mean_sigma", "spread")))


@dataclass(frozen=True, eq=False)
class OfLot:
    """What one lot has: units, mean and deviation (d, q), the evidence of it (nats), and whether that is enough."""

    lot: str
    units: int
    mean: Array
    sigma: Array
    evidence: float
    has: bool

    def as_json(self) -> dict[str, Any]:
        """Return it for `family.json`."""
        return {
            "lot": self.lot,
            "units": self.units,
            "mean": self.mean.tolist(),
            "mean_sigma": self.sigma.tolist(),
            "evidence": self.evidence,
            "has": self.has,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return what `as_json` wrote."""
        mean, sigma = np.array(content["mean"], dtype=float), np.array(content["mean_sigma"], dtype=float)
        return cls(content["lot"], content["units"], mean, sigma, content["evidence"], content["has"])


@dataclass(frozen=True, eq=False)
class SharedEffect:
    """One effect.

    Attributes
    ----------
    effect : Effect
        With its hyper-parameters.
    unit : str
        Of the coefficients.
    law : Law
        Of the units that have it.
    others : Law or None
        Of the units of the lots that have it not; None where every lot is one law's.
    lots : tuple of OfLot
        In the order of their names; none where no lots are known.
    differs : float
        Probability that lots of one law differ as much.
    evidence, of_mean, of_size, price : float
        Nats: that it is there, of the mean of the units' coefficients and of their squares; and what it had to exceed.
    left_out, in_other_lots : float, float or None
        Gain on units, mean a unit in nats, that had no part in the law nor in the hyper-parameters; and in lots.
    indistinguishable_from : tuple of str
        What predicts left-out units as well.
    """

    effect: Effect
    unit: str
    law: EffectDistribution
    others: EffectDistribution | None
    lots: tuple[OfLot, ...]
    differs: float
    evidence: float
    of_mean: float
    of_size: float
    price: float
    left_out: float
    in_other_lots: float | None
    indistinguishable_from: tuple[str, ...]

    def law_of(self, lot: str) -> EffectDistribution:
        """Return the law of the units of a lot."""
        if self.others is None or any(one.lot == lot and one.has for one in self.lots):
            return self.law
        return self.others

    def as_json(self) -> dict[str, Any]:
        """Return it for `family.json`."""
        effect = self.effect.model_dump(mode="json", exclude_none=True)
        names = ("differs", "evidence", "of_mean", "of_size", "price", "left_out", "in_other_lots")
        return {
            "kind": self.effect.kind,
            "channel": self.effect.subject,
            "parameters": parameters(self.effect),
            "effect": effect,
            "unit": self.unit,
            **self.law.as_json(),
            "other_lots": None if self.others is None else self.others.as_json(),
            "lots": [lot.as_json() for lot in self.lots],
            **{name: getattr(self, name) for name in names},
            "indistinguishable_from": list(self.indistinguishable_from),
            "explanation": self.effect.explanation,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> Self:
        """Return what `as_json` wrote; raises ValidationError where the effect is not installed."""
        effect: Effect = TypeAdapter(Annotated[Effect, Installed()]).validate_python(content["effect"])
        others = content["other_lots"]
        lots = tuple(OfLot.from_json(lot) for lot in content["lots"])
        names = ("differs", "evidence", "of_mean", "of_size", "price", "left_out", "in_other_lots")
        return cls(
            effect, content["unit"], EffectDistribution.from_json(content),
            None if others is None else EffectDistribution.from_json(others), lots,
            **{name: content[name] for name in names}, indistinguishable_from=tuple(content["indistinguishable_from"]),
        )  # fmt: skip


def without_effects(
    soaked: UnitInformation, lot: str, effects: Sequence[SharedEffect], noise: UnitDensities | None = None
) -> UnitInformation:
    """Return what the soaks say of the curve where the unit has the effects, its noise beside them found if not known.

    What the effects show passes for a walk where they are not in the model.
    """
    if noise is None:
        found = densities_of(_without(soaked, lot, effects).recordings, soaked.knots.step)
        noise = UnitDensities(found.white, found.likely)
    return _without(replace(soaked, white=noise.white, walk=noise.walk), lot, effects)


def _without(soaked: UnitInformation, lot: str, effects: Sequence[SharedEffect]) -> UnitInformation:
    """Return what the soaks say of the curve where the unit has the effects, each drawn from its law.

    With Z their columns and c ~ N(m, D), -2 log L of the curve alone is that of y - Z m under S + Z D Z'. The rows are
    without the effects at what they are most likely to be.
    """
    have = set(soaked.recordings[0].channels) | {"temperature"}
    effects = [effect for effect in effects if set(effect.effect.requires) <= have]
    coefficient = [effect for effect in effects if not effect.effect.acts_on_input]
    laws = [effect.law_of(lot) for effect in coefficient]
    chunks = chunks_of(soaked)
    parts = [shown(effect.effect, soaked, chunks) for effect in coefficient]
    d = len(soaked.axes)
    mean = np.concatenate([np.zeros((d, 0)), *(law.mean for law in laws)], axis=1)
    spread = np.concatenate([np.zeros((d, 0)), *(law.spread for law in laws)], axis=1)
    Z = [
        np.concatenate([np.zeros((len(rows.t), d, 0)), *(part[k] for part in parts)], axis=2)
        for k, rows in enumerate(soaked.recordings)
    ]
    T = seen_temperatures(soaked, [effect.effect for effect in effects])
    q = soaked.knots.q
    J, h, squares, log_det = soaked.J.copy(), soaked.h.copy(), soaked.squares.copy(), soaked.log_det.copy()
    bias = [rows.bias.copy() for rows in soaked.recordings]
    for axis in range(d):
        N, log_det[axis] = _products(soaked, axis, T, [z[:, axis] for z in Z], mean[axis], spread[axis])
        V = N[q + 1 :, q + 1 :] + np.eye(mean.shape[1])
        S = N[: q + 1, : q + 1] - N[: q + 1, q + 1 :] @ np.linalg.solve(V, N[q + 1 :, : q + 1])
        J[axis], h[axis], squares[axis] = S[:q, :q], S[:q, q], S[q, q]
        log_det[axis] += float(np.linalg.slogdet(V)[1])
        curve = np.linalg.lstsq(J[axis], h[axis], rcond=1e-10)[0]
        beyond = np.linalg.solve(V, N[q + 1 :, q] - N[q + 1 :, :q] @ curve)
        for one, z in zip(bias, Z, strict=True):
            one[:, axis] -= z[:, axis] @ (mean[axis] + spread[axis] * beyond)
    rows = tuple(replace(one, T=t, bias=y) for one, t, y in zip(soaked.recordings, T, bias, strict=True))
    return replace(soaked, J=J, h=h, squares=squares, log_det=log_det, recordings=rows)


def _products(
    soaked: UnitInformation, axis: int, T: Sequence[Array], Z: Sequence[Array], mean: Array, spread: Array
) -> tuple[Array, float]:
    """Return the products of splines, bias less effects at their means, and effects a spread each; and log det S."""
    total, log_det = np.zeros(()), 0.0
    for k, (rows, t, z) in enumerate(zip(soaked.recordings, T, Z, strict=True)):
        noise = rows.variances(soaked.white[axis], soaked.walk[axis], free=k > 0)
        X = whitened(np.column_stack([soaked.knots.values(t), rows.bias[:, axis] - z @ mean, z * spread]), *noise)
        total = total + X.T @ X
        log_det += log_determinant(*noise)
    return total, log_det
