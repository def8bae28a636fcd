"""How error is measured: scores of a run, and of several side by side."""
