"""Experiment design: the chamber profile with the smallest uncertainty of a unit's map, before any recording."""
