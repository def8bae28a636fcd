"""The contract of stimuli: how the input of a triad is known while its terms are fitted.

The readings of a triad are::

    y = (I + M(T)) u + b(T) + G(T) f + noise

with the input u, M_ii the error of a scale factor, M_ij the part of the input along j that axis i reads, and of a gyro
G its g-sensitivity under the specific force f. The terms are the bias, 3, and M row by row, 9: `TERMS`; where it is
asked for, G row by row follows, 9: `SENSITIVITIES`. A stimulus makes of recordings equations in these terms; the fit
of their curves over temperature is the same for each. N samples, m equations, q terms, 12 or 21.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array, Chunk, Flags, Integers
from fusion_core.contracts.plugin import Plugin
from fusion_core.contracts.sensor import Site
from fusion_core.errors import ConfigError

AXES = "xyz"
PAIRS = tuple(i + j for i in AXES for j in AXES)
TERMS = tuple(f"bias {i}" for i in AXES) + tuple(
    f"scale {p[0]}" if p[0] == p[1] else f"misalignment {p}" for p in PAIRS
)
SENSITIVITIES = tuple(f"g-sensitivity {p}" for p in PAIRS)
BELOW = (6, 9, 10)  # of the terms: M below its diagonal, zero in the frame that the sensor itself defines


@dataclass(frozen=True, eq=False)
class Equations:
    """The linearised equations of a stimulus about some terms: left = J (change of the terms at T) + noise.

    Attributes
    ----------
    left : (m,) array
        Measured less modelled.
    J : (m, q) array
        Derivative of the modelled by the terms.
    T, t : (m,) arrays
        Temperatures, degC, and times, s, by which the bias walks from one equation to another.
    group : (m,) array of int
        Equations of one kind of noise, 0 or 1, whose size is found from them. Within it all count alike: after seconds
        at rest it is the instability and the mounting that are left, and no longer white noise.
    recording : (m,) array of int, optional
        Recording of each, in their order; the level of the bias is another in each. All are of one without it.
    """

    left: Array
    J: Array
    T: Array
    t: Array
    group: Integers
    recording: Integers | None = None


class TriadInput(ABC):
    """The input of a triad, as far as it is known."""

    sensor_frame: bool = False
    """True where the frame is the sensor's own: M then has 6 terms."""
    unsure: float = 0.0
    """Deviation of the size of the input, as a share of it, the same in all equations."""
    parts: TriadInput | None = None
    """The first quarter and the rest of each segment or placement in turn, whose input is the same, if it is known."""

    @property
    @abstractmethod
    def T(self) -> Array:
        """Temperatures of the equations."""

    @abstractmethod
    def equations(self, values: Array) -> Equations:
        """Return the equations about terms (len(T), q), the values at each of `T`."""

    @abstractmethod
    def lacking(self, term: int) -> str:
        """Return the reason that a term of `TERMS`, then `SENSITIVITIES`, cannot be seen, then `; REMEDY`."""

    @property
    def free(self) -> Flags:
        """True for those of `TERMS` (12,) that are looked for."""
        free = np.ones(len(TERMS), dtype=bool)
        free[list(BELOW)] = not self.sensor_frame
        return free


class Stimulus(Plugin):
    """A source of the input of a triad; `stimulus` of a config."""

    # must

    @abstractmethod
    def inputs(
        self, recordings: Sequence[Chunk], channel: str, site: Site, length: tuple[float, float] | None
    ) -> TriadInput:
        """Return the input of a triad that recordings show.

        Parameters
        ----------
        recordings : sequence of Chunk
            Whole, in the order of the command, each with `temperature` and the channels of the config; calibrations of
            the other sensors are subtracted.
        channel : str
            That of the triad, (N, 3).
        site : Site
        length : pair of float, or None
            Length of its input at rest and the deviation of that, where its direction is not known: gravity.

        Raises
        ------
        ConfigError, DataError
            If it knows nothing of such a triad, or the recordings do not hold what it needs.
        """

    # may

    def simulated(self, channel: str, values: Array, rng: np.random.Generator) -> Sequence[Chunk]:
        """Return recordings of a triad with terms (q,) under this stimulus, nearly without noise, at one temperature.

        With them `fusion_core.testing` holds it to its laws. By default ConfigError.
        """
        raise ConfigError(f"{self.kind}: simulates no recording of {channel}; define simulated() to have its laws held")


def inverted(values: Array) -> tuple[Array, Array]:
    """Return (I + M)^-1 (N, 3, 3) and the bias (N, 3) of terms (N, q)."""
    return np.asarray(np.linalg.inv(np.eye(3) + values[:, 3:12].reshape(-1, 3, 3))), values[:, :3]


def strain(values: Array, force: Array | None) -> Array:
    """Return G f (N, 3) of terms (N, q) under a force (N, 3); zero where there is no G, or no force is known."""
    if values.shape[1] == len(TERMS) or force is None:
        return np.zeros((len(values), 3))
    return np.asarray(np.einsum("nij,nj->ni", values[:, 12:].reshape(-1, 3, 3), force))


def input_derivative(W: Array, u: Array, force: Array | None = None) -> Array:
    """Return du/dterms (N, 3, 12) of the input u = W (y - b - G f) (N, 3), where W (N, 3, 3) = (I + M)^-1.

    (N, 3, 21) with a force f (N, 3).
    """
    of_M = -np.einsum("nki,nj->nkij", W, u).reshape(len(u), 3, 9)
    of_G = [] if force is None else [-np.einsum("nki,nj->nkij", W, force).reshape(len(u), 3, 9)]
    return np.concatenate([-W, of_M, *of_G], axis=2)
