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
other hands with one is taken too, where it is made of the operations of `onnx_graph`, which are checked before one
is run: where it gives the bias, `slope` needs a chain of MatMul or Gemm, Add and Tanh; where it gives the slope, any
such graph will do.
The last bits may depend on how many samples are asked for at once (1e-12 of the map's range): matrix products
are summed in another order, and MANY samples, or one alone, are read from a table of the graph where that is as exact
(`curve_table`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import Field

from fusion_core import contracts
from fusion_core.chunk import Array
from fusion_core.errors import MapError
from fusion_core.hookspecs import hookimpl
from fusion_core.thermal.soak_noise import Blocks, Smoother
from fusion_plugins.thermal_maps import network as net
from fusion_plugins.thermal_maps import onnx_graph
from fusion_plugins.thermal_maps.common import Bins, bin_samples, record_fit
from fusion_plugins.thermal_maps.curve_table import CurveTable
from fusion_plugins.thermal_maps.onnx_graph import KEY

MANY = 4096  # temperatures at once from which on a table takes less time than the graph; for one, the call is long


@dataclass(frozen=True, eq=False)
class OnnxMap(contracts.FittedMap):
    """A fitted network: the bytes of its ONNX file, what messages call it, and the bias (d,) at T_min of a slope's."""

    graph: bytes
    name: str
    constant: tuple[float, ...] | None = None

    @property
    def target(self) -> contracts.Target:
        """The output of the graph."""
        return "bias" if self.constant is None else "slope"

    def save(self, path: Path) -> None:
        """Write the ONNX file, with the record that the map has by now."""
        import onnx

        graph = onnx_graph.described(onnx.load_model_from_string(self.graph), self.record, self.constant)
        contracts.write_bytes(self.record.kind, path, graph)

    @cached_property
    def _session(self) -> tuple[Any, str, type[np.floating[Any]], bool]:
        """Session, name and numbers of its input, and whether that is (N,) and not (N, 1)."""
        session = onnx_graph.open_session(self.graph)
        inputs = session.get_inputs()
        types = [entry.type for entry in inputs]
        if types not in (["tensor(double)"], ["tensor(float)"]):
            raise ValueError(f"its inputs are {types}, not one tensor of double or float")
        numbers = np.float64 if types[0] == "tensor(double)" else np.float32
        return session, inputs[0].name, numbers, len(inputs[0].shape) == 1

    @cached_property
    def _table(self) -> CurveTable | None:
        return CurveTable.of(self._asked, self.domain)

    @cached_property
    def _chain(self) -> onnx_graph.Chain:
        steps = onnx_graph.read_chain(self.graph, self.name)
        T = np.linspace(*self.domain, 5)
        expected = self._run(T)
        derived = onnx_graph.derive(steps, T)[0]
        if derived.shape != expected.shape or not np.allclose(
            derived, expected, rtol=0, atol=1e-4 * np.abs(expected).max()
        ):
            raise MapError(f"{self.name} is not the chain of its layers, expected one for the slope; export it as one")
        return steps

    @cached_property
    def _integral(self) -> net.Curve:
        return net.antiderivative(self._run, self.domain)

    def _bias(self, T: Array) -> Array:
        return self._run(T) if self.constant is None else np.array(self.constant) + self._integral(T)

    def _slope(self, T: Array) -> Array:
        return onnx_graph.derive(self._chain, T)[1] if self.constant is None else self._run(T)

    def _run(self, T: Array) -> Array:
        if len(T) == 0:
            return np.empty((0, self.record.d))
        if (len(T) == 1 or len(T) >= MANY) and self._table is not None and self._table.covers(T):
            return self._table.at(T)
        return self._asked(T)

    def _asked(self, T: Array) -> Array:
        """Return the output (N, d) of the graph at T (N,), by onnxruntime."""
        N, d = len(T), self.record.d
        try:
            session, name, numbers, flat = self._session
            values = T.astype(numbers)
            result = np.asarray(session.run(None, {name: values if flat else values[:, None]})[0], dtype=np.float64)
        except Exception as error:  # those of onnxruntime have no base of their own
            raise MapError(
                f"{self.name} cannot be run ({onnx_graph.first_line(error)}), "
                f"expected a graph from T (N, 1) to (N, {d}); export it so"
            ) from None
        if result.shape not in {(N, d), (N * d, 1), (N * d,)}:
            raise MapError(
                f"{self.name} gives the shape {result.shape} for {N} temperatures, expected ({N}, {d}); "
                f"export it with one output an axis, or list one residual an axis in its record"
            )
        good = np.abs(result.reshape(N, d)) <= contracts.LARGEST  # neither NaN
        if not np.all(good):
            what = f"that is not a finite number at T = {T[int(np.argmin(np.all(good, axis=1)))]:.6g} °C"
            raise MapError(f"{self.name} gives a bias {what}, expected {self.record.unit}; refit it")
        return result.reshape(N, d)


@hookimpl
class OnnxNetwork(contracts.NetworkMap):
    """Map as a small neural network for each axis."""

    suffix: ClassVar[str] = ".onnx"

    kind: Literal["onnx_network"] = "onnx_network"
    starts: Annotated[int, Field(ge=1, le=1000)] = 8
    """Random starts of the training; the best is kept."""
    seed: Annotated[int, Field(ge=0, lt=1 << 63)] = 0
    """Seed of the starts."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a small one that is soon trained."""
        return (cls(starts=1),)

    @property
    def description(self) -> str:
        """The network and its size."""
        return f"a network of 2 x {self.neurons} neurons an axis"

    @property
    def advice(self) -> str:
        """One neuron more in each layer is one bend more."""
        return f"neurons: {self.neurons + 1} (`fit-map --select` finds how many)"

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> OnnxMap:
        """Train a network an axis on the means of narrow temperature bins."""
        T, bias = contracts.check_samples(self.kind, T, bias)
        what = self.description
        weights = self.neurons**2 + 4 * self.neurons + 1
        contracts.check_swing(self.kind, T, self.min_swing, weights, what, "use fewer neurons")
        bins = bin_samples(T, bias, net.BINS[self.target])
        networks = [
            net.train(bins.T, y, variance, self.neurons, self.starts, self.seed, self.target)
            for y, variance in zip(bins.bias.T, bins.variance.T, strict=True)
        ]
        network = net.side_by_side(networks)
        predict, constant = self._prediction(network, T, bias)
        smoother = _smoother(networks, bins, self.target)
        record = record_fit(self.kind, T, bias, provenance, predict, smoother)
        graph = onnx_graph.export(network, record, constant)
        return OnnxMap(record, graph, f"{self.kind}: the fitted map", constant, outside=self.outside)

    def smoother(self, T: Array, bias: Array) -> Smoother:
        """Return the answer of the network of the file at `path`; without one, that of curves as smooth as the samples.

        A network is not trained for it.
        """
        if self.path is None or not self.path.is_file():
            return super().smoother(T, bias)
        fitted = self.load()
        assert isinstance(fitted, OnnxMap), "read gives one"
        found = [
            onnx_graph.layers(onnx_graph.read_chain(fitted.graph, fitted.name), axis) for axis in range(fitted.record.d)
        ]
        networks = [network for network in found if network is not None]
        if len(networks) != bias.shape[1]:
            return super().smoother(T, bias)
        return _smoother(networks, bin_samples(T, bias, net.BINS[fitted.target]), fitted.target)

    def _prediction(self, network: net.Weights, T: Array, bias: Array) -> tuple[net.Curve, tuple[float, ...] | None]:
        """Return the bias as a function of T, and the bias at T_min where the network gives the slope."""

        def run(T: Array) -> Array:
            return net.forward(network, T)[-1]

        if self.target == "bias":
            return run, None
        integral = net.antiderivative(run, (float(T.min()), float(T.max())))
        slabs = range(0, len(T), contracts.SLAB)
        sums = [np.sum(bias[k : k + contracts.SLAB] - integral(T[k : k + contracts.SLAB]), axis=0) for k in slabs]
        constant = np.sum(sums, axis=0) / len(T)
        return lambda T: constant + integral(T), tuple(constant.tolist())

    def _over(self, fitted: contracts.FittedMap, record: contracts.MapRecord) -> OnnxMap:
        """Return the same network; where it gives the slope, the constant is the bias at the new end."""
        assert isinstance(fitted, OnnxMap), "it was fitted with these settings"
        if fitted.constant is None:
            return replace(fitted, record=record)
        added = net.antiderivative(fitted._run, record.domain)(np.array(fitted.domain[:1]))[0]
        return OnnxMap(
            record,
            fitted.graph,
            fitted.name,
            tuple((np.array(fitted.constant) - added).tolist()),
            outside=fitted.outside,
        )

    def read(self, path: Path) -> OnnxMap:
        """Read the ONNX file, and try it."""
        import onnx

        name, graph = f"{self.kind}: map file {path}", contracts.read_bytes(self.kind, path)
        try:
            model = onnx.load_model_from_string(graph)
        except Exception as error:  # those of protobuf have no base of their own
            raise onnx_graph.damaged(name, error) from None
        found = {entry.key: entry.value for entry in model.metadata_props}
        if len(found) < len(model.metadata_props):
            raise MapError(f"{name} has a key of its metadata_props twice, expected each once; fit it again")
        if KEY not in found:
            raise MapError(
                f"{name} has no '{KEY}' in its metadata_props, expected the record there (kind, domain, "
                f"unit, residual, samples); fit it with `driftlab fit-map`, or add the record to the file"
            )
        content = contracts.parse_map(self.kind, path, found[KEY], onnx_graph.NetworkFile)
        onnx_graph.GraphValues(model, name)  # before a graph of other hands is run
        record = content.record
        fitted = OnnxMap(record, graph, name, content.constant, outside=self.outside)
        for T in (np.array(record.domain), np.linspace(*record.domain, 33)):
            fitted.bias(T)  # a graph that cannot be run, or gives NaN, says so now
        return fitted


def _smoother(networks: list[net.Weights], bins: Bins, target: contracts.Target) -> Smoother:
    domain = (float(bins.T[0]), float(bins.T[-1]))

    def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
        taken = net.answer(networks[axis], (bins.T, 1 / bins.variance[:, axis]), grid, domain, target)
        return np.asarray(taken @ blocks.shares(bins.of_sample, len(bins.T)))

    return smoother
