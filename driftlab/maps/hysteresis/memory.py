"""Verdict on whether a bias remembers which temperatures came before: seen, none larger than X, or undecided."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from driftlab.filtering.setup import SEEN
from driftlab.maps.hysteresis.contrasts import FINEST, MIN_CONTRASTS, THIN, FollowingCurves, SoakContrasts
from driftlab.maps.hysteresis.evidence import FORM, FORMED, Pairs, ShapeEvidence
from driftlab.maps.hysteresis.rivals import of_a_jump, tone_of
from driftlab.maps.hysteresis.shapes import MemoryShapes, Sweeps, shapes_of
from driftlab.soak.blocks import CELLS, WAYS, SoakSummary
from driftlab.units import duration
from fusion_core.chunk import Array, Flags
from fusion_core.threads import one_thread

SHARED = 0.2  # of the range of temperature, that both ways must have seen
ALIKE = 0.05  # of the likeliest kind: one that is so likely cannot be distinguished from it
PAIRS = 24
HINT = 1.0  # of the evidence: more is worth a mention (Kass and Raftery, 1995)
CLEAR = 1.96  # deviations of a size, on one axis at least: with less a size is not signed
TONES = 3  # in time, that a memory is looked for beside
TWO = 3.0  # of the evidence of two shapes against one: both are there
BESIDE = 4  # cells of temperature on either side, that a narrow difference stands out of
NARROW = 8.0  # deviations of a cell's difference from those beside it: more is a narrow loop, or a jump
WHY = {
    "warms": "only ever warms: hysteresis cannot be seen, and a walk hardly; come back down by the same steps",
    "cools": "only ever cools: hysteresis cannot be seen, and a walk hardly; come back up by the same steps",
    "no way": "the temperature goes neither up nor down in the order of the samples: hysteresis cannot be seen",
    "apart": "warming and cooling share too few temperatures: hysteresis cannot be seen; come back by the same steps",
    "short": "too short on its way up or down to distinguish hysteresis from noise; go slower, or up and down again",
    "coarse": "the thermometer reads in steps too coarse for what is between up and down; go faster, so that the "
    "temperature rests within no step, or take a finer thermometer",
    "levels": "each recording or placement goes one way and has a level of its own: a hysteresis that is alike at "
    "all temperatures cannot be seen; warm and cool within one",
    "weak": "only a hysteresis larger than all that the bias does here would be seen; go up and down again, or slower",
    "hint": "more is there than a soak without hysteresis usually shows, and less than is taken for one; go up and "
    "down again, by the same steps",
    "brief": "up and down differ as where the sensor follows its thermometer by less than a minute, which may be their "
    "places or when they are read: whether it remembers more is not known; go up and down faster, and slower",
    "settles": "up and down differ as where the bias settles after the start, whatever the temperature: whether it "
    "remembers more is not known; let it settle before the soak, or leave the first hours out with PATH::START:STOP",
    "jump": "up and down differ as where the bias jumped after {hours:.3g} h: whether it remembers is not known; go up "
    "and down again, by the same steps",
    "tone": "a period of {period} in time explains as much of what is between up and down: whether it remembers "
    "is not known; keep what has that period away from the sensor, or go up and down again, at another pace",
    "slight": "the bias goes with where the temperature came from, but the difference between up and down is within "
    "its uncertainty; go up and down again, by the same steps",
    "narrow": "up and down differ within {width:.2g} K near {T:.3g} °C{axis} by more than beside it, as in "
    "a narrow loop, or where the bias jumped: whether it remembers is not known; go up and down again, by the same "
    "steps",
    "none": "what is between up and down is no more than noise",
    "seen": "what a free curve leaves goes with where the temperature came from",
}

Answer = Literal["seen", "none", "undecided"]


@dataclass(frozen=True, eq=False)
class MemoryVerdict:
    """Evidence of a soak for memories, in SI; d axes."""

    answer: Answer  # "seen", "none" (larger than `none_larger_than`), or "undecided" (not known from this soak)
    # kinds of effects that the soak cannot tell from one another, the likeliest first; empty unless seen
    kinds: tuple[str, ...]
    size: Array  # (d,): warming less cooling where it is largest; NaN where it is unknown
    sigma: Array  # (d,): its standard deviation
    # (d,): up less down, where it is largest, that would have shown with 95 %; infinite where it is unknown
    none_larger_than: Array
    where: Array  # (d,): temperature of the largest difference, degC; NaN where it is unknown
    why: str  # reason of the answer; where it is undecided, which soak would tell
    # natural logarithm of how much likelier the soak is with a memory than without; NaN where it was not looked for
    evidence: float = np.nan
    together: bool = False  # whether more than one kind is there at once
    T: Array = field(default_factory=lambda: np.empty(0))  # (G,), degC; empty where nothing is known
    # (G, d): warming less cooling there in the mean over the sweeps, if there is a memory, and its standard deviation
    difference: Array = field(default_factory=lambda: np.empty((0, 0)))
    spread: Array = field(default_factory=lambda: np.empty((0, 0)))
    period: float = np.nan  # s, of a tone in time that explains as much; NaN: none was looked for, or found
    over: float = 0.0  # K: a memory that spans as much has been looked for; a narrower one shows where it stands out

    @classmethod
    def unknown(cls, d: int, why: str) -> MemoryVerdict:
        """Return the undecided verdict on d axes, and why."""
        nothing = np.full(d, np.nan)
        return cls("undecided", (), nothing, nothing, np.full(d, np.inf), nothing, why)

    @property
    def probability(self) -> float:
        """Posterior probability of a memory, from equal prior odds; 0 where it is unknown."""
        return float(1 / (1 + np.exp(-np.clip(self.evidence, -500, 500)))) if np.isfinite(self.evidence) else 0.0

    @property
    def apart(self) -> Flags:
        """Axes (d,) on which up and down are seen to differ."""
        return np.asarray((self.answer == "seen") & (np.abs(self.size) > CLEAR * self.sigma), dtype=np.bool_)

    @property
    def called(self) -> str:
        """The kinds that the soak cannot tell from one another, in words; of several there together, that too."""
        if self.together:
            return f"{' and '.join(self.kinds[:2])} together" + (
                f" ({', '.join(self.kinds[2:])} too)" if self.kinds[2:] else ""
            )
        return " or ".join(self.kinds) + (" (one cannot tell which)" if len(self.kinds) > 1 else "")

    def variance(self, T: Array, without_spread: Flags | None = None) -> Array:
        """Return the mean square (N, d) of half of what is between up and down at T (N,), as probable as it is.

        Its deviation is left out on some axes (d,).
        """
        d = len(self.size)
        if not len(self.T):
            return np.zeros((len(T), d))
        spread = self.spread if without_spread is None else np.where(without_spread, 0.0, self.spread)
        squares = self.probability * (self.difference**2 + spread**2) / 4
        some = ~np.isnan(squares[:, 0])
        if not np.any(some):
            return np.zeros((len(T), d))
        return np.stack([np.interp(T, self.T[some], column[some]) for column in squares.T], axis=1)

    def as_json(self) -> dict[str, Any]:
        """Return it for programs, in SI; null where a number is unknown."""
        names = {"size": "size", "sigma": "sigma", "none_larger_than": "none_larger_than", "at_degC": "where"}
        numbers = {key: [_finite(value) for value in getattr(self, name)] for key, name in names.items()}
        rest = {"log_evidence": _finite(self.evidence), "why": self.why}
        return {"answer": self.answer, "kinds": list(self.kinds), **numbers, **rest}


def memory_of(soak: SoakSummary) -> MemoryVerdict:
    """Return the evidence of a soak for memories of temperature, of all kinds of effects that are installed."""
    d = soak.bias.shape[1]
    reason = _unseen(soak)
    if reason:
        return MemoryVerdict.unknown(d, WHY[reason])
    with one_thread():
        return _beside_tones(soak, shapes_of(soak), None, TONES)


def _beside_tones(soak: SoakSummary, shapes: MemoryShapes, lines: Array | None, more: int) -> MemoryVerdict:
    """Return the verdict beside the lines (S, q) of tones in time, and beside so many more that explain as much."""
    d, contrasts = soak.bias.shape[1], SoakContrasts(soak, lines)
    if not contrasts.laws or not shapes.kinds:
        return MemoryVerdict.unknown(d, WHY["short" if np.all(contrasts.known) else "coarse"])
    z = np.repeat(contrasts.of(shapes.added)[:, :, None], d, axis=2)
    followed, slots, curves = np.empty((2, len(contrasts.Q[::THIN]), 0, d)), np.empty((len(soak.T), 0, d)), None
    if shapes.inputs.size:
        noises = np.argmax(contrasts.without, axis=0)
        slots, added, followed, curves = contrasts.added_by_inputs(shapes.inputs, noises)
        z = np.concatenate([z, added], axis=1)
    test = _MemoryTest(ShapeEvidence(contrasts, z, shapes.kinds, followed), slots, shapes, curves)
    verdict = test.verdict()
    if not more or not np.isfinite(verdict.period):
        return verdict
    own = test.tone[2]
    beside = _beside_tones(soak, shapes, own if lines is None else np.column_stack([lines, own]), more - 1)
    if beside.answer == "seen":
        return beside
    return replace(beside, answer="undecided", none_larger_than=np.full(d, np.inf), why=verdict.why)


def _unseen(soak: SoakSummary) -> str:
    """Return the reason why no soak like this shows a memory, a key of WHY; empty where it may."""
    warms, cools = (bool(np.any(soak.way == way)) for way in WAYS.values())
    if not (warms and cools):
        return "warms" if warms else "cools" if cools else "no way"
    both = (soak.cells(1)[0] > 0) & (soak.cells(-1)[0] > 0)
    if np.mean(both) < SHARED:
        return "apart"
    return "short" if len(soak.T) < 2 * MIN_CONTRASTS else ""


def _narrow(soak: SoakSummary) -> dict[str, Any] | None:
    """Return the cell of temperature in which up and down differ by more than beside it, as WHY has it; None: no cell.

    Blocks of a soak are too wide for it. Differences of cells are as unsure as their samples' white noise and a robust
    deviation of all cells say. One recording alone is looked at: several have levels of their own.
    """
    T, difference, n, below_n = soak.between_ways()
    if len(np.unique(soak.recording)) > 1 or len(T) < MIN_CONTRASTS:
        return None
    own = np.arange(-BESIDE, BESIDE + 1) != 0
    off = difference[BESIDE:-BESIDE] - np.median(sliding_window_view(difference, len(own), axis=0)[..., own], axis=2)
    white = (1 / n + 1 / below_n)[BESIDE:-BESIDE, None] * soak.white**2
    usual = np.median(off**2, axis=0) / 0.455  # of chi-square with one degree of freedom
    long = (n + below_n)[BESIDE:-BESIDE, None]  # in a cell: a walk grows with it
    sigma = np.sqrt(white + np.maximum(usual - np.median(white, axis=0), 0.0) * np.maximum(long / np.median(long), 1.0))
    beyond = np.abs(off) / np.maximum(sigma, np.finfo(float).tiny)
    cell, axis = np.unravel_index(int(np.argmax(beyond)), beyond.shape)
    if not beyond[cell, axis] > NARROW:
        return None
    d = soak.bias.shape[1]
    name = "" if d == 1 else f", on axis {'xyz'[axis] if d == 3 else axis + 1},"
    return {"width": float(np.ptp(soak.domain)) / CELLS, "T": float(T[BESIDE + cell]), "axis": name}


@dataclass(frozen=True, eq=False)
class _MemoryTest:
    """Shapes, their evidence, and the bias that inputs add on the slots (S, I, d)."""

    evidence: ShapeEvidence
    slots: Array
    shapes: MemoryShapes
    curves: FollowingCurves | None
    lasting: bool = False  # whether what settles with the time alone opens nothing

    @property
    def contrasts(self) -> SoakContrasts:
        """Contrasts of the soak."""
        return self.evidence.contrasts

    def verdict(self) -> MemoryVerdict:
        """Return the answer."""
        total = self.evidence.total
        seen = total > SEEN
        unseen = self._larger()
        reach = np.ptp(self.contrasts.blocks.bias, axis=0)
        if not np.any(unseen < np.maximum(reach, 1e-300)):  # an axis that hardly moves is as sure as the others
            unseen = np.full_like(unseen, np.inf)
        settles = self.evidence.alone(self.shapes.settling)
        sized = self if total <= HINT else self._following()
        if not (settles > HINT and total - settles < SEEN):  # how far it would open says nothing of a memory
            sized = replace(sized, lasting=True)
        noise = np.argmax(self.evidence.noises, axis=0)
        pairs = Pairs.of(sized.evidence, noise, PAIRS) if seen else None
        size, sigma, where, T, difference, spread = sized._sizes(pairs, self.evidence)
        why, about = self._why(settles, clear=bool(np.any(np.abs(size) > CLEAR * sigma)))
        if why in ("brief", "settles", "jump", "tone", "slight", "narrow"):
            unseen = np.full_like(unseen, np.inf)
        if why == "none" and not np.all(np.isfinite(unseen)):
            why = "levels" if self._divided else "weak"
        answer: Answer = "seen" if why == "seen" else "none" if why == "none" else "undecided"
        named = about | {"period": duration(period)} if (period := about.get("period")) else about
        reason = "; ".join([WHY[why].format(**named), *(f"could not be tried: {text}" for text in self.shapes.broken)])
        kinds, both = self._kinds(pairs) if pairs is not None and why == "seen" else ((), False)
        over = float(np.ptp(self.contrasts.soak.domain)) * (2 * BESIDE + 1) / CELLS
        return MemoryVerdict(
            answer, kinds, size, sigma, unseen, where, reason, total, both, T, difference, spread,
            about.get("period", np.nan), over,
        )  # fmt: skip

    def _why(self, settles: float, *, clear: bool) -> tuple[str, dict[str, Any]]:
        """Return the reason, a key of WHY, with what it names; `clear`: whether the size is beyond its uncertainty.

        What is much likelier with a memory may be as likely with another cause, as where the bias `settles`.
        """
        total, contrasts, why = self.evidence.total, self.contrasts, "none"
        if total > SEEN:
            jump, when = of_a_jump(contrasts)
            rivals = {"brief": self.evidence.as_they_are(self.shapes.brief), "settles": settles, "jump": jump}
            rival = max(rivals, key=rivals.__getitem__)
            if total - rivals[rival] < SEEN:
                return rival, {"hours": (when - contrasts.soak.t[0]) / 3600}
            if total - self.tone[0] < SEEN:
                return "tone", {"period": self.tone[1]}
            if clear:
                return "seen", {}
            why = "slight"
        elif total > HINT:
            why = "hint"
        narrow = _narrow(contrasts.soak)
        return (why, {}) if narrow is None else ("narrow", narrow)

    @cached_property
    def tone(self) -> tuple[float, float, Array]:
        """Log evidence of a tone in time, its period, s, and its lines (S, q)."""
        return tone_of(self.contrasts)

    def _following(self) -> _MemoryTest:
        """Return the same of shapes whose curves follow their inputs, estimated from the soak: for their sizes."""
        if self.curves is None:
            return self
        slots = self.curves.added
        return replace(self, evidence=self.evidence.with_inputs(self.contrasts.of(slots)), slots=slots)

    @property
    def _divided(self) -> bool:
        """True if each recording goes one way only."""
        ways, recordings = self.contrasts.soak.way, self.contrasts.soak.recording
        return all(len(np.unique(ways[(recordings == k) & (ways != 0)])) < 2 for k in np.unique(recordings))

    @cached_property
    def _sweeps(self) -> Sweeps:
        sweeps = Sweeps(self.contrasts.soak, self.shapes.added[:, :, None], self.slots)
        if self.lasting:
            sweeps.shown[:, :, self.shapes.settling] *= 0.0
        return sweeps

    @cached_property
    def _openings(self) -> tuple[Array, Array]:
        return self._sweeps.openings()

    def _larger(self) -> Array:
        """Return the largest opening (d,) of a shape that is seen with less than 95 %."""
        noises = np.argmax(self.evidence.noises, axis=0)
        alike = np.empty((len(self.shapes.kinds),) * 2 + noises.shape)
        for axis, noise in enumerate(noises):
            gram = self.contrasts.gram(int(noise), self.evidence.z[:, :, axis])
            size = np.maximum(np.diag(gram), 1e-300)
            alike[:, :, axis] = gram**2 / size / size[:, None]
        sizes = self.evidence.would_show(np.minimum(alike, 1.0)) * np.abs(self._openings[0])
        return np.asarray(np.max(sizes[~self.shapes.settling], axis=0) * self.contrasts.scale)

    def _kinds(self, pairs: Pairs) -> tuple[tuple[str, ...], bool]:
        """Return the kinds that are likely, the likeliest first, and whether two of them are there together."""
        names, each = [{kind} for kind in self.shapes.kinds], self.evidence.weights
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

    def _sizes(self, pairs: Pairs | None, evidence: ShapeEvidence) -> tuple[Array, ...]:
        """Return size, sigma, where (d,) and T (G,), difference and spread (G, d): over all shapes, as likely as each.

        Of pairs of shapes too, where they are given.
        """
        mean, variance = self.evidence.estimates
        opening, at = self._openings
        per_kelvin = self._sweeps.mean_differences()
        formed = self._forms(evidence)
        power = pairs.power if pairs is not None else 1.0
        share = 1 / (1 + np.exp(power * np.clip(pairs.evidence, -500, 500))) if pairs is not None else 1.0
        weights, forms = evidence.tempered(power) * share, formed
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
        both = self._sweeps.both_ways() & (np.arange(len(mean)) >= evidence.added)[:, None]
        among[: len(mean)] = np.where(both, np.abs(among[: len(mean)]) * sign, among[: len(mean)])
        size, sigma = _mixed(weights, among, np.array(variances), forms)
        difference, spread = _mixed(weights, np.array(curves), np.array(spreads), forms)
        where = at[int(np.argmax(evidence.weights))]
        scale = self.contrasts.scale
        return size * scale, sigma * scale, where, self._sweeps.T, difference * scale, spread * scale

    def _forms(self, evidence: ShapeEvidence) -> Array:
        """Return the relative error of the form of each shape (J, d): that of a curve is an estimate."""
        forms = np.full(self.evidence.z.shape[1:], FORM)
        if self.curves is None:
            return forms
        inputs, noises = self.shapes.inputs, np.argmax(evidence.noises, axis=0)
        there = Sweeps(self.contrasts.soak, inputs[:, :, None]).shown[..., 0]
        above, below, g = self._sweeps.widest(self._sweeps.shown[:, :, evidence.added :])
        ends = there[np.stack([above, below]), g, np.arange(len(g))[:, None]]
        up, down = self.contrasts.curve(np.nan_to_num(ends).ravel()).reshape(*ends.shape, -1)
        between = up - down
        s2 = np.nan_to_num(np.take_along_axis(evidence.left, noises[None], axis=0)[0]) / evidence.m
        variances = self.contrasts.form_variances(self.curves, noises, np.maximum(s2, FINEST), between)
        wide = np.abs(self._openings[0][evidence.added :])
        some = wide > 0
        forms[evidence.added :] = np.hypot(FORMED, np.sqrt(variances) / np.where(some, wide, np.inf))
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
