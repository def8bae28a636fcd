"""Forward selection of effects: of those with enough evidence, what predicts left-out recordings best.

All candidates that the installed effects propose are tried beside the model so far, each family at its best
hyper-parameters. Those of a family are chosen by training error, anew for each part that is left out; with a memory,
those of the memories in the model are chosen with it, since two memories found one after the other are not the best
two. A memory is tried from equilibrium and from an unknown start. What passes (`driftlab.loop.gates`) is ranked by its
left-out error; a simpler one within its uncertainty goes first, and those that neither left-out errors nor likelihood
tell from it are its rivals.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from os import cpu_count

import numpy as np

from driftlab.loop.columns import Columns
from driftlab.loop.evidence import Evidence as Recordings
from driftlab.loop.gates import DRIFTING, SECOND, CHANCE, Evidence, fast_evidence
from driftlab.loop.least_squares import LeastSquares, Model, Term, slow_density
from driftlab.loop.left_out import Part, error, parts
from driftlab.loop.noise import Noise, effective, fitted
from driftlab.loop.tuning import Tuning, best
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Basis, Effect
from fusion_core.registry import registry

MOST = 4  # effects that are added
MEMORIES = 2  # of one channel: no data separate three exponentials (C. Lanczos, Applied Analysis (1956), IV.23)
BLOCKS = 6  # of each part, for the uncertainty of a left-out error
SMOOTHING = np.logspace(-8, 2, 11)  # of the map, relative to its curves' own weight
HIGHEST = 6  # power of temperature above which a map needs no further ones
AS_GOOD = 3.0  # nats: less likely by less than 20 times

Progress = Callable[[str], None]
Family = tuple[str, str, int, bool]  # name, form, coefficients, and whether the start is free


@dataclass(frozen=True)
class Trial:
    """One family's best candidate beside a base.

    Attributes
    ----------
    model : tuple of Term
        The base, its memories as they were chosen with the candidate, and the candidate last.
    evidence : Evidence
        Its figures.
    blocks : (d, blocks) array
        Sums of squares of the left-out errors, in the columns' scale.
    likelihood : float
        What it gains in likelihood, each side at its best noise and parameters paid for, in nats.
    passes : bool
        Whether it is enough.
    reason : str
        What it is that is not.
    """

    model: Model
    evidence: Evidence
    blocks: Array
    likelihood: float
    passes: bool
    reason: str

    @property
    def term(self) -> Term:
        """The candidate."""
        return self.model[-1]

    @property
    def size(self) -> int:
        """Coefficients an axis, hyper-parameters, and one more for an unknown start."""
        effect = self.term.effect
        return len(effect.terms) + len(effect.continuous) + int(self.term.free)


@dataclass
class Search:
    """A search: the model so far, what it stands on, and what was tried.

    Attributes
    ----------
    squares : LeastSquares
        Fits, on all columns.
    model : tuple of Term
        The model.
    noises : list of Noise, one an axis
        Of what the model leaves.
    added : list of (Trial, tuple of Trial)
        Each addition with its rivals, in the order of the model's terms after those that were declared.
    trials : list of Trial
        The last that were tried, and not added.
    tried : int
        Candidates at once, at most.
    """

    squares: LeastSquares
    progress: Progress
    declared: Model
    model: Model
    left_out: tuple[Part, ...]
    noises: list[Noise] = field(default_factory=list)
    added: list[tuple[Trial, tuple[Trial, ...]]] = field(default_factory=list)
    trials: list[Trial] = field(default_factory=list)
    tried: int = 0

    @property
    def columns(self) -> Columns:
        """All that may be in a model."""
        return self.squares.columns

    @property
    def everything(self) -> tuple[int, ...]:
        """All segments."""
        return tuple(range(len(self.columns.segments)))

    def fresh(self) -> None:
        """Work out smoothing and noise for the present model."""
        self.squares.forget()
        slices = self.columns.evidence.slices
        self.noises = []
        for axis in range(len(self.columns.y)):
            self.squares.smoothing[axis] = _smoothing(self, axis)
            fit = self.squares.fit(self.model, axis, self.everything)
            residual = self.squares.residual(self.model, axis, fit)
            split = [residual[rows] for rows in slices]
            self.squares.colour[axis] = slow_density(split) / max(float(np.mean(residual**2)), 1e-300)
        self.squares.forget()
        self.noises = noises_of(self, self.model)


def search(evidence: Recordings, basis: Basis | None, progress: Progress, declared: Sequence[Effect] = ()) -> Search:
    """Find the effects that the model lacks; those that are declared already are fitted with the others."""
    columns = Columns(evidence, basis)
    d = len(evidence.axes)
    squares = LeastSquares(columns, np.full(d, 1e-4), np.ones(d))
    own = tuple(Term(effect, any(effect.initial or ())) for effect in declared)
    found = Search(squares, progress, own, own, parts(columns))
    found.fresh()
    while len(found.added) < MOST and _add(found):
        _merge(found)
        _refine(found)
        found.fresh()
        _drop(found)
    return found


def _add(found: Search) -> bool:
    """Try all that is offered beside the model, and add the best; return whether there is one."""
    families = offered(found)
    found.tried = max(found.tried, len({repr(term.effect) for terms in families.values() for term in terms}))
    found.progress(f"trying {found.tried} candidates" + (f" beside {_listed(found.model)}" if found.model else ""))
    trials = tried(found, found.model, families)
    found.trials = trials
    passing = [trial for trial in trials if trial.passes]
    passing = [t for t in passing if not any(_waits(found, t, other) for other in passing)]
    passing = [t for t in passing if t.evidence.fast] or passing
    if not passing:
        return False
    chosen = _best(passing)
    rivals = tuple(t for t in passing if t is not chosen and _rival(t, chosen))
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
    own = {f: terms for f, terms in offered(found).items() if terms[0].effect.requires == new.effect.requires}
    found.model = pair
    if not own:
        return
    noises = noises_of(found, pair)
    both = _blocks(_errors(found, [pair] * len(found.left_out), noises))
    single = _best(tried(found, base, own))
    two = replace(single, blocks=both)
    if single.evidence.fast and difference(single, two) <= uncertainty(single, two):
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
    errors = _errors(found, [model] * len(found.left_out), noises_of(found, model))
    axes = range(len(found.columns.y))
    return float(np.mean([np.log(max(sum(float(np.sum(p[axis] ** 2)) for p in errors), 1e-300)) for axis in axes]))


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


def contains(columns: Columns, wide: Term, term: Term) -> bool:
    """Return whether a term's columns are combinations of another's, on every axis."""
    if wide.effect.acts_on_input or term.effect.acts_on_input or wide is term:
        return False
    for outer, inner in zip(columns.of(wide.effect).columns, columns.of(term.effect).columns, strict=True):
        A, b = columns.W[:, outer], columns.W[:, inner]
        if np.linalg.norm(b - A @ np.linalg.lstsq(A, b, rcond=1e-10)[0]) > 1e-5 * np.linalg.norm(b):
            return False
    return True


def noises_of(found: Search, model: Model) -> list[Noise]:
    """Return the noise of what a model leaves on each axis."""
    squares, slices = found.squares, found.columns.evidence.slices
    found_noises = []
    for axis in range(len(found.columns.y)):
        residual = squares.residual(model, axis, squares.fit(model, axis, found.everything))
        found_noises.append(fitted([residual[rows] for rows in slices]))
    return found_noises


def _listed(model: Model) -> str:
    return ", ".join(name_of(term.effect) for term in model)


def _rival(trial: Trial, chosen: Trial) -> bool:
    """Return whether neither left-out errors nor likelihood tell a trial from the one that was chosen."""
    if name_of(trial.term.effect) == name_of(chosen.term.effect):
        return False
    close = difference(trial, chosen) < 2 * uncertainty(trial, chosen)
    return close and trial.likelihood > chosen.likelihood - AS_GOOD


def difference(trial: Trial, other: Trial) -> float:
    """Return the log of the ratio of two trials' left-out errors, mean over the axes."""
    return float(np.mean(np.log(trial.blocks.sum(axis=1) / other.blocks.sum(axis=1))))


