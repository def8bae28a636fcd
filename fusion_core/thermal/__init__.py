"""Fitted thermal maps: their fit, their file and the uncertainty of their curves."""
