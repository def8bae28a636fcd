"""One call of the filter, compiled: with steady gains where it can, by recursion where it must.

A sample that the gate refuses leads from steady gains to the recursion for a while.

Compiled loops with gains that are known before the data: the groups are lanes, side by side.

Arrays over states are (N, s, G) here, and over components (N, c, G): state i of every group, then state i + 1. A model
whose triads stand one after the other is in that order as it is. The numbers s and c, and that of the groups done side
by side, come as lengths of tuples, for the compiler to put several groups into one instruction: a fifth of the time of
groups that are gathered by lists of places.
"""

from __future__ import annotations

import numpy as np
from numba.cpython.unsafe.tuple import tuple_setitem

from fusion_core.checks import FLOAT, covariance
from fusion_core.chunk import Array, Flags, every
from fusion_core.fast import compiled, inlined, loop
from fusion_core.fast.groups import IndependentGroups, Lanes, Size, find_groups
from fusion_core.fast.loop import Data, Model, Places, SampleArrays, SampleStep, recursive
from fusion_core.fast.steady import Gains, Invariant, invariant
from fusion_core.model import Estimates, Measurement, State, Transition

DETOUR = 256  # samples of recursion once one is refused: others are often near
SPAN = 65_536  # samples with steady gains at first; each further stretch is longer
NARROW = 6  # states of a group for the tuples of `steady`
REGISTERS = 20  # states of all groups that `steady` does side by side: more do not stay in registers


def run(
    state: State, transition: Transition, measurement: Measurement, gates: Array, reset: Flags, *, steady: bool,
    keep_P: bool,
) -> Estimates:  # fmt: skip
    """Return the estimates of `fusion_core.kalman.estimate`; everything has been checked."""
    model, z, root = whitened(transition, measurement)
    known = invariant(model.F[0], model.Q[0], model.H[0], model.r[0], state.P) if steady else None
    groups = find_groups(model.F, model.Q, model.H, state.P) if known is None else known.groups
    job = Job(state, model, groups, Data(z, measurement.used, gates, reset), keep_P=keep_P)
    start, span, N = 0, SPAN, len(z)
    while start < N:
        if known is None:
            start = job.recursive(start, N)
            continue
        gains, length = known.gains_from(job.P, min(N - start, span))
        stop = start + length
        start, span = job.steady(start, stop, known, gains), 4 * span
        if start < stop:  # a sample was refused: it is filtered again, with those after it
            start, span = job.recursive(start, min(N, start + DETOUR)), DETOUR
    return job.estimates(root)


def alone(
    state: State, transition: Transition, measurement: Measurement, gate: float, keep_P: bool
) -> Estimates | None:
    """Return the estimates of one sample, checked and filtered by one compiled call; None where `run` has to look.

    That is where it is not ordinary (`fusion_core.fast.loop.single`), or an array is not as `fusion_core.checks` would
    leave it. Checks one by one, groups and a job cost four times as much as the sample.
    """
    x, P, z, used, u = state.x, state.P, measurement.z, measurement.used, transition.u
    over = transition.F, transition.Q, measurement.H, measurement.R
    if set(map(type, (x, P, z, used, u, *over))) != {np.ndarray} or transition.C is not None:
        return None
    F, Q, H, R = [a[0] if a.ndim == 3 and len(a) == 1 else a for a in over]
    arrays, n, m = (z, x, P, F, Q, u if u.ndim == 2 else u[None], H, R), x.size, z.size
    if [a.shape for a in arrays] != [(1, m), (n,), (n, n), (n, n), (n, n), (1, n), (m, n), (m, m)]:
        return None
    given = [a if a.flags.carray else a.copy() for a in arrays if a.dtype is FLOAT]
    if len(given) < 8 or used.dtype != np.bool_ or used.shape not in ((1,), (1, m)) or not every(used):
        return None
    of_x, of_z, sums = np.empty((n + 3, n)), np.empty((2, m)), np.empty(2)
    if not (n and m and loop.single(*given, gate, of_x, of_z, sums)):
        return None
    after, dof, all_used = State(of_x[2], of_x[3:]), np.array([m]), np.array([True])
    kept = after.P[None].copy() if keep_P else None
    return Estimates(of_x[:1], of_x[1:2], of_z[:1], of_z[1:], sums[:1], sums[1:], dof, all_used, after, kept)


