"""Forward selection of effects: of those with enough evidence, the one that predicts left-out recordings best.

All candidates that the installed effects propose are tried beside the model so far, each family at its best
hyper-parameters. Those of a family are chosen by training error, anew for each part that is left out; with a memory,
those of the memories in the model are chosen with it, since two memories found one after the other are not the best
two. A memory is tried from equilibrium and from an unknown start. What passes (`driftlab.identification.acceptance`) is
ranked by its left-out error, and the first must carry over from one part of its inputs' range to the rest; a simpler
one within its uncertainty goes first, and those that neither left-out errors nor likelihood tell from it are its
rivals.

Cross-validation by range, and not by time: of each channel that an effect reads, the rows in the highest fifth of its
range are left out, then those in the lowest. The coefficients come from the other rows; given these, map and levels are
fitted to all, and the rows left out are predicted with the effect and without. They may be predicted worse by what
three deviations of the coefficients make of them: an effect that is merely not seen in the rest does no harm there, and
one that is seen and wrong does. A function of temperature alone is the map's, whose own domain holds it. n rows.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np

from driftlab.identification.acceptance import WORSE
from driftlab.identification.candidates import candidates_of
from driftlab.identification.cross_validation import MIN_ROWS, condition
from driftlab.identification.least_squares import AxisFit, LeastSquares, Model, Term, without_term
from driftlab.identification.records import Evidence, Progress
from driftlab.identification.state import Search, Trial, name_of
from driftlab.identification.trials import AS_GOOD, as_good, blocks_of, contains, difference, tried, uncertainty
from fusion_core.chunk import Flags
from fusion_core.contracts import Basis, Effect
from fusion_core.errors import FusionError

MAX_EFFECTS = 4  # that are added
END = 0.2  # of the range: rows at either end that are left out
SURE = 3.0  # deviations of the coefficients


def search(
    evidence: Evidence,
    basis: Basis | None,
    progress: Progress,
    declared: Sequence[Effect] = (),
    without: Collection[str] = (),
) -> Search:
    """Find the effects that the model lacks; those that are declared already are fitted with the others.

    Kinds `without` are not tried.
    """
    terms = tuple(Term(effect, any(effect.initial or ())) for effect in declared)
    state = Search.begun(evidence, basis, progress, terms, without)
    while len(state.added) < MAX_EFFECTS and _add(state):
        _merge(state)
        _refine(state)
        state.fresh()
        _drop(state)
    return state


def _add(state: Search) -> bool:
    """Try all candidates beside the model, and add the best; return whether there is one."""
    families = candidates_of(state)
    state.tried = max(state.tried, len({repr(term.effect) for terms in families.values() for term in terms}))
    beside = ", ".join(name_of(term.effect) for term in state.model)
    state.progress(f"trying {state.tried} candidates" + (f" beside {beside}" if beside else ""))
    trials = tried(state, state.model, families)
    while True:
        state.trials = trials
        passing = [trial for trial in trials if trial.passes]
        passing = [t for t in passing if not any(_waits(state, t, other) for other in passing)]
        passing = [t for t in passing if t.evidence.fast] or passing
        if not passing:
            return False
        chosen = _best(passing)
        reason = does_not_carry_over(state, chosen)
        if not reason:
            break
        trials = [replace(t, passes=False, reason=reason) if t is chosen else t for t in trials]
    rivals = [t for t in passing if t.name != chosen.name and as_good(t, chosen) and not does_not_carry_over(state, t)]
    state.trials = [t for t in trials if t is not chosen]
    state.model = chosen.model
    state.added.append((chosen, tuple(rivals)))
    for k in reversed(range(len(state.declared), len(state.model) - 1)):
        if contains(state.columns, chosen.term, state.model[k]):
            _remove(state, k)
    return True


def _remove(state: Search, k: int) -> None:
    """Take a term out of the model, and its trial."""
    state.model = without_term(state.model, k)
    del state.added[k - len(state.declared)]


def _best(passing: Sequence[Trial]) -> Trial:
    """Return the trial that predicts left-out parts best; of those within its uncertainty the likeliest, or a simpler.

    Likelihood alone ranks badly for prediction, but it tells shapes apart that predict alike.
    """
    first = min(passing, key=lambda trial: trial.evidence.ratio)
    near = [t for t in passing if difference(t, first) <= uncertainty(t, first)]
    likeliest = max(t.likelihood for t in near)
    return min(
        (t for t in near if t.likelihood > likeliest - AS_GOOD), key=lambda trial: (trial.size, trial.evidence.ratio)
    )


def _merge(state: Search) -> None:
    """Put one effect in the place of two of the same channel where it predicts left-out parts as well."""
    new, first = state.model[-1], len(state.declared)
    same = [k for k in range(first, len(state.model) - 1) if state.model[k].effect.requires == new.effect.requires]
    if not same or new.effect.subject == "temperature":
        return
    k, pair = same[0], state.model
    state.model = base = without_term(pair[:-1], k)
    own = {f: terms for f, terms in candidates_of(state).items() if terms[0].effect.requires == new.effect.requires}
    state.model = pair
    if not own:
        return
    single = _best(tried(state, base, own))
    two = replace(single, blocks=blocks_of(state.errors_of(pair), state.axes))
    as_well = single.evidence.fast and difference(single, two) <= uncertainty(single, two)
    if as_well and not does_not_carry_over(state, single):
        _remove(state, k)
        state.model, state.added[-1] = single.model, (single, ())


def _drop(state: Search) -> None:
    """Drop effects without which left-out parts are predicted as well: later additions have taken their part."""
    for k in reversed(range(len(state.declared), len(state.model) - 1)):
        if _left_out_square(state, without_term(state.model, k)) <= _left_out_square(state, state.model):
            _remove(state, k)
            state.fresh()


def _left_out_square(state: Search, model: Model) -> float:
    """Return the log of the sum of squares of a model's left-out errors, mean over the axes."""
    blocks = blocks_of(state.errors_of(model), state.axes)
    return float(np.mean(np.log(np.maximum(blocks.sum(axis=1), 1e-300))))


