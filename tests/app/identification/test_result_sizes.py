"""Sizes of effects in words: by the unit of their cause, and by what they do to the bias."""

from types import SimpleNamespace

import numpy as np

from driftlab.identification.result import log_likelihood, size
from driftlab.units import BiasUnit
from fusion_plugins.effects.curve import Curve
from fusion_plugins.effects.hysteresis import Hysteresis

DEG_H = np.pi / 180 / 3600
EVIDENCE = SimpleNamespace(axes=("x", "y"), unit=BiasUnit("rad/s", "deg/h"))


def sized(effect):
    fit = SimpleNamespace(
        effects=[effect], sizes=np.array([[12.1, 7.4]]) * DEG_H, sizes_sigma=np.array([[0.2, 0.3]]) * DEG_H
    )
    return size(fit, SimpleNamespace(place=0), EVIDENCE)


def test_a_coefficient_has_its_sigma_and_its_unit():
    values = {"coefficients": (3.06 * DEG_H, -1.9 * DEG_H), "sigma": (0.04 * DEG_H, 0.11 * DEG_H)}
    effect = Hysteresis(kind="hysteresis", width="7.9 K", axes=("x", "y"), **values)
    assert sized(effect) == "x 3.060 ± 0.040, y -1.90 ± 0.11 deg/h/K, moves the bias by x ±12.1, y ±7.4 deg/h"


def test_of_several_terms_an_axis_the_whole_is_the_size():
    effect = Curve(kind="curve", powers=2, axes=("x", "y"), coefficients=(1e-6,) * 4, sigma=(1e-7,) * 4)
    assert sized(effect) == "moves the bias by x ±12.1 (sigma 0.2), y ±7.4 (sigma 0.3) deg/h"


def test_evidence_is_a_log_likelihood_up_to_what_numbers_can_tell():
    assert log_likelihood(448.2) == "log-likelihood 448"
    assert log_likelihood(np.inf) == "log-likelihood over 700"
