"""Bias as an unknown constant.

::

    b_k = b_{k-1}

One state an axis, the bias itself. The estimate is the running mean of the gyro at rest, and its variance goes
to zero: right for a turn-on bias over minutes, wrong for anything that drifts.
"""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np

from fusion_core.chunk import Chunk
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit
from fusion_plugins.bias_models.start import deviation


class Constant(BiasModel):
    """Bias as an unknown constant."""

    kind: Literal["constant"] = "constant"
    sigma_0: Annotated[float, Unit("bias", positive=True)] | None = None  # before the first sample; default 1 SI unit

    def prior(self) -> Prior:
        """Return zero with a variance that the first seconds at rest overrule."""
        d = len(self.axes)
        return Prior(np.zeros(d), np.diag(deviation(self.sigma_0, d) ** 2))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return F = I and Q = 0."""
        d = len(self.axes)
        return Transition(np.eye(d), np.zeros((d, d)), np.zeros(d)), memory


@hookimpl
def bias_models() -> list[type[BiasModel]]:
    """Register the plugin."""
    return [Constant]
