"""Parts left out by the range of an input: what holds in one part of it alone is seen, what is real passes."""

import numpy as np
import pytest
from rows_at_rest import C_VOLTAGE, PLAY, SLIP, VOLTAGE, evidence, known, search_of, signature

from driftlab.identification.acceptance import CandidateEvidence
from driftlab.identification.least_squares import Term
from driftlab.identification.search import does_not_carry_over, inputs
from driftlab.identification.state import Trial
from fusion_plugins.effects.curve import Curve
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.interaction import Interaction


def judged(rows, *effects):
    """Return what is said of the last effect beside the others."""
    model = tuple(map(Term, effects))
    evidence = CandidateEvidence(0.1, -9.0, 6, 0.5, len(model) > 1, 99.0, 99.0, 99.0, 3.0)
    return does_not_carry_over(search_of(rows, model), Trial(model, evidence, np.ones((3, 6)), 9.0, True, ""))


def one_sided(k, chunk):
    """A supply that acts the other way in the highest part of its range: a line fits the most of it."""
    u = chunk["voltage"] - 5
    return np.where(u > 1.2, 1.2 - 4 * (u - 1.2), u)[:, None] * np.array([1e-5, 2e-5, -1e-5])


def test_an_effect_that_is_real_carries_over():
    rows = evidence(known)
    assert judged(rows, PLAY, VOLTAGE) == ""
    assert judged(rows, VOLTAGE, PLAY) == ""


def test_an_effect_that_holds_in_a_part_of_the_range_alone_does_not():
    assert judged(evidence(one_sided), VOLTAGE).startswith("predicts the ends of the range of voltage +")


@pytest.mark.parametrize("seed", range(5))
def test_what_the_rest_does_not_show_does_no_harm(seed):
    """A switch that is on and off: without its upper end it does not move, but for a little noise of its own."""

    def switched(k, chunk):
        return np.zeros((len(chunk), 3))

    rows = evidence(switched, seed=seed)
    rng = np.random.default_rng(seed)
    for record in rows.records:
        on = (np.arange(len(record.chunk)) // 40) % 2 + 1e-3 * rng.normal(size=len(record.chunk))
        rate = record.chunk["gyro"] + 2e-5 * np.round(on)[:, None]
        object.__setattr__(record, "chunk", record.chunk.having(voltage=on, gyro=rate))
    assert judged(rows, VOLTAGE) == ""


def test_what_is_the_maps_or_of_time_is_not_looked_at():
    assert inputs(Curve(powers=2)) == inputs(Drift()) == ()
    assert inputs(SLIP) == ("temperature",)
    assert inputs(Interaction()) == ("voltage", "temperature")


def test_the_search_drops_it_and_says_why(monkeypatch):
    from driftlab.identification import candidates
    from driftlab.identification.search import search
    from fusion_core.host.registry import registry
    from fusion_plugins.thermal_maps.polynomial import Polynomial

    classes = {kind: cls for kind, cls in registry().classes(candidates.Effect).items() if kind == "channel"}
    monkeypatch.setattr(candidates, "installed", lambda: list(classes.values()))
    for bias, added in ((one_sided, []), (lambda k, chunk: signature(VOLTAGE, chunk) @ C_VOLTAGE, ["channel"])):
        rows = evidence(bias)
        T = np.concatenate([chunk["temperature"] for chunk in rows.chunks])
        basis = Polynomial(order=3).basis((float(T.min()), float(T.max())))
        found = search(rows, basis, lambda text: None)
        assert [term.effect.kind for term in found.model] == added
        assert added or any("ends of the range of voltage" in trial.reason for trial in found.trials)
