"""Map as a small neural network for each axis, kept as one ONNX graph of all axes.

::

    b(T) = tanh(tanh(T W_1 + a_1) W_2 + a_2) W_3 + a_3          T in degC, b in rad/s, all in float64

Two hidden layers of h tanh neurons an axis, trained by Levenberg-Marquardt on the means of narrow temperature
bins. W_2 and W_3 are block-diagonal (no axis hears of another); the scaling of T and b is folded into the
first and last layer. Source: section 5 of Fontanella et al., Sensors 18 (2018) 1457.

With `target: slope` the network gives the derivative of the bias, as the paper's filter has it:

::

    db/dT = tanh(tanh(T W_1 + a_1) W_2 + a_2) W_3 + a_3         rad/s/K
    b(T)  = c + integral of db/dT from T_min to T                c: the mean residual over all samples is zero

It is trained on the differences of neighbouring bin means. Two neighbours share a bin mean, so their errors are
correlated; with that covariance the least-squares sum is the one of the bin means themselves about the network's
integral, its constant left free, and it is computed so. (Taken as independent, the differences would weigh the
edges of the range most and lose the curve between them.)

The map's record is the text under `driftlab_map` of the file's metadata_props, with the target and c. A graph of
other hands with one is taken too: where it gives the bias, `bias` runs whatever onnxruntime runs and `slope` needs
a chain of MatMul or Gemm, Add and Tanh; where it gives the slope, any graph will do.
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
    LARGEST,
    SLAB,
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
    Curve,
    NetworkFile,
    Target,
    Weights,
    answer,
    antiderivative,
    damaged,
    derive,
    export,
    first_line,
    forward,
    open_session,
    read_chain,
    side_by_side,
)
from fusion_plugins.thermal_maps.soak_noise import Blocks
from fusion_plugins.thermal_maps.training import Linear, between, search

_BINS: dict[Target, int] = {"bias": 600, "slope": 300}  # a node of the slope stands for each gap and half of it
_PRIOR = 3.0  # deviation of a weight of the scaled problem, where the samples leave it free


@dataclass(frozen=True, eq=False)
class OnnxMap(FittedMap):
    """A fitted network: the bytes of its ONNX file, what messages call it, and the bias (d,) at T_min of a slope's."""

    graph: bytes
    name: str
    constant: tuple[float, ...] | None = None

    @property
    def target(self) -> Target:
        """What the graph gives."""
        return "bias" if self.constant is None else "slope"

    def save(self, path: Path) -> None:
        """Write the ONNX file."""
        write_file(self.record.kind, path, self.graph)

    @cached_property
    def _session(self) -> tuple[Any, str, type[np.floating[Any]], bool]:
        """Session, name and numbers of its input, and whether that is (N,) and not (N, 1)."""
        session = open_session(self.graph)
        inputs = session.get_inputs()
        types = [entry.type for entry in inputs]
        if types not in (["tensor(double)"], ["tensor(float)"]):
            raise ValueError(f"its inputs are {types}, not one tensor of double or float")
        numbers = np.float64 if types[0] == "tensor(double)" else np.float32
        return session, inputs[0].name, numbers, len(inputs[0].shape) == 1

    @cached_property
    def _chain(self) -> Chain:
        steps = read_chain(self.graph, self.name)
        T = np.linspace(*self.domain, 5)
        expected = self._run(T)
        found = derive(steps, T)[0]
        if found.shape != expected.shape or not np.allclose(
            found, expected, rtol=0, atol=1e-4 * np.abs(expected).max()
        ):
            raise MapError(f"{self.name} is not the chain of its layers, expected one for the slope; export it as one")
        return steps

    @cached_property
    def _integral(self) -> Curve:
        return antiderivative(self._run, self.domain)

    def _bias(self, T: Array) -> Array:
        return self._run(T) if self.constant is None else np.array(self.constant) + self._integral(T)

    def _slope(self, T: Array) -> Array:
        return derive(self._chain, T)[1] if self.constant is None else self._run(T)

    def _run(self, T: Array) -> Array:
        N, d = len(T), len(self.record.residual)
        if N == 0:
            return np.empty((0, d))
        try:
            session, name, numbers, flat = self._session
            values = T.astype(numbers)
            result = np.asarray(session.run(None, {name: values if flat else values[:, None]})[0], dtype=np.float64)
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
        good = np.abs(result.reshape(N, d)) <= LARGEST  # neither NaN
        if not np.all(good):
            what = f"that is not a finite number at T = {T[int(np.argmin(np.all(good, axis=1)))]:.6g} degC"
            raise MapError(f"{self.name} gives a bias {what}, expected {self.record.unit}; refit it")
        return result.reshape(N, d)