def whitened(transition: Transition, measurement: Measurement) -> tuple[Model, Array, Array | None]:
    """Return a model with R diagonal, z for it, and the root of R that undoes it on the innovations.

    A component that is not measured has nothing to do with the others.
    """
    F, Q, H, R = (a if a.ndim == 3 else a[None] for a in (transition.F, transition.Q, measurement.H, measurement.R))
    u = transition.u if transition.u.ndim == 2 else transition.u[None]
    z, variances = measurement.z, np.diagonal(R, axis1=1, axis2=2)
    if np.count_nonzero(R) == np.count_nonzero(variances):
        return Model(F, Q, u, H, np.ascontiguousarray(variances)), z, None
    used = measurement.used
    if not np.all(used):
        R = np.where(used[:, :, None] & used[:, None, :], R, np.eye(R.shape[1]))
        z, H = np.where(used, z, 0.0), np.where(used[:, :, None], H, 0.0)
    root = np.asarray(np.linalg.cholesky(R), dtype=np.float64)
    to_white = np.asarray(np.linalg.inv(root), dtype=np.float64)
    white = np.ascontiguousarray((to_white @ z[..., None])[..., 0])
    return Model(F, Q, u, np.ascontiguousarray(to_white @ H), np.ones(R.shape[:2])), white, root