def uncertainty(trial: Trial, other: Trial) -> float:
    """Return the standard deviation of `difference`, as it varies from block to block; every row counts twice."""
    a, b = (t.blocks / t.blocks.sum(axis=1, keepdims=True) for t in (trial, other))
    return float(np.sqrt(2 * np.sum((a - b) ** 2)) / len(a))


def name_of(effect: Effect) -> str:
    """Return what tells an effect from others in messages: its kind, and what it is about."""
    subject = effect.subject
    return effect.kind if subject in ("time", "temperature") else f"{effect.kind} of {subject}"


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
                families.setdefault((name_of(effect), _form(effect), shown.p, free), []).append(Term(effect, free))
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


def _form(effect: Effect) -> str:
    """Return which of its forms an effect takes, where it has several."""
    return str(getattr(effect, "form", ""))


def with_residual(found: Search) -> list[Chunk]:
    """Return the recordings' means with what the model leaves as channel `residual`, in its own deviation.

    What the model says is taken to run straight between rows: lines faster than rows are seen where they are.
    """
    evidence, columns = found.columns.evidence, found.columns
    chunks = []
    said = np.empty_like(evidence.rate)
    for axis in range(len(evidence.axes)):
        fit = found.squares.fit(found.model, axis, found.everything)
        left = found.squares.residual(found.model, axis, fit) * columns.scale[columns.y[axis]]
        said[:, axis] = evidence.rate[:, axis] - left
    for record, rows in zip(evidence.records, evidence.slices, strict=True):
        t, model = record.chunk.t, said[rows]
        of_model = np.stack([np.interp(t, record.t, model[:, axis]) for axis in range(model.shape[1])], axis=1)
        residual = record.chunk["gyro"] - of_model
        chunks.append(record.chunk.having(residual=residual))
    spread = np.maximum(np.std(np.concatenate([chunk["residual"] for chunk in chunks]), axis=0), 1e-300)
    return [chunk.having(residual=chunk["residual"] / spread) for chunk in chunks]


