"""Sources of plugins that a third party might write: some good, most of them not."""

# every method goes wrong in the way that the config names
WRONG = """
import sys
from pathlib import Path
from typing import Literal

import numpy as np

from fusion_core.chunk import Chunk
from fusion_core.contracts import (
    BiasModel, Effect, FittedMap, Frames, Framing, MapRecord, Measurement, Prior, Source, ThermalMap,
    Transition,
)
from fusion_core.hookspecs import hookimpl
from fusion_plugins.measurement_models.held import Held


class Bias(BiasModel):
    kind: Literal["acme_bias"] = "acme_bias"
    how: str = ""

    def prior(self):
        match self.how:
            case "prior raises":
                return {}["prior"]
            case "prior is NaN":
                return Prior(np.full(3, np.nan), np.eye(3))
            case "prior is lopsided":
                return Prior(np.zeros(3), np.eye(3) + np.eye(3, k=1))
            case "prior is too short":
                return Prior(np.zeros(2), np.eye(2))
        n = len(self.labels)
        return Prior(np.zeros(n), 1e-4 * np.eye(n))

    @property
    def labels(self):
        return ("a", "b", "c", "d", "e", "f") if self.how == "six states without C" else self.axes

    def transition(self, chunk, memory):
        F, Q, u = np.eye(3), 1e-16 * np.eye(3), np.zeros((len(chunk), 3))
        match self.how:
            case "transition raises":
                1 / 0
            case "transition exits":
                sys.exit()
            case "transition exits with 0":
                sys.exit(0)
            case "gyro is written":
                chunk["gyro"][:] = 0
            case "time is written":
                chunk.t[0] = 0
            case "a channel is replaced":
                chunk.channels["gyro"] = np.zeros((len(chunk), 3))
            case "the one before is written":
                if chunk.previous is not None:
                    chunk.previous["gyro"][:] = 0
            case "memory is written":
                memory = np.zeros(1) if memory is None else memory
                memory[0] += 1
            case "Q is indefinite":
                Q = Q @ np.diag([1, 1, -1])
            case "F is too wide":
                F = np.eye(4)
            case "u is too short":
                u = u[1:]
            case "u is NaN":
                u[-1] = np.nan
            case "F is a list":
                F = F.tolist()
            case "no memory":
                return Transition(F, Q, u)
            case "six states without C":
                F, Q, u = np.eye(6), 1e-16 * np.eye(6), np.zeros(6)
        return Transition(F, Q, u), memory

    @property
    def requires(self):
        if self.how == "requires raises":
            raise AttributeError("requires what")
        return ()


class Curve(FittedMap):
    def save(self, path):
        path.write_text(self.record.model_dump_json())

    def _bias(self, T):
        match Path("how").read_text():
            case "curve is NaN":
                return np.full((len(T), 3), np.nan)
            case "curve is flat":
                return np.zeros(len(T))
            case "curve raises":
                raise RuntimeError("no licence")
            case "curve writes":
                T[:] = 20
        return np.zeros((len(T), 3))

    def _slope(self, T):
        return np.zeros((len(T), 3))


class Map(ThermalMap):
    kind: Literal["acme_map"] = "acme_map"
    how: str = ""

    def fit(self, T, bias, provenance):
        match self.how:
            case "fit raises":
                raise ValueError("two\\nlines")
            case "fit exits":
                sys.exit(3)
            case "fit writes T":
                T -= T.mean()
            case "fit writes bias":
                bias[:] = 0
            case "fit gives nothing":
                return None
        record = MapRecord(kind="acme_map", domain=(-50, 99), residual=(1e-6,) * 3, samples=len(T))
        return Curve(record, outside=self.outside)

    def read(self, path):
        if self.how == "read raises":
            raise KeyError("knots")
        return Curve(MapRecord.model_validate_json(Path(path).read_text()), outside=self.outside)


class Gravel(Source):
    kind: Literal["acme_source"] = "acme_source"
    how: str = ""

    def chunks(self, size, faults):
        t = np.arange(4000) / 20
        channels = {"gyro": np.random.default_rng(0).normal(size=(4000, 3)) * 1e-5}
        yield Chunk(t, channels)
        match self.how:
            case "source raises":
                raise ConnectionError("gone")
            case "source exits":
                sys.exit()
            case "channel is short":
                yield Chunk(t + 1e4, {"gyro": channels["gyro"][1:]})
            case "axes vanish":
                yield Chunk(t + 1e4, {"gyro": channels["gyro"][:, :2]})
            case "channel is text":
                yield Chunk(t + 1e4, {"gyro": channels["gyro"].astype(str)})
            case "not a chunk":
                yield channels


class Torn(Framing):
    kind: Literal["acme_framing"] = "acme_framing"
    how: str = ""

    def decode(self, data, memory):
        if self.how == "decode raises":
            return data[10**9]
        return Frames(3, {"gyro": np.zeros((2, 3))}), memory


class Part(Effect):
    kind: Literal["acme_effect"] = "acme_effect"
    how: str = ""
    explanation = property(lambda self: "none")
    requires = property(lambda self: ())

    def candidates(self):
        if self.how == "candidates raise":
            raise RuntimeError("no grid")
        yield self

    def signature(self, chunk, memory):
        N, d = len(chunk), len(self.axes)
        match self.how:
            case "signature raises":
                raise IndexError("out of range")
            case "signature is NaN":
                return np.full((N, d, d), np.nan), memory
            case "signature is flat":
                return np.zeros((N, d)), memory
        return np.zeros((N, d, d)), memory

    def input(self, chunk, memory):
        T = chunk["temperature"]
        return (T[1:] if self.how == "input is short" else T), memory


class Rig(Held):
    kind: Literal["acme_rig"] = "acme_rig"
    how: str = ""

    def prior(self, blocks, alignment=None):
        return None if self.how == "prior is none" else super().prior(blocks, alignment)

    def equations(self, chunk, steps, alignment):
        step, measured = super().equations(chunk, steps, alignment)
        z, H, R, used = measured.z, measured.H, measured.R, measured.used
        match self.how:
            case "equations are none":
                return None
            case "H is too large":
                H = np.zeros((4, 7))
            case "R is negative":
                R = -np.asarray(R)
            case "z is short":
                z = z[1:]
        return step, Measurement(z, H, R, used)


@hookimpl
def measurement_models():
    return [Rig]


@hookimpl
def bias_models():
    return [Bias]


@hookimpl
def thermal_maps():
    return [Map]


@hookimpl
def sources():
    return [Gravel]


@hookimpl
def framings():
    return [Torn]


@hookimpl
def effects():
    return [Part]
"""

