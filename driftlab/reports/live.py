"""The page of a live run: what does not change of it. The rest it asks for."""

from __future__ import annotations

from collections.abc import Sequence

from driftlab.reports.charts import Chart
from driftlab.reports.pages import embedded, page
from driftlab.units import axis_name, unit_of
from fusion_core.contracts import Sensor


def live_page(
    title: str, sensor: Sensor, names: Sequence[str], *, device: str, results: str, serial: str | None = None
) -> str:
    """Return the page of a live run as HTML.

    Parameters
    ----------
    title : str
        Of the run.
    sensor : Sensor
        The tracked one.
    names : sequence of str
        Of the columns of its history.
    device, results : str
        Where its samples come from, and where its results will be.
    serial : str, optional
        Of the unit.
    """
    unit = unit_of(sensor)
    about = {
        "axes": (axes := [axis_name(sensor.channel, axis) for axis in sensor.axes]),
        "names": list(names),
        "unit": {"shown": unit.shown, "factor": unit.factor, "fixed": unit.digits == ".2f"},
        "keys": {name: unit.key(name) for name in ("bias", "sigma", "sigma_wanted")},
        "results": results,
    }
    figures = {
        "biases": Chart((), "time [s]", f"Bias of the {sensor.channel}"),
        "others": Chart((), "time [s]", "Temperature, consistency and transmission"),
        "map": Chart((), "temperature [°C]", "Sigma of the map"),
    }
    return page(
        "live", title=title, device=device, serial=serial, about=embedded(about), axes=axes, figures=figures,
        results=results,
    )  # fmt: skip