class Job:
    """One call in progress: the groups' states x (G, s), P (G, s, s), and the results so far."""

    def __init__(
        self, state: State, model: Model, groups: IndependentGroups, data: Data, *, keep_P: bool, keep_K: bool = False
    ) -> None:
        self.groups, self.model, self.data = groups, model, data
        states, rows = groups.states.astype(np.uint64), groups.rows.astype(np.uint64)
        self.places = Places(states, rows, *groups.size, (0.0,) if keep_K else ())
        self.fours = True if len(self.places.s) >= 4 else None
        self.complete = bool(data.used.all())
        self.x, self.P = self._by_groups(state)
        (N, m), n = data.z.shape, len(state.x)
        (G, s), c = groups.states.shape, groups.rows.shape[1]
        self.keep_P, some = keep_P, N if keep_K else 0
        y, white = (np.empty((N, m)) if self.complete else np.full((N, m), np.nan) for _ in range(2))
        x, sigma, nis, log_det = np.empty((N, n)), np.empty((N, n)), np.empty(N), np.empty(N)
        P, K, root = np.empty((N if keep_P else 0, G, s, s)), np.zeros((some, G, c, s)), np.zeros((some, G, c))
        (F, F_t, Q), (w, q, of_group), H = np.zeros((3, G, s, s)), np.zeros((3, s)), np.zeros((G, c, s))
        self.step = SampleStep(F, F_t, Q, H, np.zeros((G, s)), of_group, w, q)
        self.results = SampleArrays(x, sigma, y, white, nis, log_det, np.empty(N, dtype=np.bool_), P, K, root)

    def recursive(self, start: int, stop: int) -> int:
        """Run up to `stop`, or further while P is wide; return where."""
        at = start
        while at < stop:
            x, P = self.x, self.P
            self.x, self.P, done = self._recursion(x, P, at, stop)
            if at + done < stop:  # not finite after it, or P is too wide for it
                covariance("Q", self.model.Q[min(at + done, len(self.model.Q) - 1)], sample=at + done)
                if done:
                    x, P, _ = self._recursion(x, P, at, at + done)
                done += self._wide(x, P, at + done)
            at += done
        return at

    def _recursion(self, x: Array, P: Array, start: int, stop: int) -> tuple[Array, Array, int]:
        given = self.places, (x.copy(), np.empty_like(x)), (P.copy(), np.empty_like(P)), self.step
        x, P, done = recursive(*given, *self._part(start, stop), self.fours)
        return x, P, done

    def _wide(self, x: Array, P: Array, start: int) -> int:
        """Run from x (G, s) and P (G, s, s) on until P is narrow; return how many samples that took."""
        from fusion_core.fast.factored import wide

        groups = self.groups
        state, done = wide(State(self._all(x), groups.whole(P)), groups, *self._part(start, len(self.data.z)), start)
        self.x, self.P = self._by_groups(state)
        return done

    def _all(self, x: Array) -> Array:
        """Return the states (n,) from those of the groups (G, s)."""
        whole = np.empty(self.groups.n + 1)
        whole[self.groups.states] = x
        return whole[:-1]

    def _by_groups(self, state: State) -> tuple[Array, Array]:
        """Return x (G, s) and P (G, s, s) of the groups."""
        groups = self.groups
        x = state.x if groups.even else np.append(state.x, 0.0)
        return x[groups.states], groups.blocks(state.P, groups.states, groups.states)

    def _part(self, start: int, stop: int) -> tuple[Model, Data, SampleArrays]:
        """Return the arrays of a stretch."""
        given, model, results = self.data, self.model, self.results
        if stop - start < len(given.z):
            rows = slice(start, stop)
            model = Model._make(a if len(a) == 1 else a[rows] for a in model)
            results = SampleArrays._make(a[rows] for a in results)
            given = Data(given.z[rows], given.used[rows], given.gates, given.reset)
        return model, given, results

    def steady(self, start: int, stop: int, known: Invariant, gains: Gains) -> int:
        """Run up to `stop`, or to the first sample that the gate refuses or that is not finite; return which."""
        groups, results, rows, N = self.groups, self.results, slice(start, stop), len(self.results.nis)
        states, places = groups.states, groups.rows
        model, data, out = self._part(start, stop)
        u, z = groups.lanes(model.u, states), groups.lanes(data.z, places)
        shape = len(z), *u.shape[1:]
        if groups.ordered:  # lanes are views of the results
            lanes = out._replace(x=out.x.reshape(shape), y=out.y.reshape(z.shape), white=out.white.reshape(z.shape))
        else:
            lanes = out._replace(x=np.empty(shape), y=np.empty_like(z), white=np.empty_like(z))
        x = self.x.T.copy()
        given = x, known.F_lanes, known.minus_H_lanes, *gains.lanes, u, z, lanes
        if len(self.places.s) <= NARROW:
            steady(groups.side_by_side(REGISTERS), self.places.c, *given)
        else:
            steady_of_many(self.places.s, self.places.c, *given)
        sound, refused = np.isfinite(gains.log_det), ~(out.nis <= self.data.gates[-1])
        if not (sound.all() and np.isfinite(x).all()):  # the recursion says why
            refused |= ~(sound & np.all(np.isfinite(lanes.x), axis=(1, 2)))
        if np.any(refused):
            stop = start + int(np.argmax(refused))
            if stop == start:
                return stop
            x, gains, rows = lanes.x[stop - start - 1], gains.first(stop - start), slice(start, stop)
        if not groups.ordered:
            out.x[:] = groups.from_lanes(lanes.x, states, groups.n)
            out.y[:], out.white[:] = (groups.from_lanes(a, places, groups.m) for a in (lanes.y, lanes.white))
        self.x, self.P = np.ascontiguousarray(x.T), gains.last
        results.used[rows] = True
        if len(gains.P) == 1 and stop - start == N:  # all of it: nothing to write down for each sample
            sigma, log_det = gains.sigma(groups), gains.log_det
            self.results = results._replace(
                sigma=np.broadcast_to(sigma, results.sigma.shape), log_det=np.broadcast_to(log_det, N)
            )
        else:
            results.sigma[rows], results.log_det[rows] = gains.sigma(groups), gains.log_det
        if len(results.P):
            results.P[rows] = gains.P[:, gains.kind]
        return stop

    def estimates(self, root: Array | None) -> Estimates:
        """Return the estimates; `root` takes the innovations back to where R was not diagonal."""
        results, groups, used = self.results, self.groups, self.data.used
        y, log_det = results.y, results.log_det
        dof = np.full(len(used), used.shape[1]) if self.complete else np.sum(used, axis=1)
        if root is not None:
            y = np.einsum("...ij,...j->...i", root, np.where(used, y, 0.0))
            y[~used] = np.nan
            log_det = log_det + 2 * np.sum(np.log(np.diagonal(root, axis1=-2, axis2=-1)), axis=-1)
        return Estimates(
            results.x, results.sigma, y, results.white, results.nis, log_det, dof, results.used,
            State(self._all(self.x), groups.whole(self.P)), groups.whole(results.P) if self.keep_P else None,
        )  # fmt: skip


@inlined
def lanes(like: Lanes, values: Array, g: int) -> Lanes:
    """Return as many values as `like` has, from place g on: vectors of the processor, once the loop is unrolled."""
    for i in range(len(like)):
        like = tuple_setitem(like, i, values[g + np.uint64(i)])
    return like


