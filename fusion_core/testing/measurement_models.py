"""The laws of measurement models, on made-up epochs at rest. N epochs, n states, m measured components."""

from __future__ import annotations

import pickle

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, MeasurementModel, Memory, Site
from fusion_core.testing.samples import pieces

SITE = Site(latitude=0.7, heading=0.3)
CUTS: tuple[tuple[int, ...], ...] = ((1,), (60,), (7, 8, 9, 100))


def epochs(model: MeasurementModel, site: Site = SITE, N: int = 400) -> Chunk:
    """Return N epochs as the model itself makes them up, at rest; every other channel that is needed stands still."""
    tau = float(model.update_interval)
    needed = {*model.requires, *(name for sensor in model.sensors for name in sensor.bias.requires)}
    channels = {name: np.full(N, 20.0) if name == "temperature" else np.zeros(N) for name in needed}
    columns = {name: d for sensor in model.sensors for name, d in sensor.bias.channel_columns.items()}
    channels |= {name: np.zeros((N, d)) for name, d in columns.items()}
    channels |= model.simulated(N, site, np.random.default_rng(0))
    channels |= {"tau": np.full(N, tau), "dt": np.full(N, tau)}
    for values in channels.values():
        values.setflags(write=False)
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
        chunk = epochs(model, site)
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
    chunk = epochs(model)
    n, m = model.n, model.m
    shapes = {"F": (n, n), "Q": (n, n), "u": (n,), "z": (m,), "H": (m, n), "R": (m, m)}
    for part in (chunk, chunk.part(5, 6)):
        for name, values in _equations(model, part, model.aligned(chunk, SITE), ()).items():
            assert values.shape == (len(part), *shapes[name]), f"{name} has shape {values.shape}"
            assert np.all(np.isfinite(values)), f"{name} is not finite"
            if name in "QR":
                _covariances(name, values[:1], least=0.0 if name == "Q" else None)


def any_split_gives_the_same(model: MeasurementModel) -> None:
    """Cut anywhere, the equations are the same, and so is what the detector says."""
    chunk = epochs(model, N=400).part(200, 320)
    alignment = model.aligned(epochs(model).part(0, 200), SITE)
    whole, seen = _equations(model, chunk, alignment, ()), _looked(model, chunk, alignment, ())
    for cuts in CUTS:
        for name, values in _equations(model, chunk, alignment, cuts).items():
            np.testing.assert_allclose(values, whole[name], rtol=1e-12, atol=1e-300, err_msg=f"{name}, cut at {cuts}")
        np.testing.assert_array_equal(_looked(model, chunk, alignment, cuts), seen, err_msg=f"detector, cut at {cuts}")


def memory_of_the_detector_is_not_changed(model: MeasurementModel) -> None:
    """The memory is a value: after the next chunk it is what it was."""
    chunk = epochs(model)
    detector = model.detector(model.aligned(chunk, SITE))
    *_, memory = detector.look(chunk.part(0, 50), detector.start())
    before = pickle.dumps(memory)
    detector.look(chunk.part(50, 100), memory)
    assert pickle.dumps(memory) == before, "look changes the memory that it is given; return a new one"


def _equations(model: MeasurementModel, chunk: Chunk, alignment: Alignment, cuts: tuple[int, ...]) -> dict[str, Array]:
    """Return F, Q, u, z, H and R of every epoch, from the recording cut into pieces."""
    memories: list[Memory] = [None] * len(model.sensors)
    parts: dict[str, list[Array]] = {name: [] for name in ("F", "Q", "u", "z", "H", "R")}
    for piece in pieces(chunk, cuts):
        found = [s.bias.transition(piece, memory) for s, memory in zip(model.sensors, memories, strict=True)]
        memories = [memory for _, memory in found]
        step, measured = model.equations(piece, [step for step, _ in found], alignment)
        values = {"F": step.F, "Q": step.Q, "H": measured.H, "R": measured.R}
        for name, value in {**values, "u": step.u, "z": measured.z}.items():
            whole = (
                value if value.ndim > (1 if name in "uz" else 2) else np.broadcast_to(value, (len(piece), *value.shape))
            )
            parts[name].append(whole)
    return {name: np.concatenate(values) for name, values in parts.items()}


def _looked(model: MeasurementModel, chunk: Chunk, alignment: Alignment, cuts: tuple[int, ...]) -> Array:
    detector = model.detector(alignment)
    memory, parts = detector.start(), []
    for piece in pieces(chunk, cuts):
        still, standing_out, memory = detector.look(piece, memory)
        parts.append(np.column_stack([still, standing_out]))
    return np.concatenate(parts)


def _covariances(name: str, matrices: Array, least: float | None) -> None:
    scale = float(np.max(np.abs(matrices)))
    np.testing.assert_allclose(
        matrices, np.swapaxes(matrices, -1, -2), atol=1e-12 * scale, err_msg=f"{name}: symmetric"
    )
    smallest = float(np.min(np.linalg.eigvalsh(matrices)))
    assert smallest > 0 if least is None else smallest >= -1e-12 * scale, f"{name} has the eigenvalue {smallest:g}"


LAWS = {
    "states and components have names": states_and_components_have_names,
    "rest is taken for rest": rest_is_taken_for_rest,
    "equations have their shapes": equations_have_their_shapes,
    "any split gives the same": any_split_gives_the_same,
    "the memory of the detector is not changed": memory_of_the_detector_is_not_changed,
}