class OnnxNetwork(ThermalMap):
    """Map as a small neural network for each axis."""

    suffix: ClassVar[str] = ".onnx"

    kind: Literal["onnx_network"] = "onnx_network"
    target: Target = "bias"  # what the network gives: the bias, or its derivative with temperature
    neurons: Annotated[int, Field(ge=1, le=20)] = 2  # in each of the two hidden layers, an axis
    starts: Annotated[int, Field(ge=1, le=1000)] = 8  # of the training; the best is kept
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0  # of the starts

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> OnnxMap:
        """Train a network an axis on the means of narrow temperature bins."""
        T, bias = check_samples(self.kind, T, bias)
        what = f"a network of 2 x {self.neurons} neurons an axis"
        weights = self.neurons**2 + 4 * self.neurons + 1
        check_swing(self.kind, T, self.min_swing, weights, what, "use fewer neurons")
        bins = bin_samples(T, bias, _BINS[self.target])
        networks = [
            train(bins.T, y, variance, self.neurons, self.starts, self.seed, self.target)
            for y, variance in zip(bins.bias.T, bins.variance.T, strict=True)
        ]
        network = side_by_side(networks)
        predict, constant = self._prediction(network, T, bias)
        domain = (float(T.min()), float(T.max()))

        def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
            weight = 1 / bins.variance[:, axis]
            taken = answer(networks[axis], (bins.T, weight), grid, domain, self.target)
            return taken @ blocks.shares(bins.of_sample, len(bins.T))

        record = record_fit(self.kind, T, bias, provenance, predict, smoother)
        graph = export(network, record, constant)
        return OnnxMap(record, graph, f"{self.kind}: the fitted map", constant, outside=self.outside)

    def _prediction(self, network: Weights, T: Array, bias: Array) -> tuple[Curve, tuple[float, ...] | None]:
        """Return the bias as a function of T, and the bias at T_min where the network gives the slope."""

        def run(T: Array) -> Array:
            return forward(network, T)[-1]

        if self.target == "bias":
            return run, None
        integral = antiderivative(run, (float(T.min()), float(T.max())))
        slabs = range(0, len(T), SLAB)
        sums = [np.sum(bias[k : k + SLAB] - integral(T[k : k + SLAB]), axis=0) for k in slabs]
        constant = np.sum(sums, axis=0) / len(T)
        return lambda T: constant + integral(T), tuple(constant.tolist())

    def read(self, path: Path) -> OnnxMap:
        """Read the ONNX file, and try it."""
        name, graph = f"{self.kind}: map file {path}", read_file(self.kind, path)
        try:
            found = open_session(graph).get_modelmeta().custom_metadata_map
        except Exception as error:  # those of onnxruntime have no base of their own
            raise damaged(name, error) from None
        if KEY not in found:
            raise MapError(
                f"{name} has no '{KEY}' in its metadata_props, expected the record there (kind, domain, "
                f"unit, residual, samples); fit it with `driftlab fit-map`, or add the record to the file"
            )
        content = parse(self.kind, path, found[KEY], NetworkFile)
        record = content.record
        fitted = OnnxMap(record, graph, name, content.constant, outside=self.outside)
        for T in (np.array(record.domain), np.linspace(*record.domain, 33)):
            fitted.bias(T)  # a graph that cannot be run, or gives NaN, says so now
        return fitted


def train(
    T: Array, y: Array, variance: Array, neurons: int, starts: int, seed: int, target: Target = "bias"
) -> Weights:
    """Train the network of one axis by Levenberg-Marquardt from several random starts.

    T and y are scaled to the order of 1, and the weights have a normal prior there: without it a neuron may
    switch within a fraction of a kelvin to follow a few noisy samples, and the slope has a spike.

    Parameters
    ----------
    T, y, variance : (m,) arrays
        Temperature in degC, ascending; bias in rad/s, and the variance of the bias.
    neurons, starts, seed : int
        Size of each hidden layer, starts to try, and what makes them the same each time.
    target : "bias" or "slope"
        What the network gives.

    Returns
    -------
    Weights of the best start, from degC to rad/s (slope: to rad/s/K).
    """
    w = variance.min() / variance
    p, sigma = w / w.sum(), np.sqrt(variance.min() / w.sum())  # of the mean
    centre, half, mean = (T.max() + T.min()) / 2, np.ptp(T) / 2, p @ y
    deviation = max(np.sqrt(p @ (y - mean) ** 2), sigma)
    ridge = max(sigma / (deviation * _PRIOR), 1e-6)
    linearise = _problem((T - centre) / half, (y - mean) / deviation, p, neurons, target)
    rng = np.random.default_rng(seed)
    theta = search(linearise, [_start(rng, neurons) for _ in range(starts)], ridge)
    (W_1, a_1), hidden, (W_3, a_3) = _unpack(theta, neurons)
    scale, shift = (deviation, mean) if target == "bias" else (deviation / half, 0.0)
    return [(W_1 / half, a_1 - W_1[0] * (centre / half)), hidden, (W_3 * scale, a_3 * scale + shift)]


def _problem(x: Array, y: Array, p: Array, h: int, target: Target) -> Linear:
    """Return the residuals (m,) and their derivative (m, p) as a function of the packed weights."""
    root = np.sqrt(p)
    nodes, integrate = between(x, 2 / _BINS["slope"])

    def linearise(theta: Array) -> tuple[Array, Array]:
        if target == "bias":
            J = _jacobian(theta, h, x)
        else:
            J = integrate(_jacobian(theta, h, nodes))
            J = J - p @ J  # the constant that fits best
        J *= root[:, None]
        return J[:, -h - 1 :] @ theta[-h - 1 :] - root * y, J  # the last layer is linear

    return linearise


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
    J = np.ones((len(x), len(theta)))
    of_W_1, of_a_1, of_W_2, of_a_2, of_W_3, _ = np.split(J, np.cumsum([h, h, h * h, h, h]), axis=1)
    of_W_3[:] = hidden_2
    np.multiply(1 - hidden_2**2, network[2][0][:, 0], out=of_a_2)
    np.multiply(1 - hidden_1**2, of_a_2 @ network[1][0].T, out=of_a_1)
    np.multiply(x[:, None], of_a_1, out=of_W_1)
    of_W_2[:] = (hidden_1[:, :, None] * of_a_2[:, None, :]).reshape(len(x), h * h)
    return J


@hookimpl
def thermal_maps() -> list[type[ThermalMap]]:
    """Register the plugin."""
    return [OnnxNetwork]
