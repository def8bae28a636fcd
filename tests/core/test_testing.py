"""The laws themselves: a plugin that breaks one is told which, and why."""

from collections.abc import Iterator
from dataclasses import replace
from typing import ClassVar, Literal, Self

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import (
    BiasModel,
    Effect,
    Frames,
    Framing,
    KnownRates,
    MeasurementModel,
    Prior,
    Source,
    Stimulus,
    ThermalMap,
    Transition,
    on_each_axis,
)
from fusion_core.host.registry import registry
from fusion_core.testing import check_plugin, laws

POLYNOMIAL = registry().classes(ThermalMap)["polynomial"]


class Good(BiasModel):
    """A constant; each of the others breaks one law."""

    kind: Literal["good"] = "good"

    def prior(self):
        return Prior(np.zeros(3), np.eye(3))

    def transition(self, chunk, memory):
        return Transition(np.eye(3), np.zeros((3, 3)), np.zeros(3)), memory


class Splits(Good):
    """Depends on where the chunk begins."""

    def transition(self, chunk, memory):
        step, _ = super().transition(chunk, memory)
        return Transition(step.F, step.Q, np.arange(3.0 * len(chunk)).reshape(-1, 3)), None


class Negative(Good):
    """Has a negative variance."""

    def transition(self, chunk, memory):
        return Transition(np.eye(3), -np.eye(3), np.zeros(3)), memory


class LongerThanTwo(Good):
    """Does not scale with the step."""

    def transition(self, chunk, memory):
        return Transition(np.eye(3), np.eye(3), np.zeros(3)), memory


class Overwrites(Good):
    """Changes its samples."""

    @property
    def requires(self):
        return ("temperature",)

    def transition(self, chunk, memory):
        chunk["temperature"][:] = 0
        return super().transition(chunk, memory)


class ReadsMore(Good):
    """Reads what it does not name."""

    def transition(self, chunk, memory):
        return super().transition(chunk, chunk["voltage"])


class ChangesMemory(Good):
    """Writes into its memory."""

    def transition(self, chunk, memory):
        memory = [0] if memory is None else memory
        memory[0] += len(chunk)
        return super().transition(chunk, memory)


class Repeats(Good):
    """Gives the same F for every step."""

    def transition(self, chunk, memory):
        F = np.broadcast_to(np.eye(3), (len(chunk), 3, 3))
        return Transition(F, np.zeros((3, 3)), np.zeros(3)), memory


def broken(plugin, **more):
    return {law.name: text for law in laws(type(plugin), [plugin], **more) if (text := law.broken()) is not None}


def test_a_plugin_that_keeps_the_laws():
    check_plugin(Good)
    assert str(laws(Good)[0]) == "good: settings can be written and read again"


@pytest.mark.parametrize(
    ("cls", "law", "text"),
    [
        (Splits, "any split gives the same steps", "u, cut at"),
        (Negative, "steps have their shapes", "is not a covariance"),
        (LongerThanTwo, "two steps are one long step", "Q likewise"),
        (Overwrites, "steps have their shapes", "read-only"),
        (ReadsMore, "steps have their shapes", "channel 'voltage' is needed"),
        (ChangesMemory, "the memory that came in is not changed", "return a new one"),
        (Repeats, "equal steps are said to be equal", "F is the same for all steps"),
    ],
)
def test_a_bias_model_that_breaks_one(cls, law, text):
    assert text in broken(cls())[law]
    with pytest.raises(AssertionError, match=f"good: {law}: "):
        check_plugin(cls)


def test_a_class_that_needs_arguments_has_no_examples():
    needs = registry().classes(BiasModel)["thermal_derivative"]
    assert list(Source.examples.__func__(registry().classes(Source)["csv"])) == []
    with pytest.raises(AssertionError, match="Csv: has no example; give some"):
        check_plugin(registry().classes(Source)["csv"])
    check_plugin(needs)


class Fan(Effect):
    """Grows with the number of the sample."""

    explanation: ClassVar = "what grows with the number of the sample is no physics"
    requires: ClassVar = ()
    kind: Literal["fan"] = "fan"

    def candidates(self) -> Iterator[Self]:
        yield from ()

    def signature(self, chunk, memory):
        return on_each_axis(np.arange(float(len(chunk))), 3), memory


