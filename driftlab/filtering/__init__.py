"""One recording through one config: alignment, filter, coasting, checkpoints."""
