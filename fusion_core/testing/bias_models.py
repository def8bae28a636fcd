"""The laws of bias models. N steps, n states, d axes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import BiasModel, Memory, Transition
from fusion_core.contracts.output_checks import check_prior, check_transition
from fusion_core.testing.samples import N, check_any_split, check_memory, recording


def states_have_names_and_units(model: BiasModel) -> None:
    """The n labels differ, and there is a unit for each."""
    assert len(set(model.labels)) == len(model.labels), f"labels are not unique: {model.labels}"
    assert len(model.units("rad/s")) == len(model.labels), "there is not one unit for each label"


def the_prior_is_a_mean_and_a_covariance(model: BiasModel) -> None:
    """X (n,), P (n, n) symmetric without a negative eigenvalue; so also at the first sample, and after the last."""
    chunk = _recording(model, regular=True)
    check_prior(model, model.prior())
    check_prior(model, model.prior_at(chunk))
    check_prior(model, model.prior_again(model.transition(chunk, None)[1]))


def steps_have_their_shapes(model: BiasModel) -> None:
    """F, Q, u and C have their shapes and are finite, Q is a covariance; on one sample too."""
    for regular in (True, False):
        chunk = _recording(model, regular=regular)
        for part in (chunk, chunk.part(0, 1), chunk.part(5, 6)):
            check_transition(model, model.transition(part, None)[0], len(part))


def any_split_gives_the_same_steps(model: BiasModel) -> None:
    """Cut anywhere, F, Q, u and C are the same to the last bit."""
    n, d = len(model.labels), len(model.axes)
    shapes = {"F": (n, n), "Q": (n, n), "u": (n,), "C": (d, n)}

    def steps(piece: Chunk, memory: Memory) -> tuple[dict[str, Array], Memory]:
        step, memory = model.transition(piece, memory)
        step = replace(step, C=np.eye(d, n)) if step.C is None else step
        return {k: np.broadcast_to(getattr(step, k), (len(piece), *shape)) for k, shape in shapes.items()}, memory

    for regular in (True, False):
        check_any_split(steps, _recording(model, regular=regular))


def two_steps_are_one_long_step(model: BiasModel) -> None:
    """F(a + b) = F(b) F(a) and Q(a + b) = F(b) Q(a) F(b)' + Q(b), where the channels stand still."""
    chunk = _recording(model, regular=True)

    def over(dt: float) -> Transition:
        channels = {name: values[:1] for name, values in chunk.channels.items()}
        return model.transition(Chunk(chunk.t[:1], {**channels, "dt": np.array([dt])}), None)[0]

    (F_1, Q_1), (F_2, Q_2), (F, Q) = ((step.F.reshape(step.F.shape[-2:]), step.Q.reshape(step.Q.shape[-2:]))
                                      for step in map(over, (0.3, 1.1, 1.4)))  # fmt: skip
    np.testing.assert_allclose(F_2 @ F_1, F, rtol=1e-9, atol=1e-12, err_msg="F over 0.3 s, then 1.1 s")
    scale = float(np.max(np.abs(Q))) or 1.0
    np.testing.assert_allclose(F_2 @ Q_1 @ F_2.T + Q_2, Q, rtol=1e-9, atol=1e-12 * scale, err_msg="Q likewise")


def equal_steps_are_said_to_be_equal(model: BiasModel) -> None:
    """Over equal steps F and Q have no leading N where they are the same for all: the filter is many times faster."""
    step, _ = model.transition(_recording(model, regular=True).part(1, N), None)
    for name, array in (("F", step.F), ("Q", step.Q)):
        same = array.ndim == 3 and len(array) > 1 and np.array_equal(array, np.broadcast_to(array[:1], array.shape))
        assert not same, f"{name} is the same for all steps and has a leading N; leave it out where chunk.dt is 0-d"


def the_memory_that_came_in_is_not_changed(model: BiasModel) -> None:
    """The memory is a value: after the next chunk it is what it was."""
    check_memory("transition", model.transition, _recording(model, regular=False))


def _recording(model: BiasModel, *, regular: bool) -> Chunk:
    return recording(model.requires, regular=regular, columns=model.channel_columns)