DISPLACING = """
from typing import Literal
import numpy as np
from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.hookspecs import hookimpl


class Mine(BiasModel):
    kind: Literal["random_walk"] = "random_walk"

    def prior(self):
        return Prior(np.zeros(3), np.eye(3))

    def transition(self, chunk, memory):
        return Transition(np.eye(3), np.zeros((3, 3)), np.zeros(3)), memory


@hookimpl
def bias_models():
    return [Mine]


@hookimpl
def products():
    return {"mems_crs05": __file__}
"""

EXITING = "import sys\nsys.exit()\n"

EXITING_HOOK = """
from fusion_core.hookspecs import hookimpl


@hookimpl
def sources():
    raise SystemExit("no licence")
"""

BAD_FIELD = """
from typing import Literal
from fusion_core.contracts import Source
from fusion_core.hookspecs import hookimpl


class Socket:
    pass


class Bad(Source):
    kind: Literal["acme_socket"] = "acme_socket"
    socket: Socket | None = None

    def chunks(self, size, faults):
        yield from ()


class Undefined(Source):
    kind: Literal["acme_undefined"] = "acme_undefined"
    port: "Port"

    def chunks(self, size, faults):
        yield from ()


class Unwritable(Source, arbitrary_types_allowed=True):
    kind: Literal["acme_unwritable"] = "acme_unwritable"
    socket: Socket

    def chunks(self, size, faults):
        yield from ()


@hookimpl
def sources():
    return [Bad, Undefined, Unwritable]
"""