def tried(found: Search, base: Model, families: dict[Family, list[Term]]) -> list[Trial]:
    """Return the trial of each family beside a base."""
    for terms in families.values():  # columns are made by one thread
        for term in terms:
            found.columns.of(term.effect)
            found.columns.of_map([term.effect])
    found.columns.gram(found.everything)
    tunings: dict[tuple[Model, tuple[int, ...]], Tuning] = {}
    without = _errors(found, [base] * len(found.left_out), found.noises)

    def work(terms: list[Term]) -> Trial:
        slots = [k for k, term in enumerate(base) if _retuned(found, term, terms[0])]
        kept = tuple(term for k, term in enumerate(base) if k not in slots)
        choices = [_family(families, base[k]) for k in slots] + [terms]

        def chosen(segments: tuple[int, ...]) -> Model:
            key = kept, segments
            if key not in tunings:
                tunings[key] = Tuning(found.squares, kept, segments)
            anew = best(tunings[key], choices)
            place = dict(zip(slots, anew, strict=False))
            return (*(place.get(k, term) for k, term in enumerate(base)), anew[-1])

        model = chosen(found.everything)
        noises = noises_of(found, model)
        errors = _errors(found, [chosen(part.rest) for part in found.left_out], noises)
        return _trial(found, base, model, noises, without, errors)

    with ThreadPoolExecutor(cpu_count() or 1) as pool:
        return list(pool.map(work, families.values()))


def _retuned(found: Search, term: Term, candidate: Term) -> bool:
    """Return whether a term of the base is to be chosen anew with a candidate: both have a memory."""
    both = [found.columns.of(t.effect).starts is not None for t in (term, candidate)]
    return all(both) and term not in found.declared and not term.effect.acts_on_input


def _family(families: dict[Family, list[Term]], term: Term) -> list[Term]:
    """Return the alternatives of a term of the base, itself among them."""
    key = name_of(term.effect), _form(term.effect), len(term.effect.labels), term.free
    return [*families.get(key, []), term]


Errors = list[list[Array]]  # of each part, of each axis


def _errors(found: Search, models: Sequence[Model], noises: Sequence[Noise]) -> Errors:
    return [
        [error(found.squares, model, axis, part, noises[axis]) for axis in range(len(found.columns.y))]
        for model, part in zip(models, found.left_out, strict=True)
    ]


def _trial(found: Search, base: Model, model: Model, noises: list[Noise], without: Errors, errors: Errors) -> Trial:
    """Judge a candidate by its left-out errors and its matched filter."""
    price = float(np.log(max(found.tried, 1)))
    effect = model[-1].effect
    walking = not effect.requires and effect.kind != "periodic"
    left_out, logs, by_part = 0.0, [], []
    for axis in range(len(found.columns.y)):
        squares = np.array([[np.sum(part[axis] ** 2) for part in side] for side in (errors, without)])
        squares = np.maximum(squares, 1e-300)
        total = squares.sum(axis=1)
        logs.append(float(np.log(total[0] / total[1])))
        by_part.append(np.log(squares[0] / squares[1]))
        n = sum(
            effective(new[axis], old[axis] - new[axis], walking=walking)
            for new, old in zip(errors, without, strict=True)
        )
        left_out -= n / 4 * logs[-1]
    ratio = float(np.exp(np.mean(logs)))
    chance, gain = fast_evidence(found.squares, _beside(base, model), model[-1], noises)
    steps = np.mean(by_part, axis=0)
    steady = float(np.mean(steps) / max(np.std(steps, ddof=1) / np.sqrt(len(steps)), 1e-12))
    evidence = Evidence(ratio, steady, len(steps), bool(base), left_out - price, chance, gain - price, price)
    passes, reason = _judged(found, effect, evidence)
    return Trial(model, evidence, _blocks(errors), _likelihood(found, model, noises), passes, reason)


