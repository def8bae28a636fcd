"""Thousands of units: what is done to each, by whom, and what is kept of it."""
