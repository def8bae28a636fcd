"""Scores of a run whose estimates are there as a whole."""

from driftlab.evaluation.scores import ScoreAccumulator, moving_average


def score(estimates, up, axes):
    """Measure a run by its estimates, all of them at once."""
    tally = ScoreAccumulator(estimates["bias"].shape[1])
    still = estimates["still"].astype(bool)
    tally.add(estimates, moving_average(estimates["t"], estimates["rate"], estimates["tau"], still))
    return tally.yardsticks(up, axes)
