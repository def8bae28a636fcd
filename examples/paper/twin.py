"""The twin of the paper's experiment: its soak, its ramps, and the two filters with what may be varied of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from driftlab.config import Config, load_config
from driftlab.maps.fit import fit_map
from fusion_core.contracts import FittedMap, Source
from fusion_core.faults import Faults
from fusion_core.units import Quantity

HERE = Path(__file__).parent
OUT = HERE.parent.parent / "demo_out" / "paper"
RAMP = {"kind": "ramp", "low": "27.28 degC", "high": "34.08 degC", "rate": "2 K/min", "hold": "60 s", "cycles": 3}
LOOP = {"width": "4 K", "gain": ["8 deg/h/K", "-6 deg/h/K", "10 deg/h/K"]}


def source(seed: int, *, ramp: bool, hysteresis: bool = False) -> Source:
    """Return a recording of the twin: the soak, or three cycles of the ramp (26 min at 100 Hz)."""
    base = load_config(HERE / "twin.yaml").source
    assert base is not None
    settings: dict[str, Any] = base.model_dump(mode="json", exclude_none=True) | {"seed": seed}
    if ramp:
        settings |= {"profile": RAMP, "rate": "100 Hz"}
    if hysteresis:
        settings["gyro"]["hysteresis"] = LOOP
    return type(base).model_validate(settings)


def fit(*, hysteresis: bool = False) -> FittedMap:
    """Fit the network on the twin's soak, as `driftlab fit-map` would."""
    soak = source(0, ramp=False, hysteresis=hysteresis)
    config = load_config(HERE / "standard.yaml").model_copy(update={"source": soak})
    OUT.mkdir(parents=True, exist_ok=True)
    fitted = fit_map(config, [], None, Faults())
    fitted.save(OUT / "map.onnx")
    return fitted


def filter_config(name: str, recording: Source, *, walk: float | None = None, form: str | None = None) -> Config:
    """Return the paper's `standard` or `tczupt` filter on a recording, with another walk (rad/s/sqrt(s)) or form."""
    config = load_config(HERE / f"{name}.yaml").model_copy(update={"source": recording})
    assert config.filter is not None
    update: dict[str, Any] = {}
    if walk is not None:
        update["walk"] = Quantity(walk, f"{walk!r} rad/s/sqrt(s)")
    if form is not None:
        update["form"] = form
    gyro = config.filter.gyro
    gyro = gyro.model_copy(update={"bias": gyro.bias.model_copy(update=update)})
    return config.model_copy(update={"filter": config.filter.model_copy(update={"gyro": gyro})})
