"""When something was, as messages say it: seconds from the recording's first row, as in `PATH::START:STOP`.

The file's own time stands beside it where it counts from elsewhere: `812.0 s (t = 1760000812.0 s in the file)`.
"""

from __future__ import annotations


def moment(t: float, first_row: float | None) -> str:
    """Return the text of a moment.

    Parameters
    ----------
    t : float
        In the file's own seconds.
    first_row : float or None
        Of the recording, in the same; None where it is not known: the file's own time is then said alone.
    """
    if first_row is None:
        return f"t = {seconds(t)}"
    if abs(first_row) < 5e-4:  # the two read alike
        return seconds(t - first_row)
    return f"{seconds(t - first_row)} (t = {seconds(t)} in the file)"


def seconds(t: float) -> str:
    """Return a time as text, to the millisecond: `812.0 s`, `0.013 s`."""
    if not abs(t) < 1e15:  # neither NaN
        return f"{t:.6g} s"
    whole = f"{t:.3f}".rstrip("0")
    return f"{whole}0 s" if whole.endswith(".") else f"{whole} s"
