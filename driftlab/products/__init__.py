"""Packaged product lines: one YAML file per gyro type, named by `extends:`."""
