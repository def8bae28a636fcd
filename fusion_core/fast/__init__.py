"""Compiled twins of the filter, and the gains that are known before the data."""