def _blocks(errors: Errors) -> Array:
    """Return the sums of squares (d, blocks) of left-out errors."""
    return np.array([
        np.concatenate([[float(np.sum(b**2)) for b in np.array_split(part[axis], BLOCKS)] for part in errors])
        for axis in range(len(errors[0]))
    ])  # fmt: skip


def _likelihood(found: Search, model: Model, noises: Sequence[Noise]) -> float:
    """Return the log-likelihood of a model's one-step errors beyond that of the present one, parameters paid for."""
    n, axes = len(found.columns.evidence), range(len(found.columns.y))
    gain = sum(0.5 * n * float(np.log(found.noises[axis].variance / noises[axis].variance)) for axis in axes)
    term = model[-1]
    starts = len(found.columns.levels) if term.free else 0
    number = sum(len(found.columns.of(term.effect).columns[axis]) + starts for axis in axes)
    return gain - 0.5 * (number + len(term.effect.continuous)) * float(np.log(n))


def _beside(base: Model, model: Model) -> Model:
    """Return the base as it was chosen with the candidate."""
    return model[:-1] if len(model) > 1 else base


def _judged(found: Search, effect: Effect, evidence: Evidence) -> tuple[bool, str]:
    """Return whether a candidate is enough, and what is not; what is easily imitated needs more."""
    named = {name for term in found.model for name in term.effect.requires} - {"temperature", "temperature_rate"}
    if named & set(effect.requires):
        enough = evidence.fast and evidence.left_out > CHANCE and evidence.ratio < SECOND
        return enough, evidence.reason() if not enough else ""
    if effect.kind == "drift":
        enough = evidence.better(0.95) and evidence.left_out > CHANCE and evidence.ratio < DRIFTING
        return enough, "a walk imitates it, and left-out parts are not predicted better by as much as a drift must"
    enough = evidence.fast or evidence.slow
    return enough, "" if enough else evidence.reason()


def _refine(found: Search) -> None:
    """Refine continuous hyper-parameters by coordinate descent on the training error."""
    from scipy.optimize import minimize_scalar

    terms = list(found.model)
    for k, term in enumerate(terms):
        if term in found.declared:
            continue
        for name, factor in type(term.effect).continuous.items():
            value, width = float(getattr(term.effect, name)), float(np.log(factor))

            def varied(x: float, k: int = k, name: str = name, value: float = value) -> Model:
                effect = terms[k].effect.model_copy(update={name: value * float(np.exp(x))})
                return (*terms[:k], replace(terms[k], effect=effect), *terms[k + 1 :])

            def cost(x: float) -> float:
                model = varied(x)  # noqa: B023
                return sum(
                    float(np.log(max(found.squares.fit(model, axis, found.everything).cost, 1e-300)))
                    for axis in range(len(found.columns.y))
                )

            found_at = minimize_scalar(cost, bounds=(-width, width), method="bounded", options={"xatol": width / 30})
            if found_at.fun < cost(0.0):
                terms[k] = varied(float(found_at.x))[k]
    found.model = tuple(terms)


def _smoothing(found: Search, axis: int) -> float:
    """Return the weight of the map's penalty that predicts left-out segments best, the map fitted without them."""
    squares, columns = found.squares, found.columns
    if not np.any(columns.penalty):
        return 0.0
    costs = []
    for weight in SMOOTHING:
        squares.smoothing[axis] = weight
        squares.forget()
        total = 0.0
        for k, segment in enumerate(columns.segments):
            rest = tuple(j for j in found.everything if j != k)
            fit = squares.fit(found.model, axis, rest)
            e = columns.W[segment.rows, columns.y[axis]] - columns.W[segment.rows][:, fit.cols] @ fit.beta
            total += float(np.sum((e - e.mean()) ** 2))
        costs.append(total)
    squares.forget()
    return float(SMOOTHING[int(np.argmin(costs))])
