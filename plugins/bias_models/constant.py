"""Bias as an unknown constant.

::

    b_k = b_{k-1}

One state an axis, the bias itself. The estimate is the running mean of the gyro at rest, and its variance goes
to zero: right for a turn-on bias over minutes, wrong for anything that drifts.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from fusion_core.chunk import Chunk
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.hookspecs import hookimpl


@hookimpl
class Constant(BiasModel):
    """Bias as an unknown constant."""

    kind: Literal["constant"] = "constant"

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule."""
        d = len(self.axes)
        return Prior(np.zeros(d), np.diag(self.initial_sigma**2))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F = I and Q = 0."""
        d = len(self.axes)
        return Transition(np.eye(d), np.zeros((d, d)), np.zeros(d)), memory
