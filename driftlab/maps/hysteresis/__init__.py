"""Memories in one soak: hysteresis, lags and relaxations, beside a free curve."""
