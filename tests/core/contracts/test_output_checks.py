"""A wrong answer of a plugin is named, and never becomes an estimate."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.filtering.tracker import check_finite
from fusion_core.chunk import Chunk
from fusion_core.contracts import (
    Alignment,
    BiasModel,
    Detector,
    Frames,
    Measurement,
    MeasurementModel,
    Patience,
    Prior,
    Sensor,
    Site,
    Transition,
)
from fusion_core.contracts.families import FAMILIES
from fusion_core.contracts.output_checks import check_prior, check_transition
from fusion_core.contracts.plugin import Origin
from fusion_core.errors import BadValue, PluginError, seconds
from fusion_core.faults import Faults
from fusion_core.host.guard import guard

N = 4
I = np.eye(2)  # noqa: E741
WRONG = {
    "NaN in F": ("F", np.array([[1, np.nan], [0, 1]]), "F is not finite"),
    "shape of F": ("F", np.eye(3), r"F has shape \(3, 3\), its 2 labels ask for \(2, 2\) or \(4, 2, 2\)"),
    "N of Q": ("Q", np.zeros((5, 2, 2)), r"Q has shape \(5, 2, 2\)"),
    "NaN in Q": ("Q", np.diag([1, np.nan]), "Q is not finite"),
    "negative Q": ("Q", np.diag([1.0, -1.0]), "Q is not a covariance"),
    "one negative Q of many": ("Q", np.stack([I, I, -I, I]), "Q is not a covariance"),
    "indefinite Q": ("Q", np.array([[1.0, 2.0], [2.0, 1.0]]), "Q is not a covariance"),
    "lopsided Q": ("Q", np.array([[1.0, 0.5], [0.0, 1.0]]), "Q is not a covariance"),
    "infinite u": ("u", np.array([0.0, np.inf]), "the drift u is not finite"),
    "shape of u": ("u", np.zeros(3), r"the drift u has shape \(3,\)"),
    "NaN in C": ("C", np.full((2, 2), np.nan), "C is not finite"),
    "shape of C": ("C", np.eye(3), r"C has shape \(3, 3\), its 2 labels ask for \(2, 2\) or \(4, 2, 2\)"),
}


class Model(BiasModel):
    """Two axes."""

    kind: str = "theirs"
    axes: tuple[str, ...] = ("x", "y")

    def prior(self):
        raise NotImplementedError

    def transition(self, chunk, memory):
        raise NotImplementedError


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_step_is_named(name):
    field, array, message = WRONG[name]
    good = {"F": I, "Q": 0 * I, "u": np.zeros(2), "C": None}
    check_transition(Model(), Transition(**good), N)
    with pytest.raises(PluginError, match=f"^theirs: {message}.*; this is a defect of the plugin"):
        check_transition(Model(), Transition(**(good | {field: array})), N)


@pytest.mark.parametrize(
    ("x", "P", "message"),
    [
        (np.zeros(3), I, r"prior x has shape \(3,\)"),
        (np.zeros(2), np.eye(3), r"prior P has shape \(3, 3\)"),
        (np.array([0, np.nan]), I, "prior x is not finite"),
        (np.zeros(2), np.diag([1, np.inf]), "prior P is not finite"),
        (np.zeros(2), np.array([[1.0, 2.0], [2.0, 1.0]]), "prior P is not a covariance"),
        (np.zeros(2), -I, "prior P is not a covariance"),
    ],
)
def test_a_wrong_prior_is_named(x, P, message):
    check_prior(Model(), Prior(np.zeros(2), I))
    check_prior(Model(), Prior(np.zeros(2), np.array([[1.0, 1.0], [1.0, 1.0]])))  # singular is a covariance
    with pytest.raises(PluginError, match=f"^theirs: {message}"):
        check_prior(Model(), Prior(x, P))


def test_every_state_has_a_unit():
    class Forgetful(Model):
        """One unit for two states."""

        def units(self, bias):
            return (bias,)

    assert Model().units("rad/s") == ("rad/s", "rad/s")
    with pytest.raises(PluginError, match=r"^theirs: has 1 units for 2 labels"):
        check_prior(Forgetful(), Prior(np.zeros(2), I))


def test_an_estimate_that_is_no_number_is_named():
    t = np.arange(3.0)
    good = SimpleNamespace(x=np.zeros((3, 2)), sigma=np.ones((3, 2)))
    check_finite(good, t, seconds)
    lost = SimpleNamespace(x=np.zeros((3, 2)), sigma=np.array([[1, 1], [1, np.nan], [1, 1]]))
    with pytest.raises(BadValue, match=r"the estimate is not a finite number at 1\.0 s; check noise, walk and sigma_0"):
        check_finite(lost, t, seconds)


# every family, by one body: a class of a third party that is right but for one answer

CHUNK = Chunk(np.arange(float(N)), {"r": np.zeros((N, 2)), "tau": np.ones(N), "dt": np.ones(N)})
AT_REST = Alignment(0.0, 1.0, {"r": np.zeros(2)}, {"r": np.ones(2)}, np.zeros(2))
GOOD = {"F": I, "Q": I, "u": np.zeros(2), "z": np.zeros((N, 2)), "H": I, "R": I, "used": np.ones(N, dtype=bool)}


class Walk(Model):
    def prior(self):
        return Prior(np.zeros(2), I)

    def transition(self, chunk, memory):
        return Transition(I, I, np.zeros(2)), memory


SENSOR = Sensor("r", "filter", "1", "1", np.ones(2), None, Walk())


class Rig(MeasurementModel):
    """One sensor of two axes."""

    kind: str = "theirs"
    sensors = property(lambda self: (SENSOR,))
    patience = property(lambda self: Patience(1e-7, 60.0))

    def with_tracked(self, **fields):
        return self

    def equations(self, chunk, steps, alignment):
        raise NotImplementedError

    def still(self, window):
        return True

    def aligned(self, window, site):
        return AT_REST


def equations(**wrong):
    """Return the answer of `equations` with some arrays in place of good ones."""
    all_ = GOOD | wrong
    return Transition(*(all_[k] for k in "FQu")), Measurement(*(all_[k] for k in ("z", "H", "R", "used")))


def nan(*shape):
    return np.full(shape, np.nan)


EQUATIONS = (CHUNK, (), AT_REST)
WRONG_ANSWERS = [  # family, member, its wrong answer, its arguments, what is said of it
    ("bias_models", "prior", None, (), "prior is a NoneType, a State was expected"),
    ("bias_models", "transition", (Transition(np.eye(3), np.eye(3), np.zeros(3)), None), (CHUNK, None), "F has shape"),
    ("bias_models", "labels", ("x", "x"), (), "its labels x, x are not all different"),
    ("bias_models", "requires", None, (), "has a NoneType where a tuple of texts"),
    ("stimuli", "inputs", None, ([CHUNK], "gyro", None, None), "inputs is a NoneType, a TriadInput was expected"),
    ("measurement_models", "equations", None, EQUATIONS, "equations answers a NoneType, a pair of the steps and"),
    ("measurement_models", "equations", (None, None), EQUATIONS, "transition is a NoneType, a Transition was expected"),
    ("measurement_models", "equations", equations(H=np.zeros((4, 7))), EQUATIONS,
     r"H has shape \(4, 7\), its 2 states, 2 components and 4 epochs ask for \(2, 2\) or \(4, 2, 2\)"),
    ("measurement_models", "equations", equations(H=nan(2, 2)), EQUATIONS, "H is not finite"),
    ("measurement_models", "equations", equations(R=nan(2, 2)), EQUATIONS, "R is not finite"),
    ("measurement_models", "equations", equations(R=-I), EQUATIONS, "R is not a covariance"),
    ("measurement_models", "equations", equations(R=0 * I), EQUATIONS, "R has a variance of zero"),
    ("measurement_models", "equations", equations(z=np.zeros((N - 1, 2))), EQUATIONS, r"z has shape \(3, 2\)"),
    ("measurement_models", "equations", equations(z=nan(N, 2)), EQUATIONS, "z is not finite"),
    ("measurement_models", "equations", equations(z=np.ma.masked_all((N, 2))), EQUATIONS, "z is a MaskedArray"),
    ("measurement_models", "equations", equations(used=np.ones(N)), EQUATIONS,
     "used is an array of float64, an array of true or false"),
    ("measurement_models", "equations", equations(Q=np.stack([I, I, I, -I])), EQUATIONS, "Q is not a covariance"),
    ("measurement_models", "equations", equations(F=np.eye(3)), EQUATIONS, r"F has shape \(3, 3\), its 2 states ask"),
    ("measurement_models", "prior", None, ([Prior(np.zeros(2), I)],), "prior is a NoneType, a State was expected"),
    ("measurement_models", "prior", Prior(np.zeros(3), I), ((),), r"prior x has shape \(3,\), its 2 states ask for"),
    ("measurement_models", "sensors", (), (), "sensors is empty, at least 1 was expected"),
    ("measurement_models", "sensors", (SENSOR, SENSOR), (), "two of its sensors are of one channel"),
    ("measurement_models", "sensors", (replace(SENSOR, noise=np.ones(3)),), (), "the noise of its sensor r has shape"),
    ("measurement_models", "sensors", (replace(SENSOR, bias=None, noise=1),), (), "the bias of its sensor r is a None"),
    ("measurement_models", "tracked", None, (), "tracked is a NoneType, a Sensor was expected"),
    ("measurement_models", "patience", (1, 2), (), "patience is a tuple, a Patience was expected"),
    ("measurement_models", "own", ("velocity",), (), "one of own is a str, a Block was expected"),
    ("measurement_models", "components", [("r", "x")], (), "a component is .*, channel, axis and unit were expected"),
    ("measurement_models", "known", np.zeros(3), (CHUNK, AT_REST), r"known has shape \(3,\)"),
    ("measurement_models", "known", nan(2), (CHUNK, AT_REST), "known is not finite"),
    ("measurement_models", "white", -I, (CHUNK,), "white is not a covariance"),
    ("measurement_models", "still", None, (CHUNK,), "still answers a NoneType, true or false was expected"),
    ("measurement_models", "aligned", None, (CHUNK, Site()), "aligned is a NoneType, an? Alignment was expected"),
    ("measurement_models", "aligned", replace(AT_REST, inputs={}), (CHUNK, Site()), "the alignment has no input of r"),
    ("measurement_models", "aligned", replace(AT_REST, inputs={"r": nan(2)}), (CHUNK, Site()), "inputs of r .* finite"),
    ("measurement_models", "aligned", replace(AT_REST, unsure=np.zeros(3)), (CHUNK, Site()), "unsure in the alignment"),
    ("measurement_models", "detector", 1, (AT_REST,), "detector is a int, a Detector was expected"),
    ("measurement_models", "simulated", {}, (N, Site(), None), "the simulated channel 'r' is a NoneType"),
    ("measurement_models", "length_of_input", (9.8,), (Site(),), r"length_of_input is \(9.8,\), a length and its dev"),
    ("measurement_models", "with_tracked", None, (), "with_tracked is a NoneType, a Theirs was expected"),
    ("measurement_models", "requires", ("a", 1), (), "has a tuple where a tuple of texts"),
    ("thermal_maps", "fit", None, (np.zeros(N), np.zeros((N, 2)), {}), "the fitted map is a NoneType"),
    ("thermal_maps", "read", 1, ("a",), "the fitted map is a int, a FittedMap was expected"),
    ("thermal_maps", "basis", None, ((0.0, 1.0),), "basis is a NoneType, a Basis was expected"),
    ("thermal_maps", "smoother", 1, (np.zeros(N), np.zeros((N, 2))), "its smoother is a int, a function"),
    ("thermal_maps", "variants", (), (), "variants is empty, at least 1 was expected"),
    ("thermal_maps", "description", None, (), "has a NoneType where a text was expected"),
    ("sources", "chunks", iter([1]), (9, Faults()), "what it yields is a int, a Chunk was expected"),
    ("sources", "chunks", iter([Chunk(np.zeros(2), {"a": np.ma.masked_all(2)})]), (9, Faults()),
     "channel 'a' is a MaskedArray"),
    ("sources", "name", None, (), "has a NoneType where a text was expected"),
    ("sources", "about", None, ("gyro",), "about is a NoneType, a Mapping was expected"),
    ("framings", "decode", None, (b"", None), "decode answers a NoneType, a pair of what was asked and the memory"),
    ("framings", "decode", (Frames(3, {"r": np.zeros(2)}), None), (b"", None), "channel 'r' has shape"),
    ("framings", "device_counter", 7, (), "device_counter is a int, a Counter was expected"),
    ("effects", "signature", (np.zeros((N, 3)), None), (CHUNK, None), "signature has shape"),
    ("effects", "signature", (nan(N, 3, 3), None), (CHUNK, None), "signature is not finite"),
    ("effects", "input", (np.zeros(2), None), (CHUNK, None), "the map's input has shape"),
    ("effects", "fading", (nan(N), None), (CHUNK, None), "fading is not finite"),
    ("effects", "candidates", iter([1]), (), "what it proposes is a int"),
    ("effects", "explanation", None, (), "has a NoneType where a text was expected"),
    ("exporters", "export", None, (None, None), "what it says is lost is a NoneType, a Loss was expected"),
    ("exporters", "read", [1], ("a",), "one of what it reads back is a int, a ReadBack was expected"),
    ("report_sections", "section", "text", ({}, {}), "section is a str, a Section was expected"),
]  # fmt: skip


def theirs(family, **members):
    """Return a plugin of a family that a third party installed; what it must define and does not answers nothing."""
    base = {"bias_models": Walk, "measurement_models": Rig}.get(family.name, family.contract)
    missing = {name: property(lambda self: ()) for name in base.__abstractmethods__}
    own = {"__annotations__": {"kind": str}, "kind": "theirs", "__module__": "acme"}
    cls = type("Theirs", (base,), missing | own | members)
    guard(cls, family, Origin(family.name, "acme", "1.0"))
    return cls()


@pytest.mark.parametrize(
    ("family", "name", "answer", "arguments", "message"),
    WRONG_ANSWERS,
    ids=[f"{family}.{name}: {message[:30]}" for family, name, _, _, message in WRONG_ANSWERS],
)
def test_a_wrong_answer_names_the_plugin_of_every_family(family, name, answer, arguments, message):
    (family,) = (known for known in FAMILIES if known.name == family)
    is_method = callable(getattr(family.contract, name))
    member = (lambda self, *given, **named: answer) if is_method else property(lambda self: answer)
    plugin = theirs(family, **{name: member})

    def ask():
        found = getattr(plugin, name)
        return list(found(*arguments) if is_method else found)  # of what comes one by one

    with pytest.raises(PluginError, match=rf"^theirs \(acme 1\.0\): {message}") as caught:
        ask()
    assert (caught.value.plugin, caught.value.family) == ("theirs", family.name)


def test_each_family_has_a_wrong_answer_above():
    assert {family for family, *_ in WRONG_ANSWERS} == {family.name for family in FAMILIES}


def measuring(answer):
    (family,) = (known for known in FAMILIES if known.contract is MeasurementModel)
    return theirs(family, equations=lambda self, chunk, steps, alignment: answer)


def test_what_is_not_used_may_be_anything():
    z, used = nan(N, 2), np.zeros((N, 2), dtype=bool)
    z[1:, 0], used[1:, 0] = 1.0, True
    H = np.where(used[:, :, None], I, np.nan)
    answer = equations(z=z, used=used, H=H)
    assert measuring(answer).equations(*EQUATIONS) == answer


def test_states_that_are_not_the_bias_need_a_C_and_the_bias_model_is_named():
    class Six(Walk):
        labels = property(lambda self: ("a", "b", "c"))

        def transition(self, chunk, memory):
            return Transition(np.eye(3), np.eye(3), np.zeros(3)), memory

    (family,) = (known for known in FAMILIES if known.contract is BiasModel)
    guard(Six, family, Origin("bias_models", "acme", "1.0"))
    with pytest.raises(PluginError, match=r"^theirs \(acme 1\.0\): has 3 labels for 2 axes and no C"):
        Six().transition(CHUNK, None)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, "look answers a NoneType, three were expected"),
        ((np.ones(N), np.zeros((N, 1), dtype=bool), None), "still of its detector is an array of float64"),
        ((np.ones(N, dtype=bool), np.zeros((N, 2), dtype=bool), None), r"what stands out .* has shape \(4, 2\)"),
        (1 / 3, "look: ZeroDivisionError"),
    ],
)
def test_a_detector_is_of_the_model_that_made_it(answer, message):
    class Alarm(Detector):
        axes = (("r", "x"),)

        def start(self):
            return None

        def look(self, chunk, memory):
            return 1 / 0 if answer == 1 / 3 else answer

    (family,) = (known for known in FAMILIES if known.contract is MeasurementModel)
    model = theirs(family, detector=lambda self, alignment: Alarm())
    with pytest.raises(PluginError, match=rf"^theirs \(acme 1\.0\): {message}"):
        model.detector(AT_REST).look(CHUNK, None)
