"""States made of named blocks: their places, labels, units and prior, and F, Q, u and H with coupling between blocks.

A block is some states with a model of their own: the axes of a position, the bias of a sensor. Blocks that act on one
another are coupled outside the diagonal::

        | F_a   F_ab |        | Q_a    Q_ab |        | u_a |
    F = |            |    Q = |             |    u = |     |    H = | H_a  H_b |
        |  0    F_b  |        | Q_ab'  Q_b  |        | u_b |

with F_ab, of the shape (n_a, n_b), what the states of b before the step add to those of a, and Q_ab the covariance of
their noise. N is the number of steps, n that of all states, m of measured components. Any array may leave its leading N
out ("the same for every step"); a result has one only where something that it is made of does.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_core.checks import check_shape, common_lead
from fusion_core.chunk import Array, Flags
from fusion_core.model import Prior, State, Transition

Pairs = Mapping[tuple[str, str], Array]


@dataclass(frozen=True)
class Block:
    """Some states that have a name and a model of their own.

    Attributes
    ----------
    name : str
        Unique within a state space.
    labels : tuple of str
        Names of the n states, unique within the block.
    units : tuple of str, or str
        Units of the n states; one text is the unit of each.
    prior : Prior or None
        Before the first step; None: zero, known exactly (an integral that begins there).

    Raises
    ------
    ValueError
        If labels, units and prior are not of one length, or two labels are the same.
    """

    name: str
    labels: tuple[str, ...]
    units: tuple[str, ...] | str
    prior: Prior | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "labels", tuple(self.labels))
        units = (self.units,) * self.n if isinstance(self.units, str) else tuple(self.units)
        object.__setattr__(self, "units", units)
        if len(units) != self.n:
            raise ValueError(
                f"block {self.name}: has {len(units)} units for {self.n} labels; give one for each, or one"
            )
        if len(set(self.labels)) != self.n:
            raise ValueError(
                f"block {self.name}: two of its labels are the same ({', '.join(self.labels)}); rename one"
            )
        if self.prior is not None:
            self.checked(self.prior)

    @property
    def n(self) -> int:
        """Number of states."""
        return len(self.labels)

    def checked(self, prior: Prior) -> Prior:
        """Return a prior of this block; raises ValueError where it is not x (n,), P (n, n)."""
        check_shape(f"block {self.name}", "prior x", prior.x, (self.n,))
        check_shape(f"block {self.name}", "prior P", prior.P, (self.n, self.n))
        return prior


class StateSpace:
    """States made of blocks, in the order in which they are given.

    Parameters
    ----------
    blocks : iterable of Block
        One or more.

    Attributes
    ----------
    blocks : dict of str to Block
    places : dict of str to slice
        Where the states of each block stand.
    labels, units : list of str
        Of the n states. Labels of a block are preceded by its name where another block has one of them too.

    Raises
    ------
    ValueError
        If two blocks have the same name, or a label is still not unique.
    """

    def __init__(self, blocks: Iterable[Block]) -> None:
        blocks = tuple(blocks)
        self.blocks = {block.name: block for block in blocks}
        if len(self.blocks) != len(blocks):
            names = ", ".join(block.name for block in blocks)
            raise ValueError(f"state space: two of its blocks have the same name ({names}); rename one")
        ends = np.cumsum([0, *(block.n for block in blocks)]).tolist()
        self.n: int = ends[-1]
        self.places = {block.name: slice(*ends[k : k + 2]) for k, block in enumerate(blocks)}
        self.units = [unit for block in blocks for unit in block.units]
        plain = [label for block in blocks for label in block.labels]
        self.labels: list[str] = []
        for block in blocks:
            shared = any(plain.count(label) > 1 for label in block.labels)
            self.labels += [f"{block.name}_{label}" if shared else label for label in block.labels]
        if len(set(self.labels)) != self.n:
            raise ValueError(f"state space: labels are not unique ({', '.join(self.labels)}); rename one")

    def select(self, *names: str) -> NDArray[np.intp]:
        """Return the places of states, each name that of a block or a label: an index for x, or a row of H."""
        every = np.arange(self.n)
        found = []
        for name in names:
            if name in self.places:
                found.append(every[self.places[name]])
            elif name in self.labels:
                found.append(every[[self.labels.index(name)]])
            else:
                known = ", ".join(dict.fromkeys([*self.places, *self.labels]))
                raise ValueError(f"state space: has no block or label '{name}'; name one of {known}")
        return np.concatenate(found) if found else every[:0]

    def flags(self, *names: str) -> Flags:
        """Return (n,) flags: true for the states of the named blocks or labels."""
        return np.isin(np.arange(self.n), self.select(*names))

    def prior(self, given: Mapping[str, Prior] | None = None) -> State:
        """Return the joint state before the first step, the blocks independent; `given` replaces their own priors."""
        x, P = np.zeros(self.n), np.zeros((self.n, self.n))
        for name in given or ():
            self.block(name)
        for name, block in self.blocks.items():
            prior = block.prior if given is None or name not in given else block.checked(given[name])
            if prior is not None:
                here = self.places[name]
                x[here], P[here, here] = prior.x, prior.P
        return State(x, P)

    def transition(
        self, parts: Mapping[str, Transition], coupling: Pairs | None = None, noise: Pairs | None = None
    ) -> Transition:
        """Return the transition of all states; a part's C is not looked at (`output` puts one where it belongs).

        Parameters
        ----------
        parts : mapping of block to Transition
            How each block moves by itself. One that is not named stays where it is: F = I, Q = 0, u = 0.
        coupling : mapping of (a, b) to (n_a, n_b) or (N, n_a, n_b) array
            What the states of b before the step add to those of a: F_ab.
        noise : mapping of (a, b) to (n_a, n_b) or (N, n_a, n_b) array
            Covariance of the noise of a with that of b; its transpose is put at (b, a). At (a, a) it is added to what
            the part has.

        Raises
        ------
        ValueError
            If a name is unknown, or a shape is not that of its blocks.
        """
        coupling, noise = coupling or {}, noise or {}
        F = {(name, name): part.F for name, part in parts.items()}
        for pair in coupling:
            if pair[0] == pair[1]:
                raise ValueError(f"state space: coupling of {pair[0]} with itself; put it into the F of its part")
        Q = {(name, name): part.Q for name, part in parts.items()}
        for (a, b), array in noise.items():
            if a == b:
                self.matrix({(a, a): array}, name="noise")  # of the right shape, before it is added
                Q[a, a] = Q[a, a] + array if a in parts else array
            elif (b, a) in noise:
                raise ValueError(f"state space: noise of ({a}, {b}) and of ({b}, {a}); give one, the other follows")
            else:
                Q[a, b], Q[b, a] = array, np.swapaxes(array, -1, -2)
        return Transition(
            self.matrix({**F, **coupling}, np.eye(self.n), "F"),
            self.matrix(Q, name="Q"),
            self.vector({name: part.u for name, part in parts.items()}, "u"),
        )

    def output(self, parts: Mapping[str, Array]) -> Array:
        """Return H (m, n) or (N, m, n) from the columns (m, n_a) or (N, m, n_a) of each block; zero for all others.

        C, the bias of d axes as a function of the states, is one too.
        """
        if not parts:
            raise ValueError("state space: no block is measured; name at least one")
        rows = [np.shape(array) for array in parts.values()]
        m = max(shape[-2] if len(shape) > 1 else 1 for shape in rows)
        arrays = {f"H of {name}": np.asarray(array) for name, array in parts.items()}
        for (what, array), name in zip(arrays.items(), parts, strict=True):
            check_shape("state space", what, array, (m, self.block(name).n), lead=True)
        whole = np.zeros((*common_lead("state space", arrays, 2), m, self.n))
        for name, array in parts.items():
            whole[..., self.places[name]] = array
        return whole

    def matrix(self, parts: Pairs, base: Array | None = None, name: str = "matrix") -> Array:
        """Return (n, n) or (N, n, n) with part (a, b) at the rows of a and the columns of b; elsewhere `base`, or 0."""
        arrays = {f"{name} of ({a}, {b})": np.asarray(array) for (a, b), array in parts.items()}
        for (what, array), (a, b) in zip(arrays.items(), parts, strict=True):
            check_shape("state space", what, array, (self.block(a).n, self.block(b).n), lead=True)
        whole = np.zeros((*common_lead("state space", arrays, 2), self.n, self.n))
        if base is not None:
            whole[:] = base
        for (a, b), array in parts.items():
            whole[..., self.places[a], self.places[b]] = array
        return whole

    def vector(self, parts: Mapping[str, Array], name: str = "vector") -> Array:
        """Return (n,) or (N, n) with each part (n_a,) or (N, n_a) at its block's place, and 0 elsewhere."""
        arrays = {f"{name} of {key}": np.asarray(array) for key, array in parts.items()}
        for (what, array), key in zip(arrays.items(), parts, strict=True):
            check_shape("state space", what, array, (self.block(key).n,), lead=True)
        whole = np.zeros((*common_lead("state space", arrays, 1), self.n))
        for key, array in parts.items():
            whole[..., self.places[key]] = array
        return whole

    def block(self, name: str) -> Block:
        """Return the block of that name; raises ValueError where there is none."""
        try:
            return self.blocks[name]
        except KeyError:
            known = ", ".join(self.blocks)
            raise ValueError(f"state space: has no block '{name}'; name one of {known}") from None
