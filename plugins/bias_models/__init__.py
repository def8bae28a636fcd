"""Models of how a sensor bias moves, one file each."""
