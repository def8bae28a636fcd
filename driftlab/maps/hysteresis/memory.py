"""The answer to whether a bias remembers which temperatures came before: seen, none larger than X, or undecided."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any, Literal

import numpy as np

from driftlab.maps.hysteresis.contrasts import FEWEST, FINEST, Made, SoakContrasts
from driftlab.maps.hysteresis.evidence import FORM, FORMED, SEEN, Pairs, ShapeEvidence
from driftlab.maps.hysteresis.openings import Sweeps
from driftlab.maps.hysteresis.shapes import MemoryShapes, shapes_of
from driftlab.soak.blocks import WAYS, SoakSummary
from fusion_core.chunk import Array

SHARED = 0.2  # of the range of temperature, that both ways must have seen
ALIKE = 0.05  # of the likeliest kind: one that is so likely cannot be told from it
PAIRS = 24
HINT = 1.0  # of the evidence: more is worth a mention (Kass and Raftery, 1995)
CLEAR = 1.96  # deviations of a size, on one axis at least: with less a size is not signed
TWO = 3.0  # of the evidence of two shapes against one: both are there
WHY = {
    "warms": "only ever warms: hysteresis cannot be seen; come back down by the same steps",
    "cools": "only ever cools: hysteresis cannot be seen; come back up by the same steps",
    "no way": "the temperature goes neither up nor down in the order of the samples: hysteresis cannot be seen",
    "apart": "warming and cooling share too few temperatures: hysteresis cannot be seen; come back by the same steps",
    "short": "too short on its way up or down: hysteresis cannot be told from noise; go slower, or up and down again",
    "levels": "each recording or placement goes one way and has a level of its own: a hysteresis that is alike at "
    "all temperatures cannot be seen; warm and cool within one",
    "weak": "only a hysteresis larger than all that the bias does here would be seen; go up and down again, or slower",
    "hint": "more is there than a soak without hysteresis usually shows, and less than is taken for one; go up and "
    "down again, by the same steps",
    "brief": "up and down differ as where the sensor follows its thermometer by less than a minute, which may be their "
    "places or when they are read: whether it remembers more, cannot be told; go up and down faster, and slower",
    "slight": "the bias goes with where the temperature came from, but the difference between up and down is within "
    "its uncertainty; go up and down again, by the same steps",
    "none": "what is between up and down is no more than noise",
    "seen": "what a free curve leaves goes with where the temperature came from",
}

Answer = Literal["seen", "none", "undecided"]


@dataclass(frozen=True, eq=False)
class MemoryVerdict:
    """What a soak says of memories, in SI; d axes.

    Attributes
    ----------
    answer : str
        "seen", "none" (larger than `none_larger_than`), or "undecided" (cannot be told on this soak).
    kinds : tuple of str
        Kinds of effects that the soak cannot tell from one another, the likeliest first; empty unless seen.
    size, sigma : (d,) arrays
        Warming less cooling where it is largest, and its standard deviation; NaN where it is unknown.
    none_larger_than : (d,) array
        What this soak would have shown with 95 %: of up less down, where it is largest; infinite where it is unknown.
    where : (d,) array
        Temperature of the largest difference, degC; NaN where it is unknown.
    why : str
        What the answer stands on; where it is undecided, which soak would tell.
    evidence : float
        Natural logarithm of how much likelier the soak is with a memory than without; NaN where it was not looked for.
    together : bool
        Whether more than one kind is there at once.
    T, difference, spread : (G,), (G, d) and (G, d) arrays
        Warming less cooling over temperature in the mean over the sweeps, if there is a memory, and its standard
        deviation; empty where it is unknown.
    """

    answer: Answer
    kinds: tuple[str, ...]
    size: Array
    sigma: Array
    none_larger_than: Array
    where: Array
    why: str
    evidence: float = np.nan
    together: bool = False
    T: Array = field(default_factory=lambda: np.empty(0))
    difference: Array = field(default_factory=lambda: np.empty((0, 0)))
    spread: Array = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def unknown(cls, d: int, why: str) -> MemoryVerdict:
        """Return that nothing can be told on d axes, and why."""
        nothing = np.full(d, np.nan)
        return cls("undecided", (), nothing, nothing, np.full(d, np.inf), nothing, why)

    @property
    def probability(self) -> float:
        """How probable a memory is, where as much spoke for one beforehand as against; 0 where it is unknown."""
        return float(1 / (1 + np.exp(-np.clip(self.evidence, -500, 500)))) if np.isfinite(self.evidence) else 0.0

    @property
    def called(self) -> str:
        """The kinds that the soak cannot tell from one another, in words; of several there together, that too."""
        if self.together:
            return f"{' and '.join(self.kinds[:2])} together" + (
                f" ({', '.join(self.kinds[2:])} too)" if self.kinds[2:] else ""
            )
        return " or ".join(self.kinds) + (" (one cannot tell which)" if len(self.kinds) > 1 else "")

    def variance(self, T: Array) -> Array:
        """Return the mean square (N, d) of half of what is between up and down at T (N,), as probable as it is."""
        d = len(self.size)
        if not len(self.T):
            return np.zeros((len(T), d))
        squares = self.probability * (self.difference**2 + self.spread**2) / 4
        some = ~np.isnan(squares[:, 0])
        if not np.any(some):
            return np.zeros((len(T), d))
        return np.stack([np.interp(T, self.T[some], column[some]) for column in squares.T], axis=1)

    def as_json(self) -> dict[str, Any]:
        """Return it for programs, in SI; null where a number is unknown."""
        numbers = ("size", "sigma", "none_larger_than")
        found = {name: [_finite(value) for value in getattr(self, name)] for name in numbers}
        where = [_finite(value) for value in self.where]
        more = {"at_degC": where, "log_evidence": _finite(self.evidence), "why": self.why}
        return {"answer": self.answer, "kinds": list(self.kinds), **found, **more}


def memory_of(soak: SoakSummary) -> MemoryVerdict:
    """Return what a soak says of memories of temperature, of all kinds of effects that are installed."""
    d = soak.bias.shape[1]
    reason = _unseen(soak)
    if reason:
        return MemoryVerdict.unknown(d, WHY[reason])
    with _threads().limit(limits=1):  # of small matrices
        return _weighed(soak, d)


@cache
def _threads() -> Any:
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]

    return ThreadpoolController()


def _weighed(soak: SoakSummary, d: int) -> MemoryVerdict:
    contrasts, shapes = SoakContrasts(soak), shapes_of(soak)
    if not contrasts.laws or not shapes.kinds:
        return MemoryVerdict.unknown(d, WHY["short"])
    own = np.repeat(shapes.added[:, :, None], d, axis=2)
    z = np.repeat(contrasts.of(shapes.added)[:, :, None], d, axis=2)
    followed, made = None, None
    if shapes.inputs.size:
        slots, more, followed, made = contrasts.added_by_inputs(shapes.inputs, np.argmax(contrasts.without, axis=0))
        own, z = np.concatenate([own, slots], axis=1), np.concatenate([z, more], axis=1)
    found = ShapeEvidence.of(contrasts, z, shapes.kinds, followed)
    return _Judged(soak, contrasts, found, z, own, shapes, made).memory()


def _unseen(soak: SoakSummary) -> str:
    """Return why no soak like this shows a memory, a key of WHY; empty where it may."""
    warms, cools = (bool(np.any(soak.way == way)) for way in WAYS.values())
    if not (warms and cools):
        return "warms" if warms else "cools" if cools else "no way"
    both = (soak.cells(1)[0] > 0) & (soak.cells(-1)[0] > 0)
    if np.mean(both) < SHARED:
        return "apart"
    return "short" if len(soak.T) < 2 * FEWEST else ""


@dataclass(frozen=True, eq=False)
class _Judged:
    """Shapes, what is said of them, as contrasts z (m, J, d) and on the slots, own (S, J, d)."""

    soak: SoakSummary
    contrasts: SoakContrasts
    found: ShapeEvidence
    z: Array
    own: Array
    shapes: MemoryShapes
    made: Made | None

    def memory(self) -> MemoryVerdict:
        """Return the answer."""
        total = self.found.total
        seen = total > SEEN
        unseen = self._larger()
        reach = np.ptp(self.contrasts.blocks.means(self.soak.bias), axis=0)
        unseen = np.where(unseen < np.maximum(reach, 1e-300), unseen, np.inf)
        sized = self if total <= HINT else self._made()
        noise = np.argmax(self.found.noises, axis=0)
        pairs = Pairs.of(sized.found, noise, self.contrasts, sized.z, PAIRS) if seen else None
        size, sigma, where, T, difference, spread = sized._sizes(pairs, self.found)
        brief = self.found.as_they_are(self.shapes.brief)
        why = "brief" if seen and total - brief < SEEN else "seen" if seen else "hint" if total > HINT else "none"
        if why == "seen" and not np.any(np.abs(size) > CLEAR * sigma):
            why = "slight"
        if why in ("brief", "slight"):
            unseen = np.full_like(unseen, np.inf)
        if why == "none" and not np.all(np.isfinite(unseen)):
            why = "levels" if self._divided else "weak"
        answer: Answer = "seen" if why == "seen" else "none" if why == "none" else "undecided"
        said = "; ".join([WHY[why], *(f"could not be tried: {text}" for text in self.shapes.broken)])
        kinds, both = self._kinds(pairs) if pairs is not None and why == "seen" else ((), False)
        return MemoryVerdict(answer, kinds, size, sigma, unseen, where, said, total, both, T, difference, spread)

    def _made(self) -> _Judged:
        """Return the same of shapes whose curves follow their inputs as the soak says: for their sizes."""
        if self.made is None:
            return self
        m, added, made = len(self.z), self.found.added, self.made.shown
        more = self.contrasts.of(made.reshape(len(made), -1)).reshape(m, *made.shape[1:])
        z, own = (np.concatenate([x[:, :added], y], axis=1) for x, y in ((self.z, more), (self.own, made)))
        return replace(self, found=self.found.made(self.contrasts, more), z=z, own=own)

    @property
    def _divided(self) -> bool:
        """Whether each recording goes one way only."""
        ways, recordings = self.soak.way, self.soak.recording
        return all(len(np.unique(ways[(recordings == k) & (ways != 0)])) < 2 for k in np.unique(recordings))

    @cached_property
    def _sweeps(self) -> Sweeps:
        return Sweeps(self.soak, self.own)

    @cached_property
    def _openings(self) -> tuple[Array, Array]:
        return self._sweeps.openings()

    def _larger(self) -> Array:
        """Return the largest opening (d,) of a shape that is seen with less than 95 %."""
        noises = np.argmax(self.found.noises, axis=0)
        alike = np.empty((len(self.shapes.kinds),) * 2 + (self.z.shape[2],))
        for axis, noise in enumerate(noises):
            gram = self.contrasts.gram(int(noise), self.z[:, :, axis])
            size = np.maximum(np.diag(gram), 1e-300)
            alike[:, :, axis] = gram**2 / size / size[:, None]
        shown = self.found.would_show(np.minimum(alike, 1.0)) * np.abs(self._openings[0])
        return np.asarray(np.max(shown, axis=0) * self.contrasts.scale)

    def _kinds(self, pairs: Pairs) -> tuple[tuple[str, ...], bool]:
        """Return the kinds that are likely, the likeliest first, and whether two of them are there together."""
        names, each = [{kind} for kind in self.shapes.kinds], self.found.weights
        both = pairs.evidence > TWO
        if both:
            names, each = [{self.shapes.kinds[j] for j in which} for which in pairs.which], pairs.weights
            both = len(names[0]) > 1
        weights: dict[str, float] = {}
        for own, weight in zip(names, each, strict=True):
            for kind in own:
                weights[kind] = weights.get(kind, 0.0) + float(weight)
        order = sorted(weights, key=lambda kind: -weights[kind])
        return tuple(kind for kind in order if weights[kind] > ALIKE * weights[order[0]]), both

    def _sizes(self, pairs: Pairs | None, found: ShapeEvidence) -> tuple[Array, ...]:
        """Return size, sigma, where (d,) and T (G,), difference and spread (G, d): over all shapes, as likely as each.

        Of pairs of shapes too, where they are given.
        """
        mean, variance = self.found.estimates
        opening, at = self._openings
        per_kelvin = self._sweeps.mean_differences()
        formed = self._forms(found)
        power = pairs.power if pairs is not None else 1.0
        share = 1 / (1 + np.exp(power * np.clip(pairs.evidence, -500, 500))) if pairs is not None else 1.0
        weights, forms = found.tempered(power) * share, formed
        sizes, variances = [*(mean * opening)], [*(variance * opening**2)]
        curves, spreads = [*np.moveaxis(mean * per_kelvin, 1, 0)], [*np.moveaxis(variance * per_kelvin**2, 1, 0)]
        if pairs is not None:
            weights = np.concatenate([weights, pairs.weights * (1 - share)])
            forms = np.concatenate([forms, formed[pairs.which].max(axis=1)])
            for which, own, covariance in zip(pairs.which, pairs.mean, pairs.covariance, strict=True):
                wide = [self._sweeps.opening_of(which, own[:, a], a) for a in range(own.shape[1])]
                sizes.append(np.array([value for value, _ in wide]))
                variances.append(np.array([g @ covariance[..., a] @ g for a, (_, g) in enumerate(wide)]))
                each = per_kelvin[:, which]
                curves.append(np.einsum("Gqd,qd->Gd", each, own))
                spreads.append(np.einsum("Gqd,qrd,Grd->Gd", each, covariance, each))
        among = np.array(sizes)
        sign = np.sign(np.tensordot(weights, among, axes=1))
        both = self._sweeps.both_ways() & (np.arange(len(mean)) >= found.added)[:, None]
        among[: len(mean)] = np.where(both, np.abs(among[: len(mean)]) * sign, among[: len(mean)])
        size, sigma = _mixed(weights, among, np.array(variances), forms)
        difference, spread = _mixed(weights, np.array(curves), np.array(spreads), forms)
        where = at[int(np.argmax(found.weights))]
        scale = self.contrasts.scale
        return size * scale, sigma * scale, where, self._sweeps.T, difference * scale, spread * scale

    def _forms(self, found: ShapeEvidence) -> Array:
        """Return how far off the form of each shape may be, of its size (J, d): that of a curve is an estimate."""
        forms = np.full(self.z.shape[1:], FORM)
        if self.made is None:
            return forms
        inputs, noises = self.shapes.inputs, np.argmax(found.noises, axis=0)
        seen = Sweeps(self.soak, inputs[:, :, None]).shown[..., 0]
        between = np.empty((inputs.shape[1], len(noises), self.made.coefficients.shape[1]))
        for j, axis in np.ndindex(*between.shape[:2]):
            above, below, g = self._sweeps.widest(self._sweeps.shown[:, :, found.added + j, axis])
            up, down = self.contrasts.curve(np.nan_to_num([seen[above, g, j], seen[below, g, j]]))
            between[j, axis] = up - down
        s2 = np.nan_to_num(np.take_along_axis(found.left, noises[None], axis=0)[0]) / found.m
        variances = self.contrasts.form_variances(inputs, self.made, noises, np.maximum(s2, FINEST), between)
        wide = np.abs(self._openings[0][found.added :])
        some = wide > 0
        forms[found.added :] = np.hypot(FORMED, np.sqrt(variances) / np.where(some, wide, np.inf))
        return forms


def _mixed(weights: Array, means: Array, variances: Array, forms: Array) -> tuple[Array, Array]:
    """Return mean and deviation of a mixture of M, `weights` (M,), means and variances (M, ...).

    `forms` (M, d) are the share of each mean that its form may be off.
    """
    mean = np.tensordot(weights, means, axes=1)
    off = (forms if means.ndim == 2 else forms[:, None]) * means
    variance = np.tensordot(weights, variances + off**2 + (means - mean) ** 2, axes=1)
    return mean, np.sqrt(np.maximum(variance, 0.0))


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
