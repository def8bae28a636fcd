"""Acceptance of an effect goes by what it says of itself and never by its name."""

from dataclasses import replace

import pytest
from third_parties import effect

from driftlab.identification.acceptance import CandidateEvidence, accept
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.periodic import Periodic
from fusion_plugins.effects.turn_on import TurnOn

# enough for any effect that no walk imitates, and too little for one that a walk does
SEEN = CandidateEvidence(0.86, -3.0, 9, 0.9, beside=False, left_out=20.0, chance=60.0, gain=40.0, price=5.0)


def of_time(course):
    return effect(f"acme_{course}", requires=property(lambda self: ()), course=course)()


@pytest.mark.parametrize(("mine", "theirs"), [(Drift(), "transient"), (Periodic(), "line"), (TurnOn(), "transient")])
@pytest.mark.parametrize("beside", [False, True])
@pytest.mark.parametrize("ratio", [0.6, 0.75, 0.84])
def test_a_third_partys_effect_of_time_goes_through_the_same_gates(mine, theirs, beside, ratio):
    evidence = replace(SEEN, beside=beside, ratio=ratio)
    assert accept(of_time(theirs), evidence, ()) == accept(mine, evidence, ())


def test_what_a_walk_imitates_is_asked_for_more():
    """The_loop, section 4: a transient below 0.8, beside others below 0.7; a line as any other."""
    passes = {
        (course, beside, ratio): accept(of_time(course), replace(SEEN, beside=beside, ratio=ratio), ())[0]
        for course in ("transient", "line")
        for beside in (False, True)
        for ratio in (0.65, 0.75, 0.84)
    }
    refused = {key for key, enough in passes.items() if not enough}
    assert refused == {
        ("transient", False, 0.84),
        ("transient", True, 0.75),
        ("transient", True, 0.84),
    }