def _waits(state: Search, trial: Trial, other: Trial) -> bool:
    """Return True if a trial is to wait for another: that is a part of it, or an effect of its channel without memory.

    A part that does not show alone is tried beside the other in the next round.
    """
    own, simple = trial.term, other.term
    if own is simple or other.size >= trial.size + int(own.effect.fades) or simple.free:
        return False
    of_channel = own.effect.requires == simple.effect.requires and own.effect.subject != "temperature"
    at_once = own.effect.fades and not simple.effect.fades and of_channel
    return at_once or (other.size < trial.size and contains(state.columns, own, simple))


def _refine(state: Search) -> None:
    """Refine continuous hyper-parameters by coordinate descent on the training error."""
    from scipy.optimize import minimize_scalar

    terms = list(state.model)
    for k, term in enumerate(terms):
        if term in state.declared:
            continue
        for name, value in term.effect.hyper_parameters.items():
            width = float(np.log(term.effect.continuous[name]))

            def varied(x: float, k: int = k, name: str = name, value: float = value) -> Model:
                effect = terms[k].effect.model_copy(update={name: value * float(np.exp(x))})
                return (*terms[:k], replace(terms[k], effect=effect), *terms[k + 1 :])

            def cost(x: float) -> float:
                model = varied(x)
                try:
                    fits = [state.fit(model, axis) for axis in state.all_axes]
                except FusionError:  # beyond its grid an effect may not be what it should
                    return float("inf")
                return sum(float(np.log(max(fit.cost, 1e-300))) for fit in fits)

            lowest = minimize_scalar(cost, bounds=(-width, width), method="bounded", options={"xatol": width / 30})
            if lowest.fun < cost(0.0):
                terms[k] = varied(float(lowest.x))[k]
    state.model = tuple(terms)


def does_not_carry_over(state: Search, trial: Trial) -> str:
    """Return the reason where the ends of a channel are predicted worse with the candidate; empty where none is."""
    squares, model = state.squares, trial.model
    for name in inputs(trial.term.effect):
        ends = list(_ends(state, name))
        logs = []
        for axis in state.axes:
            with_it, without = 0.0, 0.0
            for rows in ends:
                error, fit = _squares(squares, model, axis, rows)
                before, _ = _squares(squares, trial.base, axis, rows)
                with_it += max(error - SURE**2 * _chance(squares, model, axis, rows, fit), min(error, before))
                without += before
            logs += [float(np.log(with_it / without))] if with_it > 0 and without > 0 else []
        ratio = float(np.exp(np.mean(logs))) if logs else 1.0
        if ratio > WORSE:
            change = 100 * (float(np.sqrt(ratio)) - 1)
            return f"predicts the ends of the range of {name} {change:+.0f} %, fitted on the rest of it"
    return ""


def inputs(effect: Effect) -> tuple[str, ...]:
    """Return the channels of an effect whose range is looked at."""
    remembers = effect.fades or effect.memory_span is not None
    alone = set(effect.requires) <= {"temperature"} and not remembers
    return () if alone or effect.acts_on_input else tuple(dict.fromkeys(effect.requires))


def _ends(state: Search, name: str) -> Iterator[Flags]:
    """Yield the rows (n,) in the highest and in the lowest part of each column of a channel, where there are enough.

    Not of one that stands still in each recording, as an axis in a placement: its parts are whole recordings, which are
    left out one by one before.
    """
    values = state.evidence.rows([chunk[name].reshape(len(chunk), -1) for chunk in state.evidence.chunks])
    for u in values.T:
        low, high = float(u.min()), float(u.max())
        if max(float(np.ptp(part)) for part in state.evidence.split(u)) < END * (high - low):
            continue
        for rows in (u > high - END * (high - low), u < low + END * (high - low)):
            if MIN_ROWS <= np.sum(rows) <= len(u) - MIN_ROWS:
                yield rows


def _squares(squares: LeastSquares, model: Model, axis: int, rows: Flags) -> tuple[float, AxisFit]:
    """Return the sum of squares of the errors of rows that are left out, in the columns' scale, and the others' fit."""
    columns = squares.columns
    fit = squares.fit_rows(model, axis, ~rows)
    known = condition(squares, model, axis, fit, columns.everything)
    total = 0.0
    for r, own in enumerate(columns.evidence.slices):
        at = np.flatnonzero(rows[own]) + own.start
        cols = np.concatenate([columns.y[axis : axis + 1], known.cols, known.starts[:, r]])
        W = columns.W[np.ix_(at, cols)] + columns.means[r, cols]
        e = W[:, 0] - W[:, 1:] @ np.concatenate([known.beta, known.a[:, r]]) - known.levels[r]
        total += float(e @ e)
    return total, fit


def _chance(squares: LeastSquares, model: Model, axis: int, rows: Flags, fit: AxisFit) -> float:
    """Return the sum of squares that the uncertainty of the last term's coefficients makes of the rows left out."""
    columns = squares.columns.of(model[-1].effect).columns[axis]
    stop, p = len(squares.fixed(model, axis)), len(columns)
    own = np.arange(stop - p, stop)
    unit = np.zeros((len(fit.cols), p))
    unit[own, np.arange(p)] = 1.0
    noise = float(squares.colour[axis]) * fit.cost / max(int(np.sum(~rows)), 1)
    Z = squares.columns.W[np.ix_(rows, columns)]
    return noise * float(np.sum(fit.equations.solve(unit)[own] * (Z.T @ Z)))
