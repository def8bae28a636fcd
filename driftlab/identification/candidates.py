"""What may be missing: all that the installed effects propose for these recordings, by family.

Probes: what no effect names, in forms general enough to catch most of it.

A probe takes part in the search like an effect, but is only a nuisance: it keeps what has no name from being given a
wrong one, and is reported as unexplained, on its channel and at its time scale.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, ValidationError

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.config_edit import built_in
from driftlab.identification.least_squares import Term
from driftlab.identification.normal_equations import Indices
from driftlab.identification.state import Search, name_of
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.table import auxiliary
from fusion_core.errors import ConfigError, FusionError, MissingChannel, PluginError, shown
from fusion_core.host.registry import kind_of, registry
from fusion_core.settings import nearest

HIGHEST = 6  # power of temperature above which a map needs no further ones
MEMORIES = 2  # of one channel: no data separate three exponentials (C. Lanczos, Applied Analysis (1956), IV.23)

Family = tuple[str, str, int, bool]  # name, form, coefficients, and whether the start is free


def candidates_of(found: Search) -> dict[Family, list[Term]]:
    """Return what every installed effect offers on these recordings, by family, as far as the model has not got it.

    An effect that is broken is left out, and so is one of a third party that shows what another shows already; both
    are noted in the search.
    """
    chunks = with_residual(found)
    degree = _degree(found, chunks)
    families: dict[Family, list[Term]] = {}
    before: list[Effect] = []
    for cls in installed():
        kind = kind_of(cls)
        if kind in found.without or kind in found.broken:
            continue
        try:
            own = _offers(found, cls, chunks, degree)
        except MissingChannel:
            continue
        except FusionError as error:
            found.broken[kind] = str(error)
            continue
        for effect in own:
            other = None if built_in(cls) else same(found.columns, effect, before)
            if other is not None:
                found.same[name_of(effect)] = name_of(other)
                continue
            before.append(effect)
            for free in (False, True) if found.columns.of(effect).starts is not None else (False,):
                term = Term(effect, free)
                families.setdefault(family_of(found, term), []).append(term)
    return families


def installed() -> list[type[Effect]]:
    """Return the installed effects, those that came with driftlab first, then by kind."""
    classes = [cls for cls in registry().classes(Effect).values() if issubclass(cls, Effect)]
    return sorted(classes, key=lambda cls: (not built_in(cls), kind_of(cls)))


def check_kinds(kinds: Collection[str], option: str = "--without") -> None:
    """Raise ConfigError where one of the kinds, which `option` names, is no installed effect's."""
    have = [kind_of(cls) for cls in installed()]
    for kind in kinds:
        if kind not in have:
            hint = nearest(kind, have)
            raise ConfigError(
                f"{option} {shown(kind)}: is no installed effect; "
                + (f"did you mean {hint}?" if hint else f"known: {', '.join(have)}")
            )


def _offers(found: Search, cls: type[Effect], chunks: Sequence[Chunk], degree: int | None) -> list[Effect]:
    """Return what a class proposes and the model can take, its columns worked out; raises PluginError."""
    columns, own = found.columns, []
    have = {name_of(term.effect) for term in found.model if not term.effect.several}
    memories = [term.effect.subject for term in found.model if term.effect.fades]
    acting = columns.basis is None or any(term.effect.acts_on_input for term in found.model)
    try:
        blank = cls(axes=columns.evidence.axes)  # type: ignore[call-arg]
    except ValidationError:
        raise PluginError(f"{kind_of(cls)}: has settings without a default, and cannot be proposed") from None
    for proposed in blank.proposals(chunks):
        effect = proposed.beside_map(degree) if set(proposed.requires) <= set(chunks[0].channels) else None
        if effect is None or name_of(effect) in have or (effect.acts_on_input and acting):
            continue
        if effect.fades and memories.count(effect.subject) >= MEMORIES:
            continue
        shown = columns.of(effect)
        if effect.acts_on_input:
            columns.of_map([effect])
        elif not any(map(len, shown.columns)):
            continue
        own.append(effect)
    return own