@inlined
def rows_of_lanes(like: tuple[Lanes, ...], values: Array, g: int) -> tuple[Lanes, ...]:
    """Return the lanes from place g on of each row of `values`."""
    for i in range(len(like)):
        like = tuple_setitem(like, i, lanes(like[i], values[i], g))
    return like


@inlined
def add_product(total: Lanes, a: Lanes, b: Lanes) -> Lanes:
    """Return total + a b, lane by lane."""
    for i in range(len(total)):
        total = tuple_setitem(total, i, total[i] + a[i] * b[i])
    return total


@inlined
def write(values: Lanes, out: Array, g: int) -> None:
    """Write lanes from place g on."""
    for i in range(len(values)):
        out[g + np.uint64(i)] = values[i]


# tuples in place of small arrays: what a step needs then stays in registers, and several groups are one instruction
@compiled
def steady(
    some: tuple[Lanes, ...], components: Size, x: Array, F: Array, minus_H: Array, K: Array, root: Array, u: Array,
    z: Array, out: SampleArrays,
) -> None:  # fmt: skip
    """Run the filter over N samples: x (s, G) is changed in place; u (N or 1, s, G), z (N, c, G).

    Of `out` x is (N, s, G), y and white (N, c, G). F (s, s, G), -H (c, s, G), K (N or 1, c, s, G), root (N or 1, c, G).
    `some` are the s states of as many groups as are done side by side, of which G is a multiple.
    """
    for g in range(np.uint64(0), np.uint64(z.shape[2]), np.uint64(len(some[0]))):
        after = rows_of_lanes(some, x, g)
        for k in range(len(z)):
            k_u, k_K = min(k, len(u) - 1), min(k, len(K) - 1)
            nis = 0.0 if g == 0 else out.nis[k]
            before = rows_of_lanes(some, u[k_u], g)
            for i in range(len(some)):
                total = before[i]
                for j in range(len(some)):
                    total = add_product(total, lanes(some[0], F[i, j], g), after[j])
                before = tuple_setitem(before, i, total)
            after = before
            for i in range(len(components)):
                innovation = y = lanes(some[0], z[k, i], g)
                for j in range(len(some)):
                    minus_h = lanes(some[0], minus_H[i, j], g)
                    innovation, y = add_product(innovation, minus_h, before[j]), add_product(y, minus_h, after[j])
                white = lanes(some[0], root[k_K, i], g)
                for lane in range(len(white)):
                    white = tuple_setitem(white, lane, white[lane] * y[lane])
                    nis += white[lane] * white[lane]
                write(innovation, out.y[k, i], g)
                write(white, out.white[k, i], g)
                for j in range(len(some)):
                    after = tuple_setitem(after, j, add_product(after[j], lanes(some[0], K[k_K, i, j], g), y))
            for i in range(len(some)):
                write(after[i], out.x[k, i], g)
            out.nis[k] = nis
        for i in range(len(some)):
            write(after[i], x[i], g)


@compiled
def steady_of_many(
    s: Size, c: Size, x: Array, F: Array, minus_H: Array, K: Array, root: Array, u: Array, z: Array, out: SampleArrays
) -> None:
    """Do the same as `steady` with arrays, for groups of more states than tuples are good for."""
    before, after, turned = np.empty(len(s)), np.empty(len(s)), np.ascontiguousarray(F.transpose(2, 1, 0))
    minus_H = np.ascontiguousarray(minus_H.transpose(2, 0, 1))
    for g in range(z.shape[2]):
        for k in range(len(z)):
            k_u, k_K = min(k, len(u) - 1), min(k, len(K) - 1)
            nis = 0.0 if g == 0 else out.nis[k]
            for i in range(len(s)):
                before[i] = u[k_u, i, g]
            for j in range(len(s)):
                x_j = x[j, g]
                for i in range(len(s)):
                    before[i] += turned[g, j, i] * x_j
            for i in range(len(s)):
                after[i] = before[i]
            for i in range(len(c)):
                innovation = y = z[k, i, g]
                for j in range(len(s)):
                    innovation += minus_H[g, i, j] * before[j]
                    y += minus_H[g, i, j] * after[j]
                white = y * root[k_K, i, g]
                out.y[k, i, g], out.white[k, i, g] = innovation, white
                nis += white * white
                for j in range(len(s)):
                    after[j] += K[k_K, i, j, g] * y
            for i in range(len(s)):
                x[i, g] = out.x[k, i, g] = after[i]
            out.nis[k] = nis
