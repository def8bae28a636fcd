"""What may be missing: all that the installed effects propose for these recordings, by family."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from driftlab.loop.least_squares import Term
from driftlab.loop.state import Search, name_of
from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.host.registry import registry

HIGHEST = 6  # power of temperature above which a map needs no further ones
MEMORIES = 2  # of one channel: no data separate three exponentials (C. Lanczos, Applied Analysis (1956), IV.23)

Family = tuple[str, str, int, bool]  # name, form, coefficients, and whether the start is free


def offered(found: Search) -> dict[Family, list[Term]]:
    """Return what every installed effect offers on these recordings, by family, as far as the model has not got it."""
    chunks = with_residual(found)
    have = {name_of(term.effect) for term in found.model if term.effect.kind not in ("periodic", "relaxation")}
    degree = _degree(found, chunks)
    memories = [term.effect.subject for term in found.model if term.effect.fades]
    families: dict[Family, list[Term]] = {}
    for cls in registry().classes(Effect).values():
        blank = cls(axes=found.columns.evidence.axes)  # type: ignore[call-arg]
        for effect in blank.proposals(chunks):  # type: ignore[attr-defined]
            if not set(effect.requires) <= set(chunks[0].channels) or name_of(effect) in have:
                continue
            if effect.kind == "curve" and effect.subject == "temperature":
                if degree == HIGHEST:
                    continue
                effect = effect.model_copy(update={"above": degree})
            if effect.acts_on_input and (
                found.columns.basis is None or any(t.effect.acts_on_input for t in found.model)
            ):
                continue
            if effect.fades and memories.count(effect.subject) >= MEMORIES:
                continue
            shown = found.columns.of(effect)
            if not effect.acts_on_input and not any(map(len, shown.columns)):
                continue
            for free in (False, True) if shown.starts is not None else (False,):
                term = Term(effect, free)
                families.setdefault(family_of(found, term), []).append(term)
    return families


def _degree(found: Search, chunks: Sequence[Chunk]) -> int:
    """Return the highest power of temperature that the map has already."""
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
    return HIGHEST


def family_of(found: Search, term: Term) -> Family:
    """Return what a term has in common with those that differ from it by their hyper-parameters alone."""
    effect = term.effect
    return name_of(effect), str(getattr(effect, "form", "")), found.columns.of(effect).p, term.free


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
