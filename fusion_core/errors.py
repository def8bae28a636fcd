"""The errors that a user can cause, each named for what is wrong, and moments as their messages say them.

A message says who has a problem, what it has and what was expected; after a semicolon, what to do.
Anything else that is raised is a defect of the program, and keeps its traceback.

A moment is in seconds from the recording's first row, as in `PATH::START:STOP`. The file's own time stands beside it
where it counts from elsewhere: `812.0 s (t = 1760000812.0 s in the file)`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.util import find_spec

from fusion_core.escaping import line


def moment(t: float, first_row: float | None) -> str:
    """Return the text of a moment.

    Parameters
    ----------
    t : float
        In the file's own seconds.
    first_row : float or None
        Of the recording, in the same; None where it is not known: the file's own time then stands alone.
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


def quote(text: object, most: int = 60) -> str:
    """Return a text that someone else wrote, as it can stand in a message: short, and without control characters."""
    plain = str(text)
    short = plain if len(plain) <= most else f"{plain[: most - 3]}..."
    return line(short)


def describe_error(error: BaseException, most: int = 200) -> str:
    """Return the name of an error and what it says, as it can stand in a message."""
    text = quote(error, most)
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


def check_installed(whose: str, package: str, use: str, extra: str, otherwise: str = "") -> None:
    """Raise ConfigError where an optional package is not installed: what it is for, and the extra that brings it."""
    if find_spec(package.replace("-", "_")) is None:
        raise ConfigError(
            f"{whose}: the package {package} is not installed, it was expected for {use}; "
            f"pip install 'driftlab[{extra}]'{otherwise}"
        )


class FusionError(Exception):
    """Base of every error whose message is meant for the user."""


class ConfigError(FusionError):
    """The configuration is wrong: an unknown key, a missing unit, a value out of range."""


class UnitError(FusionError, ValueError):
    """A text is not a quantity, its unit is unknown, or it has the wrong dimension."""


class PluginError(FusionError):
    """A plugin is missing, broken, or breaks its contract.

    Attributes
    ----------
    plugin, family : str or None
        Kind and family of the plugin, where one is to blame.
    """

    def __init__(self, message: str, *, plugin: str | None = None, family: str | None = None) -> None:
        super().__init__(message)
        self.plugin, self.family = plugin, family


class Unwritable(FusionError):
    """A file cannot be written: the disk is full or read-only, or a limit of size was met."""


class DataError(FusionError):
    """Base of what can be wrong with a recording."""


class UnreadableFile(DataError):
    """The file is not there, is not of the declared format, or ends before its own header says it should."""


class EmptyRecording(DataError):
    """There is not one row to use."""


class MissingChannel(DataError):
    """A channel is needed that the recording (or the config) does not have."""


class BadValue(DataError):
    """A cell is not a number, or a column has the wrong shape."""


class UnitConflict(DataError):
    """The config and the file name different units for the same channel."""


class TimeBackwards(DataError):
    """A time stamp is smaller than the one before it."""


class OutsideDomain(DataError):
    """The input of a map lies outside the range on which the map was fitted.

    Parameters
    ----------
    what, and_so : str
        The message, before and after it says when.
    t : float, optional
        When, in the recording's own seconds.
    """

    def __init__(self, what: str, and_so: str, t: float | None = None) -> None:
        self.what, self.and_so, self.t = what, and_so, t
        super().__init__(f"{what}{'' if t is None else f' at t = {seconds(t)}'}{and_so}")

    def __reduce__(self) -> tuple[type[OutsideDomain], tuple[str, str, float | None]]:
        return type(self), (self.what, self.and_so, self.t)  # it comes whole from another process

    def at(self, when: Callable[[float], str]) -> OutsideDomain:
        """Return the same error with the moment as `when` says it."""
        return self if self.t is None else OutsideDomain(f"{self.what} at {when(self.t)}", self.and_so)


class MapError(DataError):
    """A map file is missing, damaged, or of another kind than the config says."""


class SwingTooSmall(DataError):
    """The recording does not move its input enough to fit a map."""


class SingularFit(DataError):
    """The data cannot determine the coefficients that were asked for."""


class NotAtRest(DataError):
    """No stretch at rest, long enough for the alignment, was found."""