def same(columns: EffectRegressors, effect: Effect, others: Sequence[Effect]) -> Effect | None:
    """Return the first of others that reads the same channels and shows exactly the same as an effect, if one does."""
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


def _spans(columns: EffectRegressors, effect: Effect, axis: int) -> tuple[Indices, Indices]:
    """Return the columns of an effect, through the map too where it acts there, and those of its starts."""
    shown = columns.of(effect)
    of_map = columns.of_map([effect] if effect.acts_on_input else [])[: None if effect.acts_on_input else 0]
    none = np.zeros(0, dtype=np.intp)
    return np.concatenate([of_map, shown.columns[axis]]), none if shown.starts is None else shown.starts


def _degree(found: Search, chunks: Sequence[Chunk]) -> int | None:
    """Return the highest power of temperature that the map has already; None where it has all that matter."""
    q = found.columns.of_map([])
    if not len(q):
        return 0
    X = found.columns.W[:, q]
    T = np.concatenate([chunk["temperature"] for chunk in chunks])
    x = [(chunk["temperature"] - T.min()) / max(np.ptp(T), 1e-300) * 2 - 1 for chunk in chunks]
    for k in range(1, HIGHEST + 1):
        power = found.columns.evidence.rows([part**k for part in x])
        for rows in found.columns.evidence.slices:
            power[rows] -= power[rows].mean()
        left = power - X @ np.linalg.lstsq(X, power, rcond=1e-10)[0]
        if np.linalg.norm(left) > 1e-3 * np.linalg.norm(power):
            return k - 1
    return None


def family_of(found: Search, term: Term) -> Family:
    """Return what a term has in common with those that differ from it by their hyper-parameters alone."""
    effect = term.effect
    return name_of(effect), effect.variant, found.columns.of(effect).p, term.free


def with_residual(found: Search) -> list[Chunk]:
    """Return the recordings' means with what the model leaves as channel `residual`, in its own deviation.

    What the model says is taken to run straight between rows: lines faster than rows are seen where they are.
    """
    evidence, columns = found.columns.evidence, found.columns
    chunks = []
    said = np.empty_like(evidence.rate)
    for axis in range(len(evidence.axes)):
        fit = found.squares.fit(found.model, axis, found.everything)
        left = found.squares.residual(axis, fit) * columns.scale[columns.y[axis]]
        said[:, axis] = evidence.rate[:, axis] - left
    for record, rows in zip(evidence.records, evidence.slices, strict=True):
        t, model = record.chunk.t, said[rows]
        of_model = np.stack([np.interp(t, record.t, model[:, axis]) for axis in range(model.shape[1])], axis=1)
        residual = record.chunk[evidence.channel] - of_model
        chunks.append(record.chunk.having(residual=residual))
    spread = np.maximum(np.std(np.concatenate([chunk["residual"] for chunk in chunks]), axis=0), 1e-300)
    return [chunk.having(residual=chunk["residual"] / spread) for chunk in chunks]


_SPLINES = 12


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

    def candidates(self) -> Iterator[Self]:
        """Yield itself."""
        yield self

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
        """What was found, in words."""
        return {
            "function": f"a smooth function of {self.channel}",
            "with temperature": f"{self.channel}, with an influence that changes with temperature",
            "late": f"{self.channel}, late by about {span(self.tau)}",
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
    return tuple(float(v) for v in np.linspace(low, high, _SPLINES + 1)) if low < high else None


def span(seconds: float) -> str:
    """Return a time span as one says it."""
    return (
        f"{seconds:.0f} s"
        if seconds < 600
        else f"{seconds / 60:.0f} min"
        if seconds < 7200
        else f"{seconds / 3600:.1f} h"
    )
