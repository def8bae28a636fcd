"""Candidates for missing effects: all that the installed effects propose for these recordings, by family.

Probes: effects without a name, in forms general enough to catch most of what no effect names.

A probe takes part in the search like an effect, but is only a nuisance: it keeps what has no name from being given a
wrong one, and is reported as unexplained, on its channel and at its time scale.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from functools import partial
from typing import Annotated, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import Field, ValidationError

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.least_squares import Term
from driftlab.identification.records import with_residuals
from driftlab.identification.state import Search, name_of
from driftlab.units import duration
from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.plugin import built_in
from fusion_core.contracts.table import auxiliary
from fusion_core.errors import ConfigError, FusionError, MissingChannel, PluginError, quote
from fusion_core.host.registry import kind_of, registry
from fusion_core.settings import did_you_mean

MAX_POWER = 6  # of temperature above which a map needs no further ones
MAX_MEMORIES = 2  # of one channel: no data separate three exponentials (C. Lanczos, Applied Analysis (1956), IV.23)

Offered = TypeVar("Offered")
Family = tuple[str, str, int, bool]  # name, form, coefficients, and whether the start is free


def candidates_of(search: Search) -> dict[Family, list[Term]]:
    """Return the proposals of every installed effect for these recordings, by family, less those of the model.

    An effect that is broken is left out, and so is one of a third party whose regressors are another's; both are noted
    in the search.
    """
    chunks = with_residual(search)
    degree = _degree(search, chunks)
    families: dict[Family, list[Term]] = {}
    before: list[Effect] = []
    for cls, offers in offers_by_kind(partial(_offers, search, chunks, degree), search.without, search.broken):
        for effect in offers:
            other = None if built_in(cls) else same(search.columns, effect, before)
            if other is not None:
                search.same[name_of(effect)] = name_of(other)
                continue
            before.append(effect)
            for free in (False, True) if search.columns.of(effect).starts is not None else (False,):
                term = Term(effect, free)
                families.setdefault(family_of(search, term), []).append(term)
    return families


def offers_by_kind(
    offers: Callable[[type[Effect]], list[Offered]], without: Collection[str], broken: dict[str, str]
) -> Iterator[tuple[type[Effect], list[Offered]]]:
    """Yield the installed effects and their offers; those that do not keep their contract are noted as `broken`."""
    for cls in installed():
        kind = kind_of(cls)
        if kind in without or kind in broken:
            continue
        try:
            yield cls, offers(cls)
        except MissingChannel:
            continue
        except FusionError as error:
            broken[kind] = str(error)


def proposals(cls: type[Effect], axes: tuple[str, ...], chunks: Sequence[Chunk], degree: int | None) -> list[Effect]:
    """Return the proposals of a class for recordings, beside a map with powers of temperature up to `degree`.

    Raises PluginError if the class has settings without a default.
    """
    try:
        blank = cls(axes=axes)  # type: ignore[call-arg]
    except ValidationError:
        raise PluginError(f"{kind_of(cls)}: has settings without a default, and cannot be proposed") from None
    able = (one for one in blank.proposals(chunks) if set(one.requires) <= set(chunks[0].channels))
    return [effect for one in able if (effect := one.beside_map(degree)) is not None]


def installed() -> list[type[Effect]]:
    """Return the installed effects, those that came with driftlab first, then by kind."""
    classes = [cls for cls in registry().classes(Effect).values() if issubclass(cls, Effect)]
    return sorted(classes, key=lambda cls: (not built_in(cls), kind_of(cls)))


def check_kinds(kinds: Collection[str], option: str = "--without") -> None:
    """Raise ConfigError where one of the kinds, which `option` names, is no installed effect's."""
    known = [kind_of(cls) for cls in installed()]
    for kind in kinds:
        if kind not in known:
            advice = did_you_mean(kind, known, f"known: {', '.join(known)}")
            raise ConfigError(f"{option} {quote(kind)}: is no installed effect; {advice}")


def _offers(search: Search, chunks: Sequence[Chunk], degree: int | None, cls: type[Effect]) -> list[Effect]:
    """Return the proposals of a class that the model can take, their columns worked out."""
    columns, offers = search.columns, []
    have = {name_of(term.effect) for term in search.model if not term.effect.several}
    memories = [term.effect.subject for term in search.model if term.effect.fades]
    acting = columns.basis is None or any(term.effect.acts_on_input for term in search.model)
    for effect in proposals(cls, search.evidence.axes, chunks, degree):
        if name_of(effect) in have or (effect.acts_on_input and acting):
            continue
        if effect.fades and memories.count(effect.subject) >= MAX_MEMORIES:
            continue
        regressors = columns.of(effect)
        if effect.acts_on_input:
            columns.of_map([effect])
        elif not any(map(len, regressors.columns)):
            continue
        offers.append(effect)
    return offers


def same(columns: EffectRegressors, effect: Effect, others: Sequence[Effect]) -> Effect | None:
    """Return the first of others that reads the same channels and has the same regressors as an effect, if any."""
    reads = set(effect.requires)
    for other in others:
        also = set(other.requires)
        if (reads <= also or also <= reads) and bool(reads) == bool(also) and _same_span(columns, effect, other):
            return other
    return None


def _same_span(columns: EffectRegressors, effect: Effect, other: Effect) -> bool:
    for axis in range(len(columns.y)):
        for one, two in zip(_spans(columns, effect, axis), _spans(columns, other, axis), strict=True):
            if len(one) != len(two) or not (columns.within(one, two) and columns.within(two, one)):
                return False
    return True


