"""The ranking of several configs by their coasts on a recording, and whether their differences are more than chance.

The bias wanders from one recording to the next by about the sigma that a coast says it has, and all configs meet the
same wandering: another recording may move any error by that much. So two configs differ where ::

    |e_a - e_b| > max(sigma_a, sigma_b)

with e the rms error and sigma the rms deviation of their coasts over the same horizon: over all axes, and axis by axis.
Judged is the longest horizon that is known of all configs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.evaluation.scores import LONGEST_FIRST, Scores, over_axes
from driftlab.units import BiasUnit, duration, listed

TO_THE_END = LONGEST_FIRST[0]
OFTEN = "10 min"  # said beside the longest, where there is more
REFUTED = 2.0  # sigma: what is off by more says too little of itself


@dataclass(frozen=True)
class Axes:
    """The best config and the next compared axis by axis: names of axes."""

    better: tuple[str, ...]
    alike: tuple[str, ...]
    worse: tuple[str, ...]


@dataclass(frozen=True)
class Ranking:
    """The configs by what their coasts are off by over one horizon.

    Attributes
    ----------
    horizon : str
        Name of the horizon.
    errors, sigmas : dict of str to float
        Of each config, the smallest error first: rms over the axes of error and sigma of the coast, in SI.
    best : tuple of str
        The config of the smallest error, and those that do not differ from it.
    axes : Axes or None
        How the first of `errors` stands against the next one; None without one, and of a single axis.
    """

    horizon: str
    errors: dict[str, float]
    sigmas: dict[str, float]
    best: tuple[str, ...]
    axes: Axes | None


def ranking(runs: Mapping[str, Scores], horizons: Sequence[str] = LONGEST_FIRST) -> Ranking | None:
    """Rank runs over the first of the horizons that is known of all; None where there is none."""
    for horizon in horizons:
        errors = {name: over_axes(y.coast[horizon]) for name, y in runs.items()}
        if np.all(np.isfinite(list(errors.values()))):
            break
    else:
        return None
    order = sorted(errors, key=errors.__getitem__)
    sigmas = {name: over_axes(runs[name].coast_sigma[horizon]) for name in order}
    first = order[0]
    best = [n for n in order if errors[n] - errors[first] <= max(sigmas[n], sigmas[first])]
    axes = _axes(runs[first], runs[order[1]], horizon) if len(order) > 1 and len(runs[first].axes) > 1 else None
    return Ranking(horizon, {name: errors[name] for name in order}, sigmas, tuple(best), axes)


def _axes(a: Scores, b: Scores, horizon: str) -> Axes:
    """Return the axes on which a is better than b, not different, and worse."""
    gain = b.coast[horizon] - a.coast[horizon]
    bound = np.maximum(a.coast_sigma[horizon], b.coast_sigma[horizon])
    better, alike, worse = (
        tuple(axis for axis, yes in zip(a.axes, which, strict=True) if yes)
        for which in (gain > bound, np.abs(gain) <= bound, gain < -bound)
    )
    return Axes(better, alike, worse)


def verdict(runs: Mapping[str, Scores], unit: BiasUnit, span: float) -> str:
    """Return the config that coasts best, by how much, and whether it is more than the sigma.

    Parameters
    ----------
    runs : mapping of str to Scores
        By name, of one recording.
    unit : BiasUnit
        Of the errors in the text.
    span : float
        From the end of the alignment to the end of the recording, s.
    """
    ranked = ranking(runs)
    if ranked is None:
        return "The config that coasts best is not known: too little of the recording is at rest after the alignment."
    text = _single(ranked, unit) if len(runs) == 1 else _several(ranked, unit)
    text = text.replace(TO_THE_END, f"{TO_THE_END} ({duration(span)})", 1)
    return text + _shorter(runs, ranked, span)


def _single(ranked: Ranking, unit: BiasUnit) -> str:
    ((name, error),) = ranked.errors.items()
    size = f"{unit.number(error)} {unit.shown}"
    return f"{name} coasts {size} off, {ranked.horizon}; there is nothing to compare it with."


def _several(ranked: Ranking, unit: BiasUnit) -> str:
    """Return a sentence on several configs over the horizon of a ranking."""
    best = ranked.best
    over = "" if ranked.axes is None else " rms over the axes"
    values = {name: unit.number(value) for name, value in ranked.errors.items()}
    others = ", ".join(f"{name} {value}" for name, value in values.items() if name not in best) + f" {unit.shown}"
    if len(best) == 1:
        return (
            f"On this one recording {best[0]} coasts best: {ranked.horizon} {values[best[0]]} {unit.shown}{over}, "
            f"{others}; they differ by more than {_sigma(ranked, list(values)[:2], unit)}{_agree(ranked)}."
        )
    worse = f"; worse: {others}" if len(best) < len(values) else ""
    return (
        f"On this one recording there is no difference between {listed(best)}: {ranked.horizon} "
        f"{listed([values[n] for n in best])} {unit.shown}{over}, "
        f"within {_sigma(ranked, best, unit)}{_disagree(ranked)}{worse}."
    )


def _sigma(ranked: Ranking, names: Sequence[str], unit: BiasUnit) -> str:
    """Return the sigma that the configs of these names differ by less or more than."""
    largest = max(names, key=ranked.sigmas.__getitem__)
    whose = f" of {largest}" if len({unit.number(ranked.sigmas[name]) for name in names}) > 1 else ""
    return f"the sigma{whose} ({unit.number(ranked.sigmas[largest])} {unit.shown})"


def _agree(ranked: Ranking) -> str:
    """Return the remarks on axes that rank the best otherwise than their rms, and on its sigma."""
    first, rival = list(ranked.errors)[:2]
    parts, axes = [], ranked.axes
    if axes is not None:
        parts = [f"not on {listed(axes.alike)}"] if axes.alike else []
        parts += [f"on {listed(axes.worse)} {rival} is better"] if axes.worse else []
    text = f", but {' and '.join(parts)}" if parts else "" if axes is None else ", and all axes agree"
    error, sigma = ranked.errors[first], ranked.sigmas[first]
    if error > REFUTED * sigma:
        text += f". Itself it is off by {error / sigma:.1f} times its sigma, which is too small to tell chance by"
    return text


def _disagree(ranked: Ranking) -> str:
    """Return on which axes the two smallest differ although their rms does not."""
    axes = ranked.axes
    if axes is None or not (axes.better or axes.worse):
        return ""
    pairs = zip(ranked.errors, (axes.better, axes.worse), strict=False)
    return f", but {' and '.join(f'{name} is better on {listed(on)}' for name, on in pairs if on)}"


def _shorter(runs: Mapping[str, Scores], ranked: Ranking, span: float) -> str:
    """Return the ranking over ten minutes beside that over the whole; empty where they are the whole."""
    short = ranking(runs, [OFTEN]) if ranked.horizon == TO_THE_END and span > 600.0 and len(runs) > 1 else None
    if short is None:
        return ""
    if set(short.best) == set(ranked.best):
        return f" Over {OFTEN} the same."
    if len(short.best) == 1:
        return f" Over {OFTEN} {short.best[0]} coasts best."
    return f" Over {OFTEN} there is no difference between {listed(short.best)}."
