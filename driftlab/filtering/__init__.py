"""One recording through one config: alignment, filter, prediction, checkpoints."""
