"""The laws of stimuli, on recordings that they simulate themselves. m equations, q terms."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Site, Stimulus, TriadInput
from fusion_core.contracts.stimulus import SENSITIVITIES, TERMS
from fusion_core.errors import ConfigError

CHANNELS = {"gyro": None, "accel": (9.80665, 0.0)}  # with the length of the input at rest
SIZES = np.array([0.01] * 3 + [0.01] * 9 + [1e-3] * 9)  # of the terms that are simulated


def equations_have_their_shapes(stimulus: Stimulus) -> None:
    """There are m finite rows of each, more than terms, with T in order; J has a column a term."""
    for known, values in _cases(stimulus):
        q = len(values)
        e = known.equations(np.tile(values, (len(known.T), 1)))
        m = len(e.left)
        assert m > len(TERMS), f"{m} equations for {len(TERMS)} terms"
        assert e.J.shape in ((m, q), (m, len(TERMS))), f"J has shape {e.J.shape}, {(m, q)} expected"
        assert all(len(part) == m for part in (e.T, e.t, e.group)), f"T, t and group have not {m} rows each"
        assert set(np.unique(e.group)) <= {0, 1}, "a group is neither 0 nor 1"
        assert e.recording is None or len(e.recording) == m, f"recording has not {m} rows"
        for name, part in (("left", e.left), ("J", e.J), ("T", e.T), ("t", e.t)):
            assert np.all(np.isfinite(part)), f"{name} is not finite"


def equations_hold_for_the_terms_of_the_unit(stimulus: Stimulus) -> None:
    """Of a simulated unit nothing is left at its own terms, beside what is left at zero."""
    for known, values in _cases(stimulus):
        own, zero = (
            known.equations(np.tile(terms, (len(known.T), 1))).left for terms in (values, np.zeros_like(values))
        )
        share = np.linalg.norm(own) / np.linalg.norm(zero)
        assert share < 0.02, f"at the unit's own terms {share:.0%} is left of what is left at zero"


def derivatives_are_those_of_differences(stimulus: Stimulus) -> None:
    """J is the derivative of what is modelled: left falls by it."""
    h = 1e-6
    for known, values in _cases(stimulus):
        about = np.tile(values, (len(known.T), 1))
        J = known.equations(about).J
        for j, column in enumerate(J.T):
            step = h * (np.arange(len(values)) == j)
            lefts = [known.equations(about + sign * step).left for sign in (-1, 1)]
            difference = (lefts[0] - lefts[1]) / (2 * h)
            scale = max(float(np.max(np.abs(J))), 1e-12)
            np.testing.assert_allclose(column, difference, rtol=5e-3, atol=5e-3 * scale, err_msg=f"of term {j}")


def what_is_lacking_has_a_remedy(stimulus: Stimulus) -> None:
    """The reason why a term is not observable is followed by `; ` and what to do, in one line."""
    for known, values in _cases(stimulus):
        for term in range(len(values)):
            text = known.lacking(term)
            reason, semicolon, remedy = text.partition("; ")
            assert reason and semicolon and remedy and "\n" not in text, f"'{text}' has no reason or remedy"  # noqa: PT018


def _cases(stimulus: Stimulus) -> Iterator[tuple[TriadInput, Array]]:
    """Yield the inputs that a stimulus makes of recordings that it simulates, with the terms of the unit."""
    for channel, length in CHANNELS.items():
        for q in (len(TERMS), len(TERMS) + len(SENSITIVITIES)) if channel == "gyro" else (len(TERMS),):
            rng = np.random.default_rng(q)
            values = rng.normal(0, SIZES[:q])
            try:
                recordings = stimulus.simulated(channel, values, rng)
            except ConfigError:  # of the other triad alone, or of none
                break
            yield stimulus.inputs(recordings, channel, Site(), length), values
