"""Parts left out by the range of an input: what holds in one part of it alone is seen, what is real passes."""

import numpy as np
import pytest
from rows_at_rest import C_VOLTAGE, PLAY, SLIP, VOLTAGE, evidence, known, search_of, signature

from driftlab.loop.gates import Evidence
from driftlab.loop.input_range import does_not_carry_over, inputs, reach
from driftlab.loop.least_squares import Term
from driftlab.loop.state import Trial
from fusion_core.chunk import Chunk
from fusion_plugins.effects.curve import Curve
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.interaction import Interaction
from fusion_plugins.effects.relaxation import Relaxation

LATE = Relaxation(channel="voltage", tau="5 min")


def judged(rows, *effects):
    """Return what is said of the last effect beside the others."""
    model = tuple(map(Term, effects))
    evidence = Evidence(0.1, -9.0, 6, 0.5, len(model) > 1, 99.0, 99.0, 99.0, 3.0)
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


def swept(bias, size=1e-5, seed=0, white=2e-6):
    """Rows in which the supply sweeps from 3 to 7, and adds size times bias(its distance from 5)."""
    rows = evidence(lambda k, chunk: np.zeros((len(chunk), 3)), seed=seed, white=white)
    for k, record in enumerate(rows.records):
        u = 2 * np.sin(record.chunk.t / (170 + 40 * k))
        rate = record.chunk["gyro"] + size * bias(u)[:, None] * np.array([1.0, 2.0, -1.0])
        object.__setattr__(record, "chunk", record.chunk.having(voltage=5 + u, gyro=rate))
    return rows


def reached(rows, effect):
    return reach(search_of(rows, (Term(effect),)), Term(effect))


@pytest.mark.parametrize("effect", [VOLTAGE, LATE])
def test_what_predicts_the_ends_of_its_range_from_the_rest_may_go_on_by_as_much(effect):
    def real(u):
        chunk = Chunk(10.0 * np.arange(len(u)), {"voltage": 5 + u})
        return effect.signature(chunk, None)[0][:, 0, 0]

    assert reached(swept(real, size=1e-4), effect) == pytest.approx(0.25)


@pytest.mark.parametrize(("bias", "why"), [
    (np.tanh, "it bends off"),
    (lambda u: np.clip(u, -1.2, 1.2), "it ends"),
    (lambda u: u + 0.3 * u**3, "it grows"),
    (lambda u: 0.02 * u, "nothing is seen of it at the ends"),
])  # fmt: skip
def test_what_does_not_may_not(bias, why):
    assert reached(swept(bias), VOLTAGE) == 0, why


def test_nor_what_is_beside_a_map_that_holds_or_of_time():
    rows = swept(lambda u: u)
    assert reached(rows, Curve(powers=2)) == reached(rows, Drift()) == 0


@pytest.mark.parametrize("seed", range(8))
def test_going_on_is_nearer_than_holding_wherever_it_is_allowed(seed):
    """Laws that bend as they like: where the ends earn a reach, the part beyond is off by less than if it were held."""
    rng = np.random.default_rng(seed)
    for _ in range(4):
        soft, bent = rng.uniform(0.05, 0.6), rng.uniform(-0.3, 0.3)

        def law(u, soft=soft, bent=bent):
            return np.tanh(soft * u) / soft + bent * u**2 / 4

        if not reached(swept(law, seed=seed), VOLTAGE):
            continue
        u = np.linspace(-2, 2, 400)
        line = np.polyfit(u, law(u), 1)
        for end in (-2.0, 2.0):
            beyond = end * np.linspace(1, 1.5, 50)
            off = law(beyond) - np.polyval(line, beyond)
            held = law(beyond) - np.polyval(line, end)
            assert np.mean(off**2) < np.mean(held**2)


def test_the_search_drops_it_and_says_why(monkeypatch):
    from driftlab.loop import offers
    from driftlab.loop.search import search
    from fusion_core.host.registry import registry
    from fusion_plugins.thermal_maps.polynomial import Polynomial

    classes = {kind: cls for kind, cls in registry().classes(offers.Effect).items() if kind == "channel"}
    monkeypatch.setattr(offers, "installed", lambda: list(classes.values()))
    for bias, added in ((one_sided, []), (lambda k, chunk: signature(VOLTAGE, chunk) @ C_VOLTAGE, ["channel"])):
        rows = evidence(bias)
        T = np.concatenate([chunk["temperature"] for chunk in rows.chunks])
        basis = Polynomial(order=3).basis((float(T.min()), float(T.max())))
        found = search(rows, basis, lambda text: None)
        assert [term.effect.kind for term in found.model] == added
        assert added or any("ends of the range of voltage" in trial.reason for trial in found.trials)
