"""Calibration of many units in parallel, with storage that can be resumed."""
