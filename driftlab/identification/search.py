"""Forward selection of effects: of those with enough evidence, what predicts left-out recordings best.

All candidates that the installed effects propose are tried beside the model so far, each family at its best
hyper-parameters. Those of a family are chosen by training error, anew for each part that is left out; with a memory,
those of the memories in the model are chosen with it, since two memories found one after the other are not the best
two. A memory is tried from equilibrium and from an unknown start. What passes (`driftlab.identification.acceptance`) is
ranked by its left-out error, and the first must carry over from one part of its inputs' range to the rest
(`driftlab.identification.input_range`); a simpler one within its uncertainty goes first, and those that neither
left-out errors nor likelihood tell from it are its rivals.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

import numpy as np

from driftlab.identification.candidates import candidates_of
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import parts
from driftlab.identification.input_range import does_not_carry_over
from driftlab.identification.least_squares import LeastSquares, Model, Term
from driftlab.identification.records import Evidence as Recordings
from driftlab.identification.state import Progress, Search, Trial, name_of, noises_of
from driftlab.identification.trials import (
    AS_GOOD,
    as_good,
    blocks_of,
    contains,
    difference,
    left_out_errors,
    tried,
    uncertainty,
)
from fusion_core.contracts import Basis, Effect
from fusion_core.errors import FusionError

MOST = 4  # effects that are added


def search(
    evidence: Recordings,
    basis: Basis | None,
    progress: Progress,
    declared: Sequence[Effect] = (),
    without: Collection[str] = (),
) -> Search:
    """Find the effects that the model lacks; those that are declared already are fitted with the others.

    Kinds `without` are not tried.
    """
    columns = EffectRegressors(evidence, basis)
    d = len(evidence.axes)
    squares = LeastSquares(columns, np.full(d, 1e-4), np.ones(d))
    own = tuple(Term(effect, any(effect.initial or ())) for effect in declared)
    found = Search(squares, progress, own, own, parts(columns), without=frozenset(without))
    found.fresh()
    while len(found.added) < MOST and _add(found):
        _merge(found)
        _refine(found)
        found.fresh()
        _drop(found)
    return found


def _add(found: Search) -> bool:
    """Try all that is offered beside the model, and add the best; return whether there is one."""
    families = candidates_of(found)
    found.tried = max(found.tried, len({repr(term.effect) for terms in families.values() for term in terms}))
    found.progress(f"trying {found.tried} candidates" + (f" beside {_listed(found.model)}" if found.model else ""))
    trials = tried(found, found.model, families)
    while True:
        found.trials = trials
        passing = [trial for trial in trials if trial.passes]
        passing = [t for t in passing if not any(_waits(found, t, other) for other in passing)]
        passing = [t for t in passing if t.evidence.fast] or passing
        if not passing:
            return False
        chosen = _best(passing)
        reason = does_not_carry_over(found, chosen)
        if not reason:
            break
        trials = [replace(t, passes=False, reason=reason) if t is chosen else t for t in trials]
    own = name_of(chosen.term.effect)
    rivals = tuple(t for t in passing if name_of(t.term.effect) != own and as_good(t, chosen))
    rivals = tuple(t for t in rivals if not does_not_carry_over(found, t))
    found.trials = [t for t in trials if t is not chosen]
    found.model = chosen.model
    found.added.append((chosen, rivals))
    for k in reversed(range(len(found.declared), len(found.model) - 1)):
        if contains(found.columns, chosen.term, found.model[k]):
            _remove(found, k)
    return True


def _remove(found: Search, k: int) -> None:
    """Take a term out of the model, and its trial."""
    found.model = (*found.model[:k], *found.model[k + 1 :])
    del found.added[k - len(found.declared)]


def _best(passing: Sequence[Trial]) -> Trial:
    """Return the trial that predicts left-out parts best; of those within its uncertainty the likeliest, or a simpler.

    Likelihood alone ranks badly for coasting, but it tells shapes apart that coast alike.
    """
    first = min(passing, key=lambda trial: trial.evidence.ratio)
    near = [t for t in passing if difference(t, first) <= uncertainty(t, first)]
    likeliest = max(t.likelihood for t in near)
    return min(
        (t for t in near if t.likelihood > likeliest - AS_GOOD), key=lambda trial: (trial.size, trial.evidence.ratio)
    )


def _merge(found: Search) -> None:
    """Put one effect in the place of two of the same channel where it predicts left-out parts as well."""
    new, first = found.model[-1], len(found.declared)
    same = [k for k in range(first, len(found.model) - 1) if found.model[k].effect.requires == new.effect.requires]
    if not same or new.effect.subject == "temperature":
        return
    k, pair = same[0], found.model
    base = tuple(term for i, term in enumerate(pair[:-1]) if i != k)
    found.model = base
    own = {f: terms for f, terms in candidates_of(found).items() if terms[0].effect.requires == new.effect.requires}
    found.model = pair
    if not own:
        return
    noises = noises_of(found, pair)
    both = blocks_of(left_out_errors(found, [pair] * len(found.left_out), noises), found.axes)
    single = _best(tried(found, base, own))
    two = replace(single, blocks=both)
    as_well = single.evidence.fast and difference(single, two) <= uncertainty(single, two)
    if as_well and not does_not_carry_over(found, single):
        _remove(found, k)
        found.model, found.added[-1] = single.model, (single, ())


def _drop(found: Search) -> None:
    """Drop effects without which left-out parts are predicted as well: what was added later has taken their part."""
    for k in reversed(range(len(found.declared), len(found.model) - 1)):
        without = (*found.model[:k], *found.model[k + 1 :])
        if _left_out_square(found, without) <= _left_out_square(found, found.model):
            _remove(found, k)
            found.fresh()


def _left_out_square(found: Search, model: Model) -> float:
    """Return the log of the sum of squares of a model's left-out errors, mean over the axes."""
    errors = left_out_errors(found, [model] * len(found.left_out), noises_of(found, model))
    return float(np.mean(np.log(np.maximum(blocks_of(errors, found.axes).sum(axis=1), 1e-300))))


