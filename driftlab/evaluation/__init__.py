"""Scores of a run, limits of a customer, and the comparison of several runs."""
