"""Map as a small neural network for each axis, kept as one ONNX graph of all axes.

::

    b(T) = tanh(tanh(T W_1 + a_1) W_2 + a_2) W_3 + a_3          T in degC, b in rad/s, all in float64

Two hidden layers of h tanh neurons an axis, trained by Levenberg-Marquardt on the means of narrow temperature
bins. W_2 and W_3 are block-diagonal (no axis hears of another); the scaling of T and b is folded into the
first and last layer. Source: section 5 of Fontanella et al., Sensors 18 (2018) 1457.

The map's record is the text under `driftlab_map` of the file's metadata_props. A graph of other hands with
one is taken too: `bias` runs whatever onnxruntime runs, `slope` needs a chain of MatMul or Gemm, Add and Tanh.
The last bits may depend on how many samples are asked for at once (1e-12 of the map's range): matrix products
are summed in another order.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import MapError
from fusion_core.hookspecs import hookimpl
from fusion_plugins.thermal_maps.common import (
    MapFile,
    bin_samples,
    check_samples,
    check_swing,
    parse,
    read_file,
    record_fit,
    write_file,
)
from fusion_plugins.thermal_maps.onnx_graph import (
    KEY,
    Chain,
    Weights,
    derive,
    export,
    first_line,
    load_model,
    read_chain,
)

_BINS = 600
_PRIOR = 3.0  # deviation of a weight of the scaled problem, where the samples leave it free


@dataclass(frozen=True, eq=False)
class OnnxMap(FittedMap):
    """A fitted network: the bytes of its ONNX file, and what messages call it."""

    graph: bytes
    name: str

    def save(self, path: Path) -> None:
        """Write the ONNX file."""
        write_file(self.record.kind, path, self.graph)

    @cached_property
    def _session(self) -> Any:
        """An onnxruntime session of one thread, which gives the same bits each time."""
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.use_deterministic_compute = True
        options.log_severity_level = 4  # what it has to say comes as an exception
        session = onnxruntime.InferenceSession(self.graph, options, providers=["CPUExecutionProvider"])
        types = [entry.type for entry in session.get_inputs()]
        if types not in (["tensor(double)"], ["tensor(float)"]):
            raise ValueError(f"its inputs are {types}, not one tensor of double or float")
        return session

    @cached_property
    def _chain(self) -> Chain:
        steps = read_chain(self.graph, self.name)
        T = np.linspace(*self.domain, 5)
        expected = self._bias(T)
        found = derive(steps, T)[0]
        if found.shape != expected.shape or not np.allclose(
            found, expected, rtol=0, atol=1e-4 * np.abs(expected).max()
        ):
            raise MapError(f"{self.name} is not the chain of its layers, expected one for the slope; export it as one")
        return steps

    def _bias(self, T: Array) -> Array:
        N, d = len(T), len(self.record.residual)
        if N == 0:
            return np.empty((0, d))
        try:
            entry = self._session.get_inputs()[0]
            values = T.astype(np.float64 if entry.type == "tensor(double)" else np.float32)
            feed = {entry.name: values if len(entry.shape) == 1 else values[:, None]}
            result = np.asarray(self._session.run(None, feed)[0], dtype=np.float64)
        except Exception as error:  # those of onnxruntime have no base of their own
            raise MapError(
                f"{self.name} cannot be run ({first_line(error)}), "
                f"expected a graph from T (N, 1) to (N, {d}); export it so"
            ) from None
        if result.shape not in {(N, d), (N * d, 1), (N * d,)}:
            raise MapError(
                f"{self.name} gives the shape {result.shape} for {N} temperatures, expected ({N}, {d}); "
                f"export it with one output an axis, or list one residual an axis in its record"
            )
        return result.reshape(N, d)

    def _slope(self, T: Array) -> Array:
        return derive(self._chain, T)[1]


class OnnxNetwork(ThermalMap):
    """Map as a small neural network for each axis."""

    suffix: ClassVar[str] = ".onnx"

    kind: Literal["onnx_network"] = "onnx_network"
    neurons: Annotated[int, Field(ge=1, le=20)] = 2  # in each of the two hidden layers, an axis
    starts: Annotated[int, Field(ge=1)] = 8  # of the training; the best is kept
    seed: Annotated[int, Field(ge=0)] = 0  # of the starts

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> OnnxMap:
        """Train a network an axis on the means of narrow temperature bins."""
        T, bias = check_samples(self.kind, T, bias)
        what = f"a network of 2 x {self.neurons} neurons an axis"
        weights = self.neurons**2 + 4 * self.neurons + 1
        check_swing(self.kind, T, self.min_swing, weights, what, "use fewer neurons")
        bins = bin_samples(T, bias, _BINS)
        networks = [
            train(bins.T, y, variance, self.neurons, self.starts, self.seed)
            for y, variance in zip(bins.bias.T, bins.variance.T, strict=True)
        ]
        network = side_by_side(networks)
        record = record_fit(self.kind, T, bias, provenance, lambda T: forward(network, T)[-1])
        return OnnxMap(record, export(network, record), f"{self.kind}: the fitted map", outside=self.outside)

    def read(self, path: Path) -> OnnxMap:
        """Read the ONNX file, and try it."""
        name, graph = f"{self.kind}: map file {path}", read_file(self.kind, path)
        found = {entry.key: entry.value for entry in load_model(graph, name).metadata_props}
        if KEY not in found:
            raise MapError(
                f"{name} has no '{KEY}' in its metadata_props, expected the record there (kind, domain, "
                f"unit, residual, samples); fit it with `driftlab fit-map`, or add the record to the file"
            )
        record = parse(self.kind, path, found[KEY], MapFile).record
        fitted = OnnxMap(record, graph, name, outside=self.outside)
        if not np.all(np.isfinite(fitted.bias(np.array(record.domain)))):
            raise MapError(f"{name} gives a bias that is not a finite number, expected {record.unit}; refit it")
        return fitted


def forward(network: Weights, T: Array) -> tuple[Array, Array, Array]:
    """Return the values of both hidden layers (N, h) and the output (N, d) at T (N,)."""
    (W_1, a_1), (W_2, a_2), (W_3, a_3) = network
    hidden_1 = np.tanh(T[:, None] * W_1 + a_1)
    hidden_2 = np.tanh(hidden_1 @ W_2 + a_2)
    return hidden_1, hidden_2, hidden_2 @ W_3 + a_3


def train(T: Array, y: Array, variance: Array, neurons: int, starts: int, seed: int) -> Weights:
    """Train the network of one axis by Levenberg-Marquardt from several random starts.

    T and y are scaled to the order of 1, and the weights have a normal prior there: without it a neuron may
    switch within a fraction of a kelvin to follow a few noisy samples, and the slope has a spike.

    Parameters
    ----------
    T, y, variance : (m,) arrays
        Temperature in degC, bias in rad/s, and the variance of the bias.
    neurons, starts, seed : int
        Size of each hidden layer, starts to try, and what makes them the same each time.

    Returns
    -------
    Weights of the best start, from degC to rad/s.
    """
    from scipy.optimize import least_squares

    w = 1 / variance
    p = w / w.sum()
    centre, half, mean = (T.max() + T.min()) / 2, np.ptp(T) / 2, p @ y
    deviation = np.sqrt(p @ (y - mean) ** 2) or 1.0
    x, target, root = (T - centre) / half, (y - mean) / deviation, np.sqrt(p)
    ridge = max(1 / (np.sqrt(w.sum()) * deviation * _PRIOR), 1e-6)

    def residuals(theta: Array) -> Array:
        return np.concatenate([root * (forward(_unpack(theta, neurons), x)[-1][:, 0] - target), ridge * theta])

    def jacobian(theta: Array) -> Array:
        return np.vstack([root[:, None] * _jacobian(theta, neurons, x), ridge * np.eye(len(theta))])

    rng = np.random.default_rng(seed)
    found = [
        least_squares(residuals, _start(rng, neurons), jacobian, method="lm", x_scale="jac", max_nfev=500)
        for _ in range(starts)
    ]
    (W_1, a_1), hidden, (W_3, a_3) = _unpack(min(found, key=lambda result: result.cost).x, neurons)
    return [(W_1 / half, a_1 - W_1[0] * (centre / half)), hidden, (W_3 * deviation, a_3 * deviation + mean)]


def _start(rng: np.random.Generator, h: int) -> Array:
    """Draw weights whose first neurons switch somewhere inside the range, some slowly and some abruptly."""
    steep = 10 ** rng.uniform(-0.3, 1.0, h) * rng.choice([-1.0, 1.0], h)
    return np.concatenate([steep, -steep * rng.uniform(-1, 1, h), rng.normal(size=h * (h + 2)), np.zeros(1)])


def _unpack(theta: Array, h: int) -> Weights:
    W_1, a_1, W_2, a_2, W_3, a_3 = np.split(theta, np.cumsum([h, h, h * h, h, h]))
    return [(W_1.reshape(1, h), a_1), (W_2.reshape(h, h), a_2), (W_3.reshape(h, 1), a_3)]


def _jacobian(theta: Array, h: int, x: Array) -> Array:
    """Return the derivative of the output with the packed weights (m, p), by back-propagation."""
    network = _unpack(theta, h)
    hidden_1, hidden_2, _ = forward(network, x)
    to_2 = (1 - hidden_2**2) * network[2][0][:, 0]
    to_1 = (1 - hidden_1**2) * (to_2 @ network[1][0].T)
    W_2 = (hidden_1[:, :, None] * to_2[:, None, :]).reshape(len(x), h * h)
    return np.hstack([x[:, None] * to_1, to_1, W_2, to_2, hidden_2, np.ones((len(x), 1))])


def side_by_side(networks: list[Weights]) -> Weights:
    """Join networks of one output each into one of d outputs; they share T and nothing else."""
    from scipy.linalg import block_diag

    joined = [
        (block_diag(*(W for W, _ in layer)), np.concatenate([a for _, a in layer]))
        for layer in zip(*networks, strict=True)
    ]
    joined[0] = (joined[0][0].sum(axis=0, keepdims=True), joined[0][1])
    return joined


@hookimpl
def thermal_maps() -> list[type[ThermalMap]]:
    """Register the plugin."""
    return [OnnxNetwork]
