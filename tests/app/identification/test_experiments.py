"""A recording is proposed where it tells two models apart, and not where it tells nothing."""

from rows_at_rest import PLAY, SLIP, VOLTAGE, evidence, known, search_of
from third_parties import effect, registry_of

from driftlab.identification.experiments import Question, propose
from driftlab.identification.least_squares import Term
from driftlab.identification.trials import AS_GOOD

PLAYS, MOVES, SLIPS = Term(PLAY), Term(VOLTAGE), Term(SLIP)


def test_what_differs_is_told_apart_and_the_same_is_not_asked():
    found = search_of(evidence(known), (PLAYS, MOVES))
    asked = Question((PLAYS, MOVES), (SLIPS, MOVES), ("hysteresis", "relaxation"))
    never = Question((PLAYS, MOVES), (MOVES, PLAYS), ("one", "the same"))
    (proposed,) = propose(found, [asked, never])
    assert proposed.separates == ("hysteresis", "relaxation")
    assert proposed.expected_gain_nats > AS_GOOD


def test_a_recording_that_an_effect_has_no_answer_to_tells_nothing():
    found = search_of(evidence(known), (PLAYS, MOVES))

    def signature(self, chunk, memory):
        if len(chunk) > 500:  # as long as a designed recording is
            raise ValueError("too long for me")
        return VOLTAGE.signature(chunk, memory)

    cls = effect("short_winded", signature=signature)
    registry_of(cls)  # which puts the boundary about it
    short = Term(cls())
    question = Question((PLAYS, MOVES), (PLAYS, short), ("channel", "short_winded"))
    assert propose(found, [question]) == ()
