"""A sensor at a known input that changes: a gyro on a turntable, whose scale factor and misalignment are tracked.

::

    z_k = mean reading of the epoch - mean reference = M_k u_k + C x_k + r_k,    r_k ~ N(0, noise^2 / tau)

with the reference u, d axes, and the terms of M, row by row, beside the states of the bias model: each a random walk
of its own density. A sensor that stands still tells nothing of M, and a steady input only its sum with the bias.
Source of the model: `fusion_core.contracts.stimulus`. tau is what was measured of an epoch, s.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np

from fusion_core import contracts
from fusion_core import units as quantities
from fusion_core.chunk import Array, Chunk, constant
from fusion_core.hookspecs import hookimpl
from fusion_core.settings import Settings
from fusion_core.statespace import Block
from fusion_core.thermal.record_texts import Name
from fusion_core.units import Quantity, Unit
from fusion_plugins.measurement_models.held import Held

RATE = 1.0  # in SI: of the input that is made up


class MatrixStates(Settings):
    """The states of scale factor and misalignment."""

    misalignment: bool = True
    """True: misalignments are states too, beside the scale factors."""
    sigma_0: Annotated[float, Unit("1", positive=True, example="1 %")] = Quantity(0.01, "1 %")
    """Deviation of each before the first sample."""
    walk: Annotated[float, Unit("1/sqrt(s)", least=0, example="1 ppm/sqrt(s)")] = Quantity(0.0, "0 1/sqrt(s)")
    """Density of the random walk of each."""


@hookimpl
class Driven(Held):
    """A sensor at a known input that changes."""

    kind: Literal["driven"] = "driven"  # type: ignore[assignment]
    reference: Name
    """Channel of the input, with the axes of the sensor."""
    matrix: MatrixStates = MatrixStates()
    """Scale factor and misalignment."""

    @classmethod
    def _usual_axes(cls, channel: Any) -> tuple[str, ...]:
        return quantities.usual_axes()  # those of a triad

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a gyro on a turntable, with its scale factors alone and with misalignments."""
        bias = {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"}
        one = {"channel": "gyro", "noise": "0.3 deg/sqrt(h)", "bias": bias, "reference": "rate"}
        walks = {"misalignment": False, "walk": "1 ppm/sqrt(s)"}
        return (cls.model_validate(one), cls.model_validate({**one, "matrix": walks}))

    @cached_property
    def own(self) -> tuple[Block, ...]:
        """The terms of M, row by row."""
        axes = self.tracked.axes
        if self.matrix.misalignment:
            labels = [f"misalignment_{i}{j}" if i != j else f"scale_{i}" for i in axes for j in axes]
        else:
            labels = [f"scale_{axis}" for axis in axes]
        n = len(labels)
        prior = contracts.Prior(np.zeros(n), float(self.matrix.sigma_0) ** 2 * np.eye(n))
        return (Block("matrix", tuple(labels), "1", prior),)

    def equations(
        self, chunk: Chunk, steps: Sequence[contracts.Transition], alignment: contracts.Alignment
    ) -> tuple[contracts.Transition, contracts.Measurement]:
        """Measure the bias and the part of the input that the sensor reads in excess."""
        (step,), name, (matrix,) = steps, self.tracked.block.name, self.own
        one, n = np.eye(len(self.tracked.axes)), matrix.n
        u = self.known(chunk, alignment)
        rows = np.einsum("ij,nk->nijk", one, u).reshape(*u.shape, -1) if self.matrix.misalignment else u[:, None] * one
        H = self.space.output({matrix.name: rows, name: one if step.C is None else step.C})
        still = contracts.Transition(np.eye(n), np.zeros((n, n)), np.zeros(n))
        walk = float(self.matrix.walk) ** 2 * chunk.dt[..., None, None] * np.eye(n)
        moves = self.space.transition({matrix.name: still, name: step}, noise={(matrix.name, matrix.name): walk})
        R = np.diag(self.tracked.noise**2) / constant(chunk["tau"])[..., None, None]
        return moves, contracts.Measurement(chunk[self.channel] - u, H, R, np.ones(len(chunk), dtype=bool))

    def aligned(self, window: Chunk, site: contracts.Site) -> contracts.Alignment:
        """Take note of noise and level, less what follows the input: scale and misalignment are no noise."""
        u = self.known(window)
        design = np.column_stack([np.ones(len(u)), u])
        follows = np.linalg.lstsq(design, window[self.channel] - u, rcond=None)[0][1:]
        return super().aligned(window.having(**{self.channel: window[self.channel] - u @ follows}), site)

    def simulated(self, N: int, site: contracts.Site, rng: np.random.Generator) -> Mapping[str, Array]:
        """Return noise about an input that goes from axis to axis, one way and the other."""
        d = len(self.tracked.axes)
        u = RATE * np.eye(d)[np.arange(N) // 20 % d] * np.where(np.arange(N) // 10 % 2, -1.0, 1.0)[:, None]
        noise = super().simulated(N, site, rng)[self.channel]
        return {self.channel: u + noise, self.reference: u}
