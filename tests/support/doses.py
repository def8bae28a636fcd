"""Doses of tests that draw: a small one in the suite, the whole in `make statistics`."""

import os


def draws(few, whole):
    """Return how many seeds or examples a test draws."""
    return whole if "DRIFTLAB_STATISTICS" in os.environ else few
