"""The laws of measurement models, on made-up epochs at rest. N epochs, n states, m measured components."""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, MeasurementModel, Memory, Site
from fusion_core.contracts.output_checks import expect_array, expect_covariance
from fusion_core.testing.samples import CUTS, Method, check_any_split, check_memory, joined

SITE = Site(latitude=0.7, heading=0.3)


def _epochs(model: MeasurementModel, site: Site = SITE, N: int = 400) -> Chunk:
    """Return N epochs as the model itself makes them up, at rest; every other channel that is needed stands still."""
    tau = float(model.update_interval)
    needed = {*model.requires, *(name for sensor in model.sensors for name in sensor.bias.requires)}
    channels = {name: np.full(N, 20.0) if name == "temperature" else np.zeros(N) for name in needed}
    columns = {name: d for sensor in model.sensors for name, d in sensor.bias.channel_columns.items()}
    channels |= {name: np.zeros((N, d)) for name, d in columns.items()}
    channels |= model.simulated(N, site, np.random.default_rng(0))
    channels |= {"tau": np.full(N, tau), "dt": np.full(N, tau)}
    return Chunk(tau * np.arange(1.0, N + 1), channels, sensors=frozenset(s.channel for s in model.sensors))


def states_and_components_have_names(model: MeasurementModel) -> None:
    """Labels differ and have a unit each; there are sensors, and the tracked one is among them."""
    assert model.sensors, "it has no sensor"
    assert model.tracked in model.sensors, "the tracked sensor is none of its sensors"
    assert len(set(model.labels)) == len(model.labels) == len(model.units) == model.n, "labels differ, with a unit each"
    assert len(set(model.components)) == model.m > 0, "components differ, and there is at least one"
    assert model.restarting.shape == (model.n,), f"restarting has shape {model.restarting.shape}, ({model.n},) expected"


def rest_is_taken_for_rest(model: MeasurementModel) -> None:
    """Epochs that the model makes up at rest are at rest, can be aligned on, and set off no alarm."""
    for site in (SITE, Site()):
        chunk = _epochs(model, site)
        assert model.still(chunk), f"what it simulates at rest at {site} is taken for motion"
        model.check(chunk, site)
        alignment = model.aligned(chunk, site)
        assert set(alignment.inputs) >= {sensor.channel for sensor in model.sensors}, (
            "alignment has no input of a sensor"
        )
        known = model.known(chunk, alignment)
        assert np.all(np.isfinite(known)), "known is not finite"


def equations_have_their_shapes(model: MeasurementModel) -> None:
    """F, Q, u, z, H and R have their shapes and are finite; Q has no eigenvalue below zero, R none at zero either."""
    chunk = _epochs(model)
    n, m = model.n, model.m
    shapes = {"F": (n, n), "Q": (n, n), "u": (n,), "z": (m,), "H": (m, n), "R": (m, m)}
    for part in (chunk, chunk.part(5, 6)):
        equations = joined(_equations(model, model.aligned(chunk, SITE)), part, ())
        for name, values in equations.items():
            expect_array(model, name, values, ((len(part), *shapes[name]),))
            if name in "QR":
                expect_covariance(model, name, values[:1])
        assert np.min(np.linalg.eigvalsh(equations["R"][:1])) > 0, "R has an eigenvalue of zero"


def any_split_gives_the_same(model: MeasurementModel) -> None:
    """Cut anywhere, the equations are the same, and so is what the detector says."""
    chunk = _epochs(model).part(200, 320)
    alignment = model.aligned(_epochs(model).part(0, 200), SITE)
    for method in (_equations(model, alignment), _detections(model, alignment)):
        check_any_split(method, chunk, CUTS[1:4])


def the_memory_of_the_detector_is_not_changed(model: MeasurementModel) -> None:
    """The memory is a value: after the next chunk it is what it was."""
    chunk = _epochs(model)
    detector = model.detector(model.aligned(chunk, SITE))

    check_memory("look", detector.look, chunk.part(0, 100), detector.start())


def _equations(model: MeasurementModel, alignment: Alignment) -> Method:
    """Return the method that gives F, Q, u, z, H and R of every epoch."""

    def equations(piece: Chunk, memory: Memory) -> tuple[dict[str, Array], Memory]:
        memories = [None] * len(model.sensors) if memory is None else memory
        steps = [s.bias.transition(piece, memory) for s, memory in zip(model.sensors, memories, strict=True)]
        step, measured = model.equations(piece, [one for one, _ in steps], alignment)
        arrays = {"F": (step.F, 2), "Q": (step.Q, 2), "u": (step.u, 1), "z": (measured.z, 1), "H": (measured.H, 2)}
        arrays["R"] = measured.R, 2
        each = {
            name: a if a.ndim > ndim else np.broadcast_to(a, (len(piece), *a.shape))
            for name, (a, ndim) in arrays.items()
        }
        return each, [memory for _, memory in steps]

    return equations


def _detections(model: MeasurementModel, alignment: Alignment) -> Method:
    """Return the method that gives what the detector shows of every epoch."""
    detector = model.detector(alignment)

    def detections(piece: Chunk, memory: Memory) -> tuple[dict[str, Array], Memory]:
        still, standing_out, memory = detector.look(piece, detector.start() if memory is None else memory)
        return {"detector": np.column_stack([still, standing_out]).astype(np.float64)}, memory

    return detections
