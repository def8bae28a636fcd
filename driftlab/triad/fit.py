"""Joint fit of bias, scale factor, misalignment and g-sensitivity over temperature to the equations of a stimulus.

Gauss-Newton steps on penalised least squares, with the noise that the residuals show::

    x = argmin  (z - A x)' V^-1 (z - A x)  +  x' P x,      A = J B(T)
    V = diag(s_g^2) + sum_i J_i J_i' (q min(t, t') + l^2),    q within a clock, l within a recording

s_g is the white noise of a group of equations, q the walk of the bias over time, i its three axes; l is how far its
level differs from one recording to another, each of them a power-up, zero of a single one. A clock goes on from one
recording to another that begins after its end, else time begins anew.

The curve of each term is chosen step by step, by the largest fall of::

    m log(residual) + p (log m + 2 log q)

with p the effective number of coefficients: the price of a coefficient among q terms that could have had it (extended
Bayesian information criterion, Chen and Chen, Biometrika 95 (2008) 759), and that of a smoothing that is found. White
noise, walk and level are means over their restricted likelihood. The prior of the density of the walk is half-Cauchy
(Gelman, Bayesian Analysis 1 (2006) 515), its scale the declared density: one that hardly shows may be there. That of
log l is flat up to a usual level, so that one of few recordings has Student's law, and falls by 1 / l beyond, or no
bias would be seen to follow the temperature where each recording is at another. A term that the equations do not show
is zero, and its usual size counts in the error of the others.

What was decided counts in the error too. A term that stays constant may move by b, sigma s, all the same; it does with
the probability that follows from the two models' evidence (Schwarz, Annals of Statistics 6 (1978) 461)::

    p = 1 / (1 + sqrt(m) exp(-b^2 / 2 s^2)),    E[b^2] = p (s^2 + b^2)

and the scatter of the terms over the walks that are likely is a part of their error. As many equations as there are
leave the size of the noise unsure: the error is that of Student's t. Terms of M may have a law of their coefficients,
as of a family: it takes the place of P, once the noise is found without it. m equations, n coefficients, q terms: 12,
or 21.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from driftlab.triad.estimate import SURE, TINY, UNOBSERVABLE, TriadFit
from driftlab.triad.model import (
    BIAS,
    GRAVITY,
    NARROW,
    PARABOLA,
    SCALE,
    TERMS,
    TermCurve,
    TermPrior,
    TriadTerms,
    clocks_of,
    curves_of,
    distinct,
    laws_of,
    polynomial,
    recordings_of,
)
from fusion_core.chunk import Array, Flags
from fusion_core.contracts import ThermalMap, TriadInput
from fusion_core.errors import SingularFit

STEPS = 30
WIDE = 20.0  # times the usual size: the prior with which a fit begins
USUAL_SENSITIVITY = float(np.deg2rad(0.1)) / GRAVITY  # rad/s a m/s^2: of MEMS gyros, 0.1 deg/s/g
PASSES = 4
WALKS = tuple(10.0 ** (k / 2) for k in range(-6, 5))  # variance of the walk over that of an equation, at the end
LEVELS = tuple(10.0 ** (k / 2) for k in range(-6, 13))  # and of the level from one recording to another
LEVEL = 0.01  # of a usual bias: that level, of a usual unit
TOLD = 3  # levels beyond the coefficients of the bias, from which their deviation is known
AHEAD = 2  # curves that are looked at beyond that of a term, to either side


def fit_triad(
    stimulus: TriadInput,
    settings: ThermalMap,
    bias_size: float,
    wanted: Flags | None = None,
    walk: float | None = None,
    prior: TermPrior | None = None,
) -> TriadFit:
    """Fit the terms of a triad to a stimulus.

    Parameters
    ----------
    stimulus : TriadInput
    settings : ThermalMap
        Kind of the curves that are tried beside constants and polynomials.
    bias_size : float
        Bias of a usual unit, in its unit; its other terms are 1 %, 10 mrad and 0.1 deg/s/g.
    wanted : (q,) array of bool, optional
        Terms that may differ from zero, beside the bias; by default all of the 12 that the stimulus leaves free. With
        21 of them, g-sensitivity is looked for.
    walk : float, optional
        Declared density of the random walk of the bias, its unit/sqrt(s); without it the scale of the prior is a walk
        that ends as large as the noise of an equation.
    prior : TermPrior, optional
        Law of the terms of M, as of a family; they are over its domain then.

    Raises
    ------
    SingularFit
        If the stimulus has fewer equations than terms, or the fit does not converge.
    ConfigError
        If the kind is a network.
    """
    T = stimulus.T
    domain = float(T.min()), float(T.max())
    wanted = np.ones(len(TERMS), dtype=bool) if wanted is None else wanted
    free = np.concatenate([stimulus.free, np.ones(len(wanted) - len(TERMS), dtype=bool)]) & wanted
    usual = np.array([bias_size] * 3 + [0.01] * 9 + [USUAL_SENSITIVITY] * 9)[: len(free)]
    curves = [curves_of(settings, domain, len(distinct(T)))] * len(free)
    if prior is not None:
        curves[len(BIAS) : len(TERMS)] = [[curve] for curve in prior.curves()]
    search = _Search(stimulus, curves, usual, free, walk)
    search.check()
    if not search.converge():
        search.drop_unobservable()
    for k in range(PASSES):  # noise and walk, curves, and what is not observable, each by the others
        before = [*search.chosen, *search.observable]
        search.choose()
        search.converge()
        if k == 0:
            search.expect_levels()
        search.measure_walk()
        search.converge(noise=False)
        search.drop_unobservable()
        if before == [*search.chosen, *search.observable]:
            break
    if not search.converge(noise=False):
        raise SingularFit(
            f"the fit does not settle in {STEPS} steps; see that units and scale in the config are about right, and "
            "that the stimulus moves all axes"
        )
    return search.result(domain if prior is None else prior.domain)


class _Search:
    """The state of a fit: the curve of each term, its coefficients, and the noise of each group."""

    def __init__(
        self,
        stimulus: TriadInput,
        curves: list[list[TermCurve]],
        usual: Array,
        free: Flags,
        declared: float | None = None,
    ) -> None:
        self.stimulus, self.curves, self.usual, self.free = stimulus, curves, usual, free
        self.observable = free.copy()
        self.chosen = [0] * len(free)
        self.x: list[Array] = [own[0].mean for own in curves]
        self.s, self.walk, self.level, self.declared = np.ones(2), 0.0, 0.0, declared
        self.by_walk: list[tuple[float, Array]] = []  # how likely walk and level are, and the change by them
        self.linearise()

    def check(self) -> None:
        """Raise SingularFit where there are fewer equations than terms."""
        alone = [own[0].precision is None for own in self.curves]
        equations, count = len(self.e.left), int(np.sum(self.observable & alone))
        if equations <= count:
            raise SingularFit(
                f"the stimulus has {equations} equations for {count} terms; add placements or segments, more than "
                "there are terms"
            )

    @property
    def terms(self) -> TriadTerms:
        return TriadTerms(self._curves(self.chosen), self.x)

    @property
    def _means(self) -> TriadTerms:
        curves = self._curves(self.chosen)
        return TriadTerms(curves, [np.broadcast_to(curve.mean, curve.q) for curve in curves])

    def linearise(self) -> None:
        """Take the equations about these terms, whiten them, and forget the columns of those before."""
        e = self.stimulus.equations(self.terms.at(self.stimulus.T))
        self.e = e = replace(e, J=np.pad(e.J, ((0, 0), (0, len(self.free) - e.J.shape[1]))))  # of terms it knows not of
        sigma = self.s[e.group]
        self.z = (e.left + np.einsum("mj,mj->m", e.J, self.terms.at(e.T) - self._means.at(e.T))) / sigma  # of no terms
        self._J = e.J / sigma[:, None]
        self._columns: dict[tuple[int, int], Array] = {}
        self._root = (
            np.linalg.cholesky(self._covariance_of_noise(self.walk, self.level)) if self.walk or self.level else None
        )
        if self._root is not None:
            self.z = np.linalg.solve(self._root, self.z)

    def _walked(self) -> Array:
        """Return the covariance (m, m) of the equations over their white noise that a walk of density one leaves."""
        J, clock = self._J[:, list(BIAS)], clocks_of(self.e)
        first = np.array([self.e.t[clock == k].min() for k in range(clock.max() + 1)])
        t = self.e.t - first[clock]
        return np.asarray((J @ J.T) * np.minimum.outer(t, t) * np.equal.outer(clock, clock))

    def _levels(self) -> Array:
        """Return the derivative (m, 3 R) of the equations by the levels of R recordings, at most of length one."""
        J, recordings = self._J[:, list(BIAS)], np.unique(recordings_of(self.e))
        own = np.equal.outer(recordings_of(self.e), recordings) * (len(recordings) > 1)
        return np.asarray((own[:, :, None] * J[:, None]).reshape(len(J), -1) / self._size())

    def _size(self) -> float:
        """Return the largest derivative of an equation over its white noise by the bias."""
        return float(np.max(np.linalg.norm(self._J[:, list(BIAS)], axis=1))) + TINY

    def _level(self) -> float:
        """Return the deviation of the levels, in the unit of the bias; 0 where the curves of the bias leave too few."""
        taken = sum(curve.q for curve in self._curves(self.chosen)[: len(BIAS)])
        told = len(BIAS) * len(np.unique(recordings_of(self.e))) - taken >= TOLD
        return float(np.sqrt(self.level)) / self._size() if told else 0.0

    def _covariance_of_noise(self, walk: float, level: float = 0.0) -> Array:
        """Return the covariance (m, m) of the equations over their white noise: one, walk and levels of the bias."""
        walked, L = self._walked(), self._levels()
        return np.asarray(
            np.eye(len(walked)) + walk / max(float(np.max(np.diag(walked))), TINY) * walked + level * L @ L.T
        )

    def column(self, j: int, curve: TermCurve) -> Array:
        """Return the whitened columns (m, q) of a term's curve."""
        key = j, id(curve)
        if key not in self._columns:
            own = self._J[:, j, None] * curve.values(self.e.T)
            self._columns[key] = own if self._root is None else np.linalg.solve(self._root, own)
        return self._columns[key]

    def _system(
        self, curves: Sequence[TermCurve], some: Flags, wide: float = WIDE, *, law: bool = True
    ) -> tuple[Array, Array]:
        """Return N (n, n), with priors and penalties in it, and the whitened design A (m, n) of curves.

        Of terms that are not among `some` (q,) the columns are zero; the prior is `wide` times the usual size, or a
        `law` that the curve has.
        """
        columns, prior = [], []
        for j, curve in enumerate(curves):
            columns.append(self.column(j, curve) * some[j])
            own = np.eye(curve.q) / (wide * self.usual[j]) ** 2
            prior.append(curve.precision.copy() if law and curve.precision is not None else own)
            if np.any(curve.penalty):
                prior[-1] += curve.penalty * np.sum(columns[-1] ** 2) / curve.q
        A = np.hstack(columns)
        N, at = A.T @ A, 0
        for own in prior:
            N[at : at + len(own), at : at + len(own)] += own
            at += len(own)
        return np.asarray(N), A

    def _curves(self, chosen: Sequence[int]) -> list[TermCurve]:
        return [own[k] for own, k in zip(self.curves, chosen, strict=True)]

    def converge(self, *, noise: bool = True) -> bool:
        """Go to the optimum of these curves, with the noise that its residuals show; return False if there is none.

        Without `noise` that stays as it is. It is found without laws, or a unit that is unlike its family would pass
        for a noisy one. Where there is no optimum the terms are those of usual units, whose equations show which of
        them are not observable.
        """
        fall, size = np.inf, 1 / TINY
        for k in range(STEPS):
            self.linearise()
            N, A = self._system(self._curves(self.chosen), self.observable, law=not noise)
            inverse = np.linalg.inv(N)
            solution = np.asarray(inverse @ (A.T @ self.z))
            self._take(solution)
            left, leverage = self.z - A @ solution, np.einsum("mn,mn->m", A @ inverse, A)
            change = np.ones(2)
            for g in np.unique(self.e.group) if noise else ():
                own = self.e.group == g
                change[g] = np.sqrt(np.sum(left[own] ** 2) / max(np.sum(own) - np.sum(leverage[own]), 1.0) + TINY)
            self.s, size, before = self.s * change, float(left @ left), size
            of_size = np.log((size + TINY) / (before + TINY)) if not noise else 0.0
            last, fall = fall, float(np.max(np.abs([*np.log(change), of_size])))
            if k > 1 and fall < 1e-6 and last < 1e-3:
                break
        if settled := fall < 1e-2:
            self.linearise()
        else:
            self.x = list(self._means.coefficients)
            self.s = np.full(2, SURE * self.usual[0])
            self.linearise()
        return settled

    def expect_levels(self) -> None:
        """Choose the curves again beside levels of a usual size, of several recordings: curves must not follow them."""
        self.level = (LEVEL * self.usual[0] * self._size()) ** 2 if np.any(self._levels()) else 0.0
        if self.level:
            self.converge(noise=False)
            self.choose()
            self.converge(noise=False)

    def measure_walk(self) -> None:
        """Find walk and levels of the bias beside the white noise, by restricted likelihood at these curves.

        The levels are coefficients b ~ N(0, l^2) beside those of the terms (Henderson, Biometrics 31 (1975) 423).
        """
        if not np.any(self.observable):
            return
        prices, squares, solutions, L = [], [], [], self._levels()
        X, about, lawful, weak = self._regressors()
        usual = 1.0 if not self.declared else self.declared**2 * float(np.max(np.diag(self._walked()))) + TINY
        levels, q, m = LEVELS if np.any(L) else LEVELS[:1], X.shape[1], len(X)
        for walk in WALKS:
            root = np.linalg.cholesky(self._covariance_of_noise(walk))
            white = np.linalg.solve(root, np.column_stack([X, L, about]))
            A, y, spread = white[:, :-1], white[:, -1], 2 * np.sum(np.log(np.diag(root)))
            N, b = A.T @ A, A.T @ y
            N[range(q), range(q)] += 1e-12 * np.trace(N[:q, :q])
            told = N[:q, :q].copy()
            N[range(q), range(q)] += weak
            n = int(np.sum(~lawful)) + float(np.diag(np.linalg.solve(N[:q, :q], told)) @ lawful)
            for level in levels:
                whole = N + np.diag(np.repeat([0.0, 1 / level], [q, L.shape[1]]))
                solution = np.linalg.solve(whole, b)
                solutions.append(solution[:q])
                squares.append(float(y @ y - b @ solution) / max(m - n, 1) + TINY)
                bent = np.linalg.slogdet(whole)[1] + L.shape[1] * np.log(level)
                prices.append(float(spread + bent + max(m - n, 1) * np.log(squares[-1])))
        walks, own = (np.array(v) for v in zip(*product(WALKS, levels), strict=True))
        likely = np.exp((np.min(prices) - np.array(prices)) / 2)
        likely *= np.sqrt(walks) / (1 + walks / usual) / np.sqrt(1 + own / (LEVEL * self.usual[0] * self._size()) ** 2)
        likely /= np.sum(likely)
        white_noise = float(likely @ squares)
        self.walk, self.level = (float(likely @ (np.array(squares) * size)) / white_noise for size in (walks, own))
        self.by_walk = list(zip(likely.tolist(), solutions, strict=True))
        self.s = self.s * np.sqrt(white_noise)

    def _regressors(self) -> tuple[Array, Array, Flags, Array]:
        """Return the columns X (m, n) of the terms over their white noise, and what is left to them (m,).

        Coefficients with a law (n,) are left about its mean; without it they have a weak prior, its precision (n,).
        """
        J, about, lawful, weak = self._J, self.e.left / self.s[self.e.group], [], []
        columns = []
        for j, curve in enumerate(self._curves(self.chosen)):
            if not self.observable[j]:
                continue
            known = curve.precision is not None
            columns.append(J[:, j, None] * curve.values(self.e.T))
            about = about + columns[-1] @ (self.x[j] - curve.mean) * known
            lawful += [known] * curve.q
            weak += [known / (WIDE * self.usual[j]) ** 2] * curve.q
        return np.hstack(columns), about, np.array(lawful), np.array(weak)

    def _take(self, solution: Array) -> None:
        sizes = [curve.q for curve in self._curves(self.chosen)]
        means = np.concatenate(self._means.coefficients)
        self.x = np.split(solution + means, np.cumsum(sizes)[:-1])

    def _covariance(self) -> Array:
        """Return the covariance (q, q) of the terms in the middle, by the columns that are free."""
        curves, T = self._curves(self.chosen), np.array([(self.e.T.min() + self.e.T.max()) / 2])
        N, _ = self._system(curves, self.observable)
        B = np.zeros((len(self.free), len(N)))
        at = 0
        for j, curve in enumerate(curves):
            B[j, at : at + curve.q] = curve.values(T)[0]
            at += curve.q
        return np.asarray(B @ np.linalg.inv(N) @ B.T)

    def drop_unobservable(self) -> None:
        """Set unobservable terms to zero, the least known first, and of those that are alike the bias last."""
        while True:
            sigma = np.sqrt(np.diag(self._covariance())) / self.usual * self.observable
            sigma[list(BIAS)] *= 0.9
            worst = int(np.argmax(sigma))
            if sigma[worst] <= UNOBSERVABLE:
                return
            self.observable[worst] = False
            self.chosen[worst], self.x[worst] = 0, self.curves[worst][0].mean

    def choose(self) -> None:
        """Give each term the curve that pays for its coefficients.

        Where all terms move, one alone hardly lowers the residual of the others, and does not pay; so the search begins
        with constants, and again with the curve that is best for all.
        """
        most = [(len(own) - 1) * int(seen) for own, seen in zip(self.curves, self.observable, strict=True)]
        alike = [[min(k, own) for own in most] for k in range(max(most) + 1)]
        _, self.chosen = min(map(self._cheapest, (alike[0], min(alike, key=self._price))))
        N, A = self._system(self._curves(self.chosen), self.observable)
        self._take(np.asarray(np.linalg.solve(N, A.T @ self.z)))

    def _cheapest(self, chosen: list[int]) -> tuple[float, list[int]]:
        """Return the price and the curves where no other curve of one term is cheaper, from some curves on."""
        best = self._price(chosen)
        while True:
            trials = []
            for j in np.flatnonzero(self.observable):
                for k in range(max(chosen[j] - AHEAD, 0), min(chosen[j] + 1 + AHEAD, len(self.curves[j]))):
                    tried = [*chosen[:j], k, *chosen[j + 1 :]]
                    trials.append((self._price(tried), tried))
            least, tried = min(trials, default=(best, chosen))
            if least >= best:
                return best, chosen
            best, chosen = least, tried

    def _price(self, chosen: list[int]) -> float:
        from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

        curves, m, p, at = self._curves(chosen), len(self.z), 0.0, 0
        N, A = self._system(curves, self.observable)
        root, failed = dpotrf(N, lower=1)
        left = self.z - A @ dpotrs(root, A.T @ self.z, lower=1)[0]
        half = dpotri(root, lower=1)[0]  # lower half of the inverse of N
        for curve in curves:
            own, at, p = slice(at, at + curve.q), at + curve.q, p + curve.q
            if curve.precision is not None or np.any(curve.penalty):  # its prior knows a part of it
                prior, inverse = N[own, own] - A[:, own].T @ A[:, own], np.tril(half[own, own])
                p += bool(np.any(curve.penalty)) - float(np.sum((inverse + np.tril(inverse, -1).T) * prior))
        if failed or p >= m - 1:
            return np.inf
        return float(m * np.log(float(left @ left) / m + TINY) + p * (np.log(m) + 2 * np.log(len(self.free))))

    def result(self, domain: tuple[float, float]) -> TriadFit:
        """Return the fit; changes that are not observable, and terms that are not, count with their usual size."""
        wide = domain[1] - domain[0] >= NARROW
        straight = [wide and curve.q == 1 for curve in self._curves(self.chosen)]
        design = [
            polynomial(1, domain) if line else c for line, c in zip(straight, self._curves(self.chosen), strict=True)
        ]
        N, A = self._system(design, self.free, wide=1.0)
        starts = np.cumsum([0, *(curve.q for curve in design)])
        whole = np.linalg.inv(N)
        sigma, moved = np.sqrt(np.diag(whole)), whole @ (A.T @ self.z)
        hidden, pinned = np.zeros(len(self.free), dtype=bool), []
        for j, start in enumerate(starts[:-1]):
            own = range(start, starts[j + 1])
            line = self.observable[j] and straight[j]
            if line:
                hidden[j] = sigma[start + 1] > UNOBSERVABLE * self.usual[j]
            # no change was seen where one would have been: there is none; and terms that are not free are known
            known = own[1:] if line and not hidden[j] else own[:0] if self.free[j] else own
            N[known, known] += 1 / TINY
            pinned += list(known) if self.free[j] else []
        length = np.zeros((len(N), 1))  # an input whose size is unsure: all scale factors go with it
        for j in SCALE:
            flat = np.any(design[j].penalty)  # curves of a kind add up to one, of a polynomial the first is one
            length[starts[j] : starts[j + 1] if flat else starts[j] + 1] = self.stimulus.unsure
        b, s = moved[pinned], sigma[pinned]
        share = 1 / (1 + np.sqrt(len(self.z)) * np.exp(-((b / s) ** 2) / 2))
        others = np.linalg.solve(whole[np.ix_(pinned, pinned)], whole[pinned]).T  # by which the others go with a change
        doubt = others * np.sqrt(share * (s**2 + b**2))
        lawful = np.diag(laws_of(design)) > 0
        free = np.sum(~lawful) - len(pinned) + float(np.diag(whole @ (A.T @ A)) @ lawful)
        student = 1 + 2 / max(len(self.z) - free - 2, 1.0)  # f / (f - 2), of f degrees of freedom
        half = np.linalg.cholesky(N - (1 - 1 / student) * A.T @ A)  # priors are as sure as they are
        scatter = self._scatter_over_walks(starts)
        root = np.hstack([np.linalg.inv(half).T, doubt * np.sqrt(student), scatter, length])
        density = float(np.sqrt(self.walk / max(float(np.max(np.diag(self._walked()))), TINY)))
        columns = len(N), len(pinned) + scatter.shape[1], 1
        return TriadFit(
            self.stimulus, self.terms, domain, self.usual, self.free, self.observable.copy(), hidden, design, root,
            tuple(self.s.tolist()), columns, density, self._level(), self._parabolas(domain), self._distance(),
        )  # fmt: skip

    def _parabolas(self, domain: tuple[float, float]) -> tuple[Array, Array] | None:
        """Return the terms of M as parabolas over the domain, whatever curves they have, and their covariance."""
        curves, part = self._curves(self.chosen), slice(len(BIAS), len(TERMS))
        curves[part] = [polynomial(PARABOLA, domain)] * len(curves[part])
        N, A = self._system(curves, self.free)
        freedom = len(self.z) - len(N)
        if freedom < 3 or domain[1] - domain[0] < NARROW or np.any(laws_of(self._curves(self.chosen))):
            return None
        C, at = np.linalg.inv(N), sum(curve.q for curve in curves[: len(BIAS)])
        own = [slice(at + k, at + k + PARABOLA + 1) for k in range(0, len(curves[part]) * (PARABOLA + 1), PARABOLA + 1)]
        c = C @ (A.T @ self.z)
        return np.stack([c[k] for k in own]), np.stack([C[k, k] for k in own]) * freedom / (freedom - 2)

    def _distance(self) -> tuple[float, int] | None:
        """Return the chi-square of the terms that have a law against it, in the directions that the equations tell."""
        curves = self._curves(self.chosen)
        known = laws_of(curves)
        own = np.flatnonzero(np.diag(known))
        if not len(own):
            return None
        N, A = self._system(curves, self.observable)
        rest = np.setdiff1d(range(len(N)), own)
        taken = np.linalg.solve(N[np.ix_(rest, rest)], N[np.ix_(rest, own)]).T
        b, J = A.T @ self.z, (N - known)[np.ix_(own, own)] - taken @ N[np.ix_(rest, own)]
        L = np.linalg.inv(np.linalg.cholesky(known[np.ix_(own, own)])).T
        gain, U = np.linalg.eigh(L.T @ J @ L)
        seen = gain > 1
        a = (U.T @ (L.T @ (b[own] - taken @ b[rest])))[seen]
        return float(np.sum(a**2 / (gain[seen] + gain[seen] ** 2))), int(np.sum(seen))

    def _scatter_over_walks(self, starts: Array) -> Array:
        """Return the modes (n, walks) of the coefficients' scatter over the walks that are likely."""
        sizes = [curve.q if seen else 0 for curve, seen in zip(self._curves(self.chosen), self.observable, strict=True)]
        places = np.concatenate([start + np.arange(q) for start, q in zip(starts[:-1], sizes, strict=True)])
        modes = np.zeros((int(starts[-1]), len(self.by_walk)))
        if all(len(x) == len(places) for _, x in self.by_walk):
            mean = sum((p * x for p, x in self.by_walk), np.zeros(len(places)))
            modes[places.astype(np.int64)] = np.stack([np.sqrt(p) * (x - mean) for p, x in self.by_walk], axis=1)
        return modes
