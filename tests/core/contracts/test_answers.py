"""What a bias model answers wrongly is named, and never becomes an estimate."""

from types import SimpleNamespace

import numpy as np
import pytest

from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.contracts.answers import check_prior, check_transition
from fusion_core.errors import BadValue, PluginError
from fusion_core.host.answers import check_finite
from fusion_core.moments import seconds

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
    "shape of u": ("u", np.zeros(3), r"u has shape \(3,\)"),
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
