"""Damaged and mutated HDF5 recordings through `driftlab run`, against what h5py and NumPy read in them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from torture import base, grammar
from torture.outcome import Outcome, Said, program
from torture.truth import Results, Truth, judge, plausible

CASES, WORKERS, LIMIT, IN_PROCESS = 1_000, 2, 5.0, True
POWERS = {"time": {"s": 1}, "gyro": {"rad": 1, "s": -1}, "accel": {"m": 1, "s": -2}, "temperature": {"K": 1}}
RNG = np.random.Generator


def samples(path: Path) -> dict[str, np.ndarray] | None:
    """Return what h5py reads, in SI; None where it cannot, or where a unit is none."""
    try:
        with h5py.File(path, "r") as file:
            return {name: _channel(file[name], name) for name in base.UNITS}
    except Exception:  # whatever a damaged file makes of it
        return None


def _channel(data: Any, name: str) -> np.ndarray:
    attributes = {key: data.attrs.get(key) for key in ("unit", "units", "scale_factor", "add_offset")}
    texts = [
        value.decode() if isinstance(value, bytes) else value for value in (attributes["unit"], attributes["units"])
    ]
    unit = next(
        text.strip("\0 ")
        for text in (np.ravel(t)[0] for t in texts if t is not None and np.size(t) == 1)
        if str(text).strip("\0 ")
    )
    try:
        factor, powers = grammar.unit_with_factor(unit)
    except grammar.NotKnown as error:
        raise ValueError(unit) from error
    if powers != POWERS[name] or data.dtype.kind not in "iufb":
        raise ValueError(f"{unit} {data.dtype}")
    raw = data[()]
    values = np.asarray(raw, dtype=np.float64)
    for key in ("_FillValue", "missing_value"):
        for value in np.ravel(data.attrs.get(key, [])):
            values = np.where(raw == value, np.nan, values)
    scale, offset = (np.ravel(attributes[key]) for key in ("scale_factor", "add_offset"))
    values = values * (1.0 if attributes["scale_factor"] is None else float(scale[0]))
    values = values + (0.0 if attributes["add_offset"] is None else float(offset[0]))
    zero = {"K": -273.15, "degF": -32 / 1.8}.get(unit, 0.0)
    values = values * factor + zero
    columns = values.reshape(len(values), -1)
    if columns.shape[1] > (3 if name in ("gyro", "accel") else 1):
        raise ValueError(columns.shape)
    return columns if name in ("gyro", "accel") else columns[:, 0]


def of_bytes(path: Path, rng: RNG) -> None:
    """Flip, cut, overwrite or lengthen."""
    raw = bytearray(path.read_bytes())
    where = len(raw) if rng.random() < 0.5 else min(len(raw), 4096)  # the first bytes are the structure
    match rng.integers(6):
        case 0 | 1:
            for _ in range(int(rng.choice([1, 1, 2, 16]))):
                raw[rng.integers(where)] ^= 1 << int(rng.integers(8))
        case 2:
            raw = raw[: rng.integers(len(raw))]
        case 3:
            k, size = rng.integers(where), int(rng.choice([1, 8, 100, 3000]))
            raw[k : k + size] = bytes([int(rng.choice([0, 255]))]) * len(raw[k : k + size])
        case 4:
            raw += bytes(rng.integers(0, 256, int(rng.choice([1, 1000, 100_000])), dtype=np.uint8))
        case _:
            k, size = rng.integers(where), int(rng.choice([1, 8, 64]))
            raw[k : k + size] = bytes(rng.integers(0, 256, len(raw[k : k + size]), dtype=np.uint8))
    path.write_bytes(raw)


TEXTS = (
    "deg/s", "mrad/s", "rad/s", "m/s^2", "mg", "g", "s", "ms", "us", "degC", "K", "degF", "0.5 mrad/s", "2 s",
    "1e-3 g", "1", "",
    " ", "banana", "rad", "deg/s/s", "1,5 deg/s", "9**2 deg/s", "2*3 s", "60 s # ms", "1 000 s", "nan s", "1e999 s",
    "-1 s", "0 s",
    "rad/s\0\0", "rad/s + 1 rad/s", "(2) s", "1 .5 degC", "x" * 70_000 + " s", "\u00b0C", "e", "[bold]s",
    "1e308 m/s^2", "9**9**9**9 s",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    b"rad/s", b"\xff\xfe", np.array([b"s", b"ms"]), 3, 1.5, np.nan, np.inf, -1.0, 0.0, 1e300, np.array([]),
    np.array([1.0, 2.0]),
    np.arange(6).reshape(2, 3), "text", True, 2**62, np.complex128(1j),
)  # fmt: skip


def of_attributes(path: Path, rng: RNG) -> None:
    """Units, and the packing of the CF conventions."""
    with h5py.File(path, "a") as file:
        attributes = file[_name(rng)].attrs
        key = ("unit", "unit", "unit", "units", "scale_factor", "add_offset", "_FillValue", "missing_value")[
            rng.integers(8)
        ]
        if key.startswith("unit") and rng.random() < 0.85:
            weights = np.array([1.0] * (len(TEXTS) - 1) + [0.1])
            text = TEXTS[rng.choice(len(TEXTS), p=weights / weights.sum())]
            if rng.random() < 0.1:
                del attributes["unit"]
            attributes[key] = np.bytes_(text.encode()[:60_000]) if rng.random() < 0.3 or "\0" in text else text[:60_000]
        else:
            attributes[key] = VALUES[rng.integers(len(VALUES))]


def _name(rng: RNG) -> str:
    return str(rng.choice(list(base.UNITS)))


def of_structure(path: Path, rng: RNG) -> None:
    """Names, links, shapes and types."""
    name = _name(rng)
    with h5py.File(path, "a") as file:
        data, unit = file[name][()], file[name].attrs["unit"]
        del file[name]
        N, how = len(data), int(rng.integers(16))
        made: Any = {
            1: data[:-1], 2: data.T, 3: data[:0], 4: data[..., None], 5: data[0], 6: data.astype(np.float32),
            7: np.nan_to_num(data).astype(np.int8), 8: data.astype("S20"), 9: data.astype(complex), 10: data > 0,
            11: np.zeros(N, dtype=[("a", "f8"), ("b", "i4")]), 12: np.zeros((N, 7)), 13: np.concatenate([data,
            data[-3:]]),
        }.get(how, data)  # fmt: skip
        if how == 0:
            file[name + "_"] = data
            return
        if how == 14:
            file.create_group(name)
            return
        if how == 15:
            file[name] = (h5py.SoftLink(f"/{name}"), h5py.SoftLink("/no"), h5py.ExternalLink("no.h5", "/x"))[
                rng.integers(3)
            ]
            return
        made = np.asarray(made)
        chunks = made.ndim > 0 and made.size > 0 and rng.random() < 0.5
        file.create_dataset(
            name, data=made, **({"chunks": True, "compression": "gzip", "fletcher32": True} if chunks else {})
        )
        file[name].attrs["unit"] = unit


def of_values(path: Path, rng: RNG) -> None:
    """Values that no sensor has, or that it repeats."""
    with h5py.File(path, "a") as file:
        data = file[_name(rng)]
        values, N = data[()], len(data)
        k, n = int(rng.integers(N)), int(rng.choice([1, 5, 150, N]))
        rows = slice(k, k + n) if n < N else slice(None)
        bad = rng.choice([np.nan, np.inf, -np.inf, 1e300, -1e300, 1e38, 0.0, 1e-300])
        match rng.integers(4):
            case 0 | 1:
                values[rows] = bad
            case 2:
                values[rows] = values[k]
            case _:
                values[rows] = values[rows] * rng.choice([-1.0, 10.0, 1e6])
        data[...] = values


def of_time(path: Path, rng: RNG) -> None:
    """Stamps in disorder."""
    with h5py.File(path, "a") as file:
        t = file["time"][()]
        N, k = len(t), int(rng.integers(1, len(t)))
        match rng.integers(11):
            case 0:
                t[k:] -= rng.choice([0.05, 1.0, 1e3, 1e12])
            case 1:
                t[k] = t[k - 1]
            case 2:
                t = t[::-1].copy()
            case 3:
                rng.shuffle(t)
            case 4:
                t[k:] += rng.choice([1e4, 3e7, 1e12, 1e300])
            case 5:
                t[:] = t[0]
            case 6:
                t[k] = rng.choice([np.nan, np.inf, -np.inf])
            case 7:
                t[rng.integers(0, N, 50)] = np.nan
            case 8:
                t[k:] = t[: N - k] + t[k - 1]
            case 9:
                t = np.round(t)
            case _:
                t = t * rng.choice([1e-6, 1e6, -1.0]) + rng.choice([0.0, 1.7e9])
        file["time"][...] = t


MUTATIONS: tuple[Callable[[Path, RNG], None], ...] = (
    of_bytes,
    of_bytes,
    of_attributes,
    of_structure,
    of_values,
    of_time,
)


def prepare(folder: Path) -> None:
    """Write the recording."""
    base.write_h5(folder / "recording.h5", base.recording())


class Bench:
    """The undisturbed run, and a config that takes the units from the file."""

    SUFFIX, KIND = ".h5", "hdf5"

    def __init__(self, folder: Path, case: Path) -> None:
        self.folder, self.config = folder, folder / f"{self.KIND}.yaml"
        base.write_config(self.config, base.config(base.source(self.KIND)))
        self.recording = folder / f"recording{self.SUFFIX}"
        said = self.run(self.recording)
        if said.status != 0:
            raise RuntimeError(f"the undisturbed recording was refused: {said}")
        self.clean = Results.of(Path("out"), said)
        if not plausible(self.clean):
            raise RuntimeError("the undisturbed run is not plausible: the oracle is wrong")
        truth = self.truth(self.recording)
        if truth is None or truth.differs(self.read(self.recording)):
            raise RuntimeError("the undisturbed recording is not read alike")
        self.samples = truth.data

    def run(self, path: Path) -> Said:
        """Run the program on a file."""
        return program("run", self.config, "--input", path, "--out", "out")

    def read(self, path: Path) -> dict[str, np.ndarray]:
        """Return what the program's own reader gives to the filter, before rows are left out."""
        from driftlab.config import load_config
        from fusion_core.chunk import concatenate
        from fusion_core.faults import Faults

        source = load_config(self.config, str(path)).source
        assert source is not None, "the config has a source"
        chunk = concatenate(source.chunks(65_536, Faults()))
        return {"time": chunk.t, **chunk.channels}

    def truth(self, path: Path) -> Truth | None:
        """Read the file independently of the program."""
        data = samples(path)
        return None if data is None else Truth(data)

    def mutate(self, path: Path, rng: RNG) -> None:
        """Write the mutated recording."""
        path.write_bytes(self.recording.read_bytes())
        MUTATIONS[rng.integers(len(MUTATIONS))](path, rng)

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Mutate, run and judge."""
        path = folder / f"mutated{self.SUFFIX}"
        self.mutate(path, rng)
        said = self.run(path)
        refused = said.refused()
        if refused is not None:
            return refused
        truth = self.truth(path)
        same = truth is not None and all(
            truth.data[name].shape == values.shape and np.allclose(truth.data[name], values, rtol=1e-12, atol=1e-15)
            for name, values in self.samples.items()
        )
        return judge(Results.of(folder / "out", said), truth, self.read(path), self.clean, same)