def _waits(found: Search, trial: Trial, other: Trial) -> bool:
    """Return whether a trial is to wait for another: that is a part of it, or what its channel does at once.

    What a part cannot show alone is asked for beside it, in the next round.
    """
    own, simple = trial.term, other.term
    if own is simple or other.size >= trial.size + int(own.effect.fades) or simple.free:
        return False
    of_channel = own.effect.requires == simple.effect.requires and own.effect.subject != "temperature"
    at_once = own.effect.fades and not simple.effect.fades and of_channel
    return at_once or (other.size < trial.size and contains(found.columns, own, simple))


def _listed(model: Model) -> str:
    return ", ".join(name_of(term.effect) for term in model)


def _refine(found: Search) -> None:
    """Refine continuous hyper-parameters by coordinate descent on the training error."""
    from scipy.optimize import minimize_scalar

    terms = list(found.model)
    for k, term in enumerate(terms):
        if term in found.declared:
            continue
        for name, value in term.effect.hyper_parameters.items():
            width = float(np.log(term.effect.continuous[name]))

            def varied(x: float, k: int = k, name: str = name, value: float = value) -> Model:
                effect = terms[k].effect.model_copy(update={name: value * float(np.exp(x))})
                return (*terms[:k], replace(terms[k], effect=effect), *terms[k + 1 :])

            def cost(x: float) -> float:
                model = varied(x)
                try:
                    fits = [found.squares.fit(model, axis, found.everything) for axis in range(len(found.columns.y))]
                except FusionError:  # beyond its grid an effect may not be what it should
                    return float("inf")
                return sum(float(np.log(max(fit.cost, 1e-300))) for fit in fits)

            found_at = minimize_scalar(cost, bounds=(-width, width), method="bounded", options={"xatol": width / 30})
            if found_at.fun < cost(0.0):
                terms[k] = varied(float(found_at.x))[k]
    found.model = tuple(terms)