def _spans(columns: EffectRegressors, effect: Effect, axis: int) -> tuple[Integers, Integers]:
    """Return the columns of an effect, through the map too where it acts there, and those of its starts."""
    own, none = columns.of(effect), np.zeros(0, dtype=np.intp)
    of_map = columns.of_map([effect]) if effect.acts_on_input else none
    return np.concatenate([of_map, own.columns[axis]]), none if own.starts is None else own.starts


def _degree(search: Search, chunks: Sequence[Chunk]) -> int | None:
    """Return the highest power of temperature that the map has already; None where it has all that matter."""
    q = search.columns.of_map([])
    if not len(q):
        return 0
    X = search.columns.W[:, q]
    T = np.concatenate([chunk["temperature"] for chunk in chunks])
    x = [(chunk["temperature"] - T.min()) / max(np.ptp(T), 1e-300) * 2 - 1 for chunk in chunks]
    for k in range(1, MAX_POWER + 1):
        power = search.evidence.rows([part**k for part in x])
        for rows in search.evidence.slices:
            power[rows] -= power[rows].mean()
        left = power - X @ np.linalg.lstsq(X, power, rcond=1e-10)[0]
        if np.linalg.norm(left) > 1e-3 * np.linalg.norm(power):
            return k - 1
    return None


def family_of(search: Search, term: Term) -> Family:
    """Return the properties that a term shares with those that differ from it by their hyper-parameters alone."""
    effect = term.effect
    return name_of(effect), effect.variant, search.columns.of(effect).p, term.free


def with_residual(search: Search) -> list[Chunk]:
    """Return the recordings' means with the model's residual as channel `residual`, in its own deviation.

    The model's prediction is taken to run straight between rows: lines faster than rows stay where they are.
    """
    evidence, columns = search.evidence, search.columns
    left = np.stack(search.residuals(search.model), axis=1) * columns.scale[columns.y]
    residuals = []
    for record, predicted in zip(evidence.records, evidence.split(evidence.rate - left), strict=True):
        of_model = np.stack([np.interp(record.chunk.t, record.t, column) for column in predicted.T], axis=1)
        residuals.append(evidence.excess(record.chunk) - of_model)
    return with_residuals(evidence.chunks, residuals)


PROBE_INTERVALS = 12  # of a probe's smooth function


class Probe(Effect):
    """Any smooth function of a channel, by itself or in proportion to it at any temperature, or the channel late."""

    kind: Literal["probe"] = "probe"
    explanation: ClassVar = "a probe of the residual, no physical effect"
    channel: str
    form: Literal["function", "with temperature", "late"] = "function"
    knots: tuple[float, ...] = ()
    tau: Annotated[float, Field(gt=0)] = 1.0

    @property
    def requires(self) -> tuple[str, ...]:
        """The channel, and temperature where it matters."""
        return (self.channel, "temperature") if self.form == "with temperature" else (self.channel,)

    def signature(self, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
        """Return the probe's regressors on each axis."""
        from fusion_core.recursions import lag

        values = chunk[self.channel]
        if self.form == "late":
            dt = np.ascontiguousarray(np.broadcast_to(chunk.dt, values.shape))
            before, y = (values[0], values[0]) if memory is None else memory
            late = lag(dt, values, self.tau, before, y)
            return on_each_axis(np.stack([values, late], axis=1), len(self.axes)), (float(values[-1]), float(late[-1]))
        along = chunk["temperature"] if self.form == "with temperature" else values
        hats = np.stack([np.interp(along, self.knots, row) for row in np.eye(len(self.knots))], axis=1)
        if self.form == "with temperature":
            hats = hats * values[:, None]
        return on_each_axis(hats, len(self.axes)), None

    @property
    def variant(self) -> str:
        """Its form."""
        return self.form

    @property
    def description(self) -> str:
        """The form in words."""
        return {
            "function": f"a smooth function of {self.channel}",
            "with temperature": f"{self.channel}, with an influence that changes with temperature",
            "late": f"{self.channel}, late by about {duration(self.tau)}",
        }[self.form]


def probes(chunks: Sequence[Chunk], axes: tuple[str, ...]) -> Iterator[Probe]:
    """Yield the probes of every auxiliary channel of the recordings."""
    names = [name for name in auxiliary(chunks) if name != "temperature" and chunks[0][name].ndim == 1]
    length = max(float(chunk.t[-1] - chunk.t[0]) for chunk in chunks)
    heat = _knots([chunk["temperature"] for chunk in chunks]) if "temperature" in chunks[0].channels else None
    for name in names:
        knots = _knots([chunk[name] for chunk in chunks])
        if knots is None:
            continue
        yield Probe(axes=axes, channel=name, form="function", knots=knots)
        if heat is not None:
            yield Probe(axes=axes, channel=name, form="with temperature", knots=heat)
        for tau in np.geomspace(30.0, max(100.0, length / 4), 5):
            yield Probe(axes=axes, channel=name, form="late", tau=float(tau))


def _knots(parts: list[Array]) -> tuple[float, ...] | None:
    values = np.concatenate(parts)
    low, high = (float(v) for v in np.quantile(values, [0.005, 0.995]))
    return tuple(float(v) for v in np.linspace(low, high, PROBE_INTERVALS + 1)) if low < high else None