OTHER_CONTRACT = """
from typing import ClassVar, Literal
from fusion_core.contracts import Source
from fusion_core.hookspecs import hookimpl


class Later(Source):
    contract: ClassVar[int] = 7
    kind: Literal["acme_later"] = "acme_later"

    def chunks(self, size, faults):
        yield from ()


@hookimpl
def sources():
    return [Later]
"""

# what a third party may bring beside classes of the families that there are
WHOLE = '''
from abc import abstractmethod
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from fusion_core.contracts import Exporter, Family, Loss, Plugin, ReportSection, Section, SensorLoss, Source
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed


class Tap(Plugin):
    contract: ClassVar[int] = 2

    @abstractmethod
    def take(self, x):
        """Something."""


class TapSource(Source):
    kind: Literal["acme_taps"] = "acme_taps"
    tap: Annotated[Tap, Installed()]

    def chunks(self, size, faults):
        from fusion_core.chunk import Chunk

        yield Chunk(np.arange(4000) / 20, {"gyro": self.tap.take(np.zeros((4000, 3)))})


class Page(ReportSection):
    kind: Literal["acme_page"] = "acme_page"

    def section(self, summary, curves):
        end = summary["bias_rad_s"]["end"][0]
        return Section("Acme's page", f"First <1 & last>\\n\\n{len(curves['t'])} rows", f"<b>{end}</b>",
                       "<svg id='acme'></svg>")


class Torn(ReportSection):
    kind: Literal["acme_torn"] = "acme_torn"

    def section(self, summary, curves):
        curves["bias"][:] = 0


class Exiting(ReportSection):
    kind: Literal["acme_exiting"] = "acme_exiting"

    def section(self, summary, curves):
        summary["states"].clear()
        raise SystemExit("no printer")


class Bits(Exporter):
    kind: Literal["acme_bits"] = "acme_bits"
    bits: int = 8

    def export(self, what, path):
        if self.bits == 13:
            raise ArithmeticError("unlucky")
        if self.bits == 0:
            path.write_text("torn")
            return None
        (sensor,) = what.mapped
        path.write_text(f"{self.bits} bits of {sensor.fitted.record.kind}")
        lost = SensorLoss.measured(sensor, lambda T: sensor.fitted.bias(T) + 2.0**-self.bits)
        return Loss((lost,), ("the slope",))


@hookimpl
def families():
    return [Family("taps", Tap, "where something is taken")]


@hookimpl
def sources():
    return [TapSource]


@hookimpl
def report_sections():
    return [Page, Torn, Exiting]


@hookimpl
def exporters():
    return [Bits]


@hookimpl
def products():
    return {"acme_x1": Path(__file__).with_name("acme_x1.yaml")}
'''

PRODUCT = """extends: mems_crs05
filter:
  align: 10 s
  gyro: {bias: {walk: 7e-4 deg/s/sqrt(s)}}
"""

# of the family that the one above adds; its distribution is loaded first
TAPS = """
from typing import ClassVar, Literal

from fusion_core.hookspecs import hookimpl


def family():
    from acme_whole import Tap

    class Noise(Tap):
        contract: ClassVar[int] = 2
        kind: Literal["noise"] = "noise"

        def take(self, x):
            import numpy as np

            x = x + np.random.default_rng(0).normal(size=x.shape) * 1e-5
            return x

    class Leak(Tap):
        contract: ClassVar[int] = 2
        kind: Literal["leak"] = "leak"

        def take(self, x):
            x[:] = 1

    class Old(Tap):
        kind: Literal["old"] = "old"

        def take(self, x):
            return x

    return [Noise, Leak, Old]


@hookimpl
def taps():
    return family()
"""
