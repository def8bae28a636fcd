"""An inertial unit at rest: alignment, Earth rate, the zero-velocity model, the rest detector."""