def test_an_effect_that_breaks_some():
    found = broken(Fan())
    assert "(120, 1, 1) was expected" in found["shapes fit together"]
    assert "signature, cut at (1,)" in found["any split gives the same"]
    assert found["the search can begin and go on"] == "candidates() yields nothing"
    assert "it holds beyond its domain" in found  # nor is it the same wherever it is cut
    assert len(found) == 4


class Torn(Framing):
    """Three numbers a line; it takes a torn line for one, and keeps all that it cannot use."""

    kind: Literal["torn"] = "torn"

    def decode(self, data, memory):
        *lines, rest = ((memory or b"") + data).split(b"\n")
        rows = [[float(cell) for cell in line.split(b",")] for line in lines if line.count(b",") == 2]
        return Frames(len(rows), {"gyro": np.array(rows).reshape(-1, 3)}), rest


def test_a_framing_that_breaks_all():
    found = broken(Torn(), stream=b"".join(b"%d,%d,%d\n" % (k + 100, k + 200, k + 300) for k in range(30)))
    assert "a sample of a torn frame" in found["a stream may begin anywhere"]
    assert "could not convert string to float" in found["what is no frame is passed over"]


class Hoards(Torn):
    """Reads on until a line ends, however long it is."""

    def decode(self, data, memory):
        *lines, rest = ((memory or b"") + data).split(b"\n")
        return Frames(0, {"gyro": np.zeros((0, 3))}, None, {"lines": len(lines)}), rest


def test_a_framing_whose_memory_grows():
    assert set(found := broken(Hoards())) == {"the memory stays small"}
    assert "the memory has 1000" in found["the memory stays small"]


class Wrong(POLYNOMIAL):
    """A polynomial whose slope is that of another."""

    def fit(self, T, bias, provenance):
        fitted = super().fit(T, bias, provenance)
        object.__setattr__(fitted, "_slope", lambda T: np.zeros((len(T), fitted.record.d)))
        return fitted


def test_a_map_with_a_wrong_slope():
    assert "slope" in broken(Wrong())["the slope is the derivative"]


class Uneven(Source):
    """Gives the first row of every chunk twice."""

    kind: Literal["uneven"] = "uneven"

    def chunks(self, size, faults):
        for start in range(0, 30, size):
            t = np.arange(float(start), min(start + size, 30))
            yield Chunk(np.concatenate([t[:1], t[:-1]]), {"gyro": np.zeros((len(t), 3))})


def test_a_source_that_depends_on_the_size():
    assert set(broken(Uneven())) == {"any size gives the same rows"}


HELD = registry().classes(MeasurementModel)["held"]


class Drifts(HELD):
    """Measures something else at the end of a chunk, and what it simulates is never at rest."""

    def equations(self, chunk, steps, alignment):
        step, measured = super().equations(chunk, steps, alignment)
        return step, replace(measured, z=measured.z + np.arange(len(chunk))[:, None])

    def still(self, window):
        return False


def test_a_measurement_model_that_breaks_two():
    found = broken(next(iter(Drifts.examples())))
    assert "z, cut at (1,)" in found["any split gives the same"]
    assert "is taken for motion" in found["rest is taken for rest"]
    assert len(found) == 2


class Reversed(KnownRates):
    """Has the derivatives the wrong way round, a bias that is not its own, and no remedy."""

    def equations(self, values):
        e = super().equations(values)
        return replace(e, J=-e.J, left=e.left + 0.1)

    def lacking(self, term):
        return "nothing turns"


class Backwards(registry().classes(Stimulus)["rate_table"]):
    """Makes of its recordings equations that do not hold."""

    def inputs(self, recordings, channel, site, length):
        own = super().inputs(recordings, channel, site, length)
        return Reversed(own.u, own.y, own.temperatures, own.times, own.force)


def test_a_stimulus_that_breaks_three():
    found = broken(next(iter(Backwards.examples())))
    assert set(found) == {
        "equations hold for the terms of the unit", "derivatives are those of differences",
        "what is lacking has a remedy",
    }  # fmt: skip
    assert "of term 0" in found["derivatives are those of differences"]


class Field(Effect):
    """A gyro that follows the three components of a magnetic field."""

    explanation: ClassVar = "A coil of the gyro answers to the magnetic field about it."

    kind: Literal["field"] = "field"
    requires = property(lambda self: ("field",))
    channel_columns = property(lambda self: {"field": 3})

    def candidates(self):
        yield self

    def signature(self, chunk, memory):
        return on_each_axis(chunk["field"][:, :3].sum(axis=1), len(self.axes)), memory


def test_a_channel_may_have_several_columns():
    check_plugin(Field)
