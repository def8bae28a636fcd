"""Measurement models: the states that sensors share, and the measurement of each epoch."""
