"""Sixty files as loggers, vendors' tools and people write them, of one simulated unit at rest that warms up.

Each is made after the description that it names: of heads, separators, decimal signs, preambles, units and time stamps.
The values are the same in all, to the digits that the tool prints, so that a reader is judged by what it reads.
"""

from __future__ import annotations

import gzip
import io
import json
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
from dataflash_writer import write_log
from scipy.io import savemat
from ulog_writer import sensor, write_ulog

ROWS, RATE = 600, 50.0
BEGIN = datetime(2026, 3, 5, 14, 22, 1)
G = 9.80665
DEG = np.pi / 180


class Truth:
    """The unit in SI: `t` (N,) s, `gyro` (N, 3) rad/s, `accel` (N, 3) m/s^2, `temperature` (N,) degC."""

    def __init__(self, rate: float = RATE) -> None:
        rng = np.random.default_rng(5)
        self.t = np.arange(ROWS) / rate
        self.gyro = DEG * ([0.31, -0.22, 0.08] + 0.005 * np.sqrt(RATE) * rng.standard_normal((ROWS, 3)))
        self.accel = [0.11, -0.23, 9.79] + 1.5e-3 * np.sqrt(RATE) * rng.standard_normal((ROWS, 3))
        self.temperature = 22 + 2 * (1 - np.exp(-np.arange(ROWS) / 800)) + 0.02 * rng.standard_normal(ROWS)


@cache
def truth(rate: float = RATE) -> Truth:
    """Return the unit at a sampling rate, or at steps of 10 s for a data logger."""
    return Truth(rate)


@dataclass(frozen=True)
class LoggerFile:
    """A file, the description that it follows, and what `init` must make of it.

    Attributes
    ----------
    name, source : str
        Of the file, and the description that it is written after.
    write : function of a path
        Makes it.
    given : dict
        Options of `init`.
    found : dict of str to float
        Channels whose values must be those of the unit, to a tolerance in SI.
    rate : float
        Of its rows, Hz.
    asks, refused : str
        Pattern of what must be asked or said to be wrong, or of the message that refuses it; empty where nothing is.
    """

    name: str
    source: str
    write: Callable[[Path], None]
    given: dict[str, Any] = field(default_factory=dict)
    found: dict[str, float] = field(default_factory=dict)
    rate: float = RATE
    asks: str = ""
    refused: str = ""


ALL = {"time": 1e-3, "gyro": 1e-6, "accel": 1e-4, "temperature": 2e-2}
INERTIAL = {name: ALL[name] for name in ("time", "gyro", "accel")}
NO_TIME = {name: ALL[name] for name in ("gyro", "accel", "temperature")}
FILES: list[LoggerFile] = []


def logger_file(name: str, source: str, **rest: Any) -> Callable[[Callable[[Truth], Any]], None]:
    """Register a file by the function that returns its text, its bytes, or None after it has written the path."""

    def register(make: Callable[..., Any]) -> None:
        def write(path: Path) -> None:
            content = make(truth(rest.get("rate", RATE)))
            if callable(content):
                content(path)
            else:
                path.write_bytes(content if isinstance(content, bytes) else content.encode())

        FILES.append(LoggerFile(name, source, write, **rest))

    return register


def cells(*columns: Any, form: str = "%.9g") -> list[list[str]]:
    """Return rows of texts: of columns of numbers (N,) or (N, d), or of texts."""
    parts = []
    for column in columns:
        array = np.asarray(column)
        array = array[:, None] if array.ndim == 1 else array
        parts.append([[v if isinstance(v, str) else form % v for v in row] for row in array.tolist()])
    return [[cell for part in row for cell in part] for row in zip(*parts, strict=True)]


def text(
    head: Sequence[str] | None, rows: list[list[str]], sep: str = ",", eol: str = "\n", decimal: str = ".",
    before: Sequence[str] = (), units: Sequence[str] = (), end: str = "",
) -> str:  # fmt: skip
    """Return a file of lines: some before the head, the head, some of units, and rows with `end` behind each."""
    lines = [*before, *([sep.join(head)] if head else []), *units]
    lines += [sep.join(cell.replace(".", decimal) if decimal != "." else cell for cell in row) + end for row in rows]
    return eol.join(lines) + eol


def stamps(unit: Truth, form: str, digits: int = 3, mark: str = ".") -> list[str]:
    """Return times as dates; `{f}` in `form` stands for the fraction of a second."""
    out = []
    for t in unit.t:
        when = BEGIN + timedelta(milliseconds=round(1000 * float(t)))
        fraction = mark + f"{when.microsecond:06d}"[:digits] if digits else ""
        out.append(when.strftime(form).replace("{f}", fraction))
    return out


def xyz(form: str) -> list[str]:
    """Return three names, with x, y, z for `?` and X, Y, Z for `!`."""
    return [form.replace("?", a).replace("!", a.upper()) for a in "xyz"]


def quoted(names: Sequence[str]) -> list[str]:
    """Return texts in double quotes."""
    return [f'"{name}"' for name in names]


def xlsx(sheets: dict[str, list[list[Any]]]) -> bytes:
    """Return a workbook as ECMA-376 has it: texts shared, a datetime as a serial number in a style of dates."""
    shared: dict[str, int] = {}

    def cell(value: Any, row: int, column: int) -> str:
        name = f"{chr(65 + column)}{row}"
        if isinstance(value, str):
            return f'<c r="{name}" t="s"><v>{shared.setdefault(value, len(shared))}</v></c>'
        if isinstance(value, datetime):
            return f'<c r="{name}" s="1"><v>{(value - datetime(1899, 12, 30)) / timedelta(days=1):.12f}</v></c>'
        return "" if value is None else f'<c r="{name}"><v>{value!r}</v></c>'

    main = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
    office = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    package = "http://schemas.openxmlformats.org/package/2006"
    types = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = {}
    for k, rows in enumerate(sheets.values(), 1):
        lines = [
            f'<row r="{r}">{"".join(cell(value, r, c) for c, value in enumerate(row))}</row>'
            for r, row in enumerate(rows, 1)
        ]
        parts[f"xl/worksheets/sheet{k}.xml"] = (
            f'<worksheet xmlns="{main}"><sheetData>{"".join(lines)}</sheetData></worksheet>'
        )
    names = "".join(f'<sheet name="{escape(n)}" sheetId="{k}" r:id="rId{k}"/>' for k, n in enumerate(sheets, 1))
    parts["xl/workbook.xml"] = f'<workbook xmlns="{main}" xmlns:r="{office}"><sheets>{names}</sheets></workbook>'
    links = [f'<Relationship Id="rId{k}" Type="{office}/worksheet" Target="worksheets/sheet{k}.xml"/>'
             for k in range(1, len(sheets) + 1)]  # fmt: skip
    links += [f'<Relationship Id="r{name}" Type="{office}/{name}" Target="{name}.xml"/>'
              for name in ("sharedStrings", "styles")]  # fmt: skip
    parts["xl/_rels/workbook.xml.rels"] = (
        f'<Relationships xmlns="{package}/relationships">{"".join(links)}</Relationships>'
    )
    parts["xl/styles.xml"] = (
        f'<styleSheet xmlns="{main}"><numFmts count="1"><numFmt numFmtId="164" formatCode="dd.mm.yyyy hh:mm:ss.000"/>'
        '</numFmts><cellXfs count="2"><xf numFmtId="0"/><xf numFmtId="164" applyNumberFormat="1"/></cellXfs>'
        "</styleSheet>"
    )
    items = "".join(f"<si><t>{escape(value)}</t></si>" for value in shared)
    parts["xl/sharedStrings.xml"] = f'<sst xmlns="{main}" uniqueCount="{len(shared)}">{items}</sst>'
    parts["_rels/.rels"] = (
        f'<Relationships xmlns="{package}/relationships"><Relationship Id="rId1" Type="{office}/officeDocument" '
        'Target="xl/workbook.xml"/></Relationships>'
    )
    sheet_types = "".join(
        f'<Override PartName="/xl/worksheets/sheet{k}.xml" ContentType="{types}.worksheet+xml"/>'
        for k in range(1, len(sheets) + 1)
    )
    parts["[Content_Types].xml"] = (
        f'<Types xmlns="{package}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/><Override '
        f'PartName="/xl/workbook.xml" ContentType="{types}.sheet.main+xml"/>{sheet_types}</Types>'
    )
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in parts.items():
            archive.writestr(name, '<?xml version="1.0" encoding="UTF-8"?>' + content)
    return buffer.getvalue()


def numbers(*columns: Any) -> list[list[Any]]:
    """Return rows of numbers, for a sheet."""
    return [
        [value for part in row for value in (part if isinstance(part, list) else [part])]
        for row in zip(*(c if isinstance(c, list) else np.asarray(c).tolist() for c in columns), strict=True)
    ]


# ---- tools of vendors of inertial units


@logger_file("mt_manager.txt", "Xsens MT Manager User Manual, 'ASCII exporter': tabs, lines of // first", found=ALL)
def _(u):
    before = ["// General information: ", "//  MT Manager version: 2022.2.0 ", "// Device information: ",
              "//  DeviceId: 03800B2F", "//  Firmware Version: 1.8.2", "// Coordinate system: ENU"]  # fmt: skip
    head = ["PacketCounter", "SampleTimeFine", *xyz("Acc_!"), *xyz("Gyr_!"), "Temperature"]
    ticks = np.rint(1e4 * u.t + 31_230_000)
    rows = cells(np.arange(ROWS) + 51400, ticks, u.accel, u.gyro, u.temperature, form="%.10g")
    return text(head, rows, "\t", before=before)


@logger_file("dot.csv", "Movella DOT app, 'CSV export': properties first, SampleTimeFine in us, deg/s", found=INERTIAL)
def _(u):
    before = ["DeviceTag:,Xsens DOT 1", "FirmwareVersion:,2.0.0", "AppVersion:,2021.0.0", "SyncStatus:,Unsynced",
              "OutputRate:,50Hz", "FilterProfile:,General", "Measurement Mode:,Rate quantities", ""]  # fmt: skip
    head = ["PacketCounter", "SampleTimeFine", *xyz("Acc_!"), *xyz("Gyr_!")]
    return text(head, cells(np.arange(ROWS), np.rint(1e6 * u.t + 7e8), u.accel, u.gyro / DEG), before=before)


@logger_file(
    "vectornav.csv", "VectorNav interface control document, IMU group: names of fields; ns since startup", found=ALL
)
def _(u):
    head = ["timeStartup", *xyz("uncompAccel!"), *xyz("uncompGyro!"), "temp", "pres"]
    rows = cells(np.rint(1e9 * u.t + 5e9), u.accel, u.gyro, u.temperature, np.full(ROWS, 101.3), form="%.12g")
    return text(head, rows, eol="\r\n")


@logger_file("icm_evb.csv", "TDK InvenSense MotionLink, log of an ICM-4xxxx board", found=ALL)
def _(u):
    head = ["Timestamp(us)", *xyz("Accel_!(g)"), *xyz("Gyro_!(dps)"), "Temp(C)"]
    return text(head, cells(1e6 * u.t, u.accel / G, u.gyro / DEG, u.temperature))


@logger_file("bmi270.txt", "Bosch Sensortec Development Desktop 2.0, 'Data log': tabs, units in brackets", found=ALL)
def _(u):
    head = ["Time[ms]", *xyz("Acc ?[mg]"), *xyz("Gyr ?[deg/s]"), "Temperature[degC]", ""]
    before = ["Bosch Sensortec Development Desktop", "Shuttle Board: BMI270", "ODR: 50Hz", ""]
    return text(head, cells(1e3 * u.t, 1e3 * u.accel / G, u.gyro / DEG, u.temperature), "\t", end="\t", before=before)


@logger_file("mems_studio.csv", "ST MEMS Studio User Manual UM3233, 'Save to file': mg and mdps", found=ALL)
def _(u):
    head = ["Timestamp [ms]", *xyz("A_! [mg]"), *xyz("G_! [mdps]"), "Temp [degC]"]
    return text(head, cells(1e3 * u.t, 1e3 * u.accel / G, 1e3 * u.gyro / DEG, u.temperature))


@logger_file("unicleo.csv", "ST Unicleo-GUI User Manual UM1859, 'Datalog': two lines of text, then names", found=ALL)
def _(u):
    before = ["Unicleo-GUI 1.9.0, Thu Mar 05 14:22:01 2026", "DataLogExtended, NUCLEO-F401RE"]
    head = ["Time [s]", "TEMP [C]", *xyz("ACC_! [mg]"), *xyz("GYR_! [dps]")]
    return text(head, cells(u.t, u.temperature, 1e3 * u.accel / G, u.gyro / DEG), before=before)


@logger_file("adis16470.csv", "Analog Devices FX3 evaluation GUI, register log: counts, no time",
             asks="the interval between rows", given={})  # fmt: skip
def _(u):
    head = [*xyz("!_GYRO_OUT"), *xyz("!_ACCL_OUT"), "TEMP_OUT", "DATA_CNTR"]
    rows = cells(u.gyro / DEG * 10, u.accel / G * 800, u.temperature * 10, np.arange(ROWS) % 65536, form="%.0f")
    return text(head, rows)


@logger_file("adis_told.csv", "Analog Devices FX3 evaluation GUI, with what the user knows", found={"accel": 0.02},
             given={"interval": "20 ms", "units": {"gyro": "0.1 deg/s", "temperature": "0.1 degC"}})  # fmt: skip
def _(u):
    head = [*xyz("!_GYRO_OUT"), *xyz("!_ACCL_OUT"), "TEMP_OUT", "DATA_CNTR"]
    rows = cells(u.gyro / DEG * 10, u.accel / G * 16384, u.temperature * 10, np.arange(ROWS) % 65536, form="%.0f")
    return text(head, rows)


@logger_file("sbg.txt", "SBG Systems sbgCenter, 'Export to ASCII': tabs, units in round brackets", found=ALL)
def _(u):
    head = ["Timestamp (us)", *xyz("Accelerometer ! (m.s-2)"), *xyz("Gyroscope ! (rad.s-1)"), "IMU Temperature (°C)"]
    return text(head, cells(1e6 * u.t, u.accel, u.gyro, u.temperature), "\t", eol="\r\n")


@logger_file("kvh1750.csv", "KVH 1750 IMU Technical Manual, demonstration software: blanks behind commas", found=ALL)
def _(u):
    head = ["Time (s)", *xyz("Rot ! (deg/s)"), *xyz("Acc ! (g)"), "Status", "Seq", "Temp (C)"]
    rows = cells(u.t, u.gyro / DEG, u.accel / G, np.full(ROWS, 119), np.arange(ROWS) % 128, u.temperature)
    return text(head, rows, ", ")


@logger_file("hguide.csv", "Honeywell HGuide Data Reader User Guide, 'CSV output': units in square brackets", found=ALL)
def _(u):
    head = ["System Time [s]", *xyz("Angular Rate ! [rad/s]"), *xyz("Linear Acceleration ! [m/s^2]"), "Temperature [C]"]
    return text(head, cells(u.t + 51.2, u.gyro, u.accel, u.temperature, form="%.10g"), before=["HGuide Data Reader"])


@logger_file("stim300.csv", "Sensonor STIM300 EVK PC tool, 'Export to file': semicolons, °/s", found=ALL)
def _(u):
    head = ["Time [s]", *xyz("Gyro ! [°/s]"), *xyz("Acc ! [g]"), "Temp Gyro X [°C]"]
    rows = text(head, cells(u.t, u.gyro / DEG, u.accel / G, u.temperature), ";", eol="\r\n")
    return rows.encode("latin-1")


@logger_file("sensor_connect.csv", "LORD MicroStrain SensorConnect, CSV export: fields in brackets, g and rad/s",
             found={name: ALL[name] for name in ("time", "gyro", "accel")})  # fmt: skip
def _(u):
    head = ["GPS TFlags", "GPS Week", "GPS TOW", *xyz("! Accel [x8004]"), *xyz("! Gyro [x8005]")]
    rows = cells(np.full(ROWS, 7), np.full(ROWS, 2408), u.t + 397321.02, u.accel / G, u.gyro, form="%.11g")
    return text(head, rows, before=["SENSOR_CONNECT 11.1", "DATA_START"])


@logger_file("epson.csv", "Epson esensorlib logger: comments of the device, mG, a counter in place of the time",
             found=NO_TIME, given={"interval": "20 ms"})  # fmt: skip
def _(u):
    head = ["Sample No.", "Ts[degC]", *xyz("G?[dps]"), *xyz("A?[mG]"), "Counter[dec]"]
    before = ["#Log Start,2026-03-05 14:22:01.000,,,", "#Output Rate,50,Filter Setting,TAP=32,",
              "#PROD_ID=G370PDF1,VERSION=1.09,SERIAL_NUM=00000042,"]  # fmt: skip
    rows = cells(np.arange(ROWS), u.temperature, u.gyro / DEG, 1e3 * u.accel / G, np.arange(ROWS) % 65536)
    return text(head, rows, before=before)


@logger_file("dmu30.csv", "Silicon Sensing DMU30 evaluation kit, log: the axis before the quantity", found=ALL)
def _(u):
    head = ["Time (s)", *xyz("! Rate (°/s)"), *xyz("! Acceleration (g)"), "Average IMU Temperature (°C)"]
    return text(head, cells(u.t, u.gyro / DEG, u.accel / G, u.temperature), eol="\r\n")


@logger_file("inertial_labs.txt", "Inertial Labs IMU GUI, 'Save as text': aligned by blanks", found=ALL)
def _(u):
    head = ["Time(s)", *xyz("Gyro!(deg/s)"), *xyz("Acc!(g)"), "Temp(C)"]
    rows = [[f"{cell:>16}" for cell in row] for row in cells(u.t, u.gyro / DEG, u.accel / G, u.temperature)]
    return text([f"{name:>16}" for name in head], rows, " ", before=["IMU_Demo output data", ""])


@logger_file("novatel.asc", "NovAtel OEM7 reference, RAWIMUSA: messages, not rows", refused="--column gyro=")
def _(u):
    return "".join(
        f"%RAWIMUSA,2408,{t:.3f};2408,{t:.9f},00000077,{a[2]:.0f},{-a[1]:.0f},{a[0]:.0f},{g[2]:.0f},{-g[1]:.0f},"
        f"{g[0]:.0f}*{k % 65536:08x}\r\n"
        for k, (t, a, g) in enumerate(zip(u.t, 1e6 * u.accel, 1e7 * u.gyro, strict=True))
    )


# ---- data acquisition


LVM = ["LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", "Separator\tTab", "Multi_Headings\tNo",
       "X_Columns\tOne", "Time_Pref\tRelative", "Operator\tbench", "Date\t2026/03/05", "Time\t14:22:01,02",
       "***End_of_Header***\t", "\t", "Channels\t7", "Samples\t600\t600\t600\t600\t600\t600\t600",
       "X_Dimension\tTime\tTime\tTime\tTime\tTime\tTime\tTime", "X0\t0\t0\t0\t0\t0\t0\t0",
       "Delta_X\t0,02\t0,02\t0,02\t0,02\t0,02\t0,02\t0,02", "***End_of_Header***\t\t\t\t\t\t\t"]  # fmt: skip
LVM_SOURCE = "NI, 'Specification for the LabVIEW Measurement File (.lvm)'"


@logger_file("comma.lvm", f"{LVM_SOURCE}: Decimal_Separator ','", found=ALL)
def _(u):
    head = ["X_Value", *xyz("Gyro ! (deg/s)"), *xyz("Accel ! (g)"), "Case temp (degC)", "Comment"]
    rows = cells(u.t, u.gyro / DEG, u.accel / G, u.temperature)
    return text(head, rows, "\t", eol="\r\n", decimal=",", before=[*LVM[:4], "Decimal_Separator\t,", *LVM[4:]])


@logger_file("point.lvm", f"{LVM_SOURCE}: no unit in the names", found=ALL)
def _(u):
    head = ["X_Value", *xyz("Gyro !"), *xyz("Accel !"), "Temp", "Comment"]
    before = [line.replace(",", ".") for line in [*LVM[:4], "Decimal_Separator\t.", *LVM[4:]]]
    return text(head, cells(u.t, u.gyro / DEG, u.accel / G, u.temperature), "\t", eol="\r\n", before=before)


@logger_file("tdms_export.txt", "NI TDMS Excel add-in, saved as text: group and channel, then units", found=ALL)
def _(u):
    head = ["Time", *xyz("Rate !"), *xyz("Acceleration !"), "Case temperature"]
    units = ["\t".join(["s", *3 * ["deg/s"], *3 * ["g"], "degC"])]
    rows = cells(u.t, u.gyro / DEG, u.accel / G, u.temperature)
    return text(head, rows, "\t", before=["Root Name\tsoak", "Group\tIMU", ""], units=units)


@logger_file("flexlogger.csv", "NI FlexLogger, CSV log: properties, blank line, names with units", found=ALL)
def _(u):
    head = ["Time (s)", *xyz("Rate ! (deg/s)"), *xyz("Accel ! (g)"), "Case temp (degF)"]
    before = ["Log file name,soak", "Start time,03/05/2026 2:22:01 PM", "Comment,", ""]
    return text(head, cells(u.t, u.gyro / DEG, u.accel / G, 32 + 1.8 * u.temperature), before=before, eol="\r\n")


@logger_file(
    "dewesoft.txt", "DewesoftX manual, 'Export to Text/CSV': a block of properties, names, a line of units", found=ALL
)
def _(u):
    head = ["Time", *xyz("Gyro_!"), *xyz("Acc_!"), "T_case"]
    units = ["\t".join(["(s)", *3 * ["(deg/s)"], *3 * ["(m/s2)"], "(°C)"]), ""]
    before = ["Data info", "File name: soak.dxd", "Start time: 3/5/2026 14:22:01.000", "Sample rate: 50", "", "Data1"]
    rows = cells(u.t, u.gyro / DEG, u.accel, u.temperature)
    return text(head, rows, "\t", before=before, units=units, eol="\r\n")


@logger_file(
    "gantner.csv", "Gantner Instruments GI.monitor, CSV export: semicolons, a line of units, decimal commas", found=ALL
)
def _(u):
    head = ["Zeit", *xyz("Drehrate !"), *xyz("Beschleunigung !"), "Temperatur"]
    units = [";".join(["s", *3 * ["°/s"], *3 * ["g"], "°C"])]
    rows = cells(u.t, u.gyro / DEG, u.accel / G, u.temperature)
    return text(head, rows, ";", decimal=",", units=units, eol="\r\n").encode("latin-1")


@logger_file("toa5.dat", "Campbell Scientific, 'TOA5 file format': four lines of head", found=ALL)
def _(u):
    head = quoted(["TIMESTAMP", "RECORD", *xyz("Gyro_!"), *xyz("Accel_!"), "Temp_C"])
    units = [",".join(quoted(["TS", "RN", *3 * ["deg/s"], *3 * ["g"], "Deg C"])),
             ",".join(quoted(["", "", *7 * ["Smp"]]))]  # fmt: skip
    before = ['"TOA5","CR1000X","CR1000X","1234","CR1000X.Std.05.02","CPU:soak.CR1X","51423","Table1"']
    times = quoted(stamps(u, "%Y-%m-%d %H:%M:%S{f}", 2))
    rows = cells(times, np.arange(ROWS), u.gyro / DEG, u.accel / G, u.temperature)
    return text(head, rows, before=before, units=units, eol="\r\n")


HELD = {"time": 1.0, "temperature": 2e-2}


@logger_file("benchlink.csv", "Keysight BenchLink Data Logger 3, 'Export': UTF-16, colon before ms, alarms between",
             rate=0.1, found=HELD)  # fmt: skip
def _(u):
    before = ["Name:,soak,", "Owner:,bench,", "Comments:,,", "Acquisition Date:,3/5/2026 14:22:01,", "",
              "Instrument:,34970A,Address:,GPIB0::9::INSTR", "", "Scan Control:,,"]  # fmt: skip
    head = ["Scan", "Time", "101 (VDC)", "Alarm 101", "102 (C)", "Alarm 102"]
    times = stamps(u, "%m/%d/%Y %H:%M:%S{f}", 3, ":")
    volts, alarm = 5 + 1e-5 * u.gyro[:, 0], np.zeros(ROWS)
    rows = cells(np.arange(1, ROWS + 1), times, volts, alarm, u.temperature, alarm, form="%.12g")
    return text(head, rows, before=before, eol="\r\n").encode("utf-16")


@logger_file(
    "fluke2638.csv", "Fluke 2638A Hydra, scan file: date and time in a cell, status last", rate=0.1, found=HELD
)
def _(u):
    before = ["Model,2638A", "Serial Number,1234567", "Scan Interval,00:00:10", ""]
    head = ["Scan", "Time", "101 (OHM)", "102 (C)", "Alarm Status", "Totalizer"]
    times = stamps(u, "%m/%d/%y %H:%M:%S", 0)
    rows = cells(np.arange(ROWS), times, 1e4 + u.gyro[:, 0], u.temperature, ["OK"] * ROWS, np.zeros(ROWS), form="%.12g")
    return text(head, rows, before=before, eol="\r\n")


@logger_file("hobo.csv", "Onset HOBOware User's Guide, 'Exporting': a title, units and serial numbers in the head",
             rate=0.1, found=HELD)  # fmt: skip
def _(u):
    head = ['"#"', '"Date Time, GMT-05:00"', '"Temp, °C (LGR S/N: 10301234, SEN S/N: 10301234, LBL: case)"',
            '"Volt, V (LGR S/N: 10301234, SEN S/N: 10301234)"', '"Host Connected (LGR S/N: 10301234)"',
            '"End Of File (LGR S/N: 10301234)"']  # fmt: skip
    times = stamps(u, "%m/%d/%y %I:%M:%S %p", 0)
    empty = [""] * ROWS
    rows = cells(np.arange(1, ROWS + 1), times, u.temperature, 5 + 1e-5 * u.gyro[:, 0], empty, empty)
    return "﻿" + text(head, [*rows, [str(ROWS + 1), times[-1], "", "", "Logged", "Logged"]],
                           before=['"Plot Title: soak"'], eol="\r\n")  # fmt: skip


@logger_file("omega.txt", "Omega OM-CP software, text export: date and time apart; thermometers alone", rate=0.1,
             refused="gyro")  # fmt: skip
def _(u):
    rows = cells(stamps(u, "%m/%d/%Y", 0), stamps(u, "%H:%M:%S", 0), u.temperature, u.temperature + 0.3)
    return text(["Date", "Time", "CH1 Temperature (°C)", "CH2 Temperature (°C)"], rows, "\t", eol="\r\n")


@logger_file(
    "date_and_time.csv", "Yokogawa GA10 and DAQStandard, text conversion: date and time in two columns", found=ALL
)
def _(u):
    head = ["Date", "Time", *xyz("Rate ! [deg/s]"), *xyz("Acc ! [g]"), "Temp [°C]"]
    days, times = stamps(u, "%Y/%m/%d", 0), stamps(u, "%H:%M:%S{f}")
    return text(head, cells(days, times, u.gyro / DEG, u.accel / G, u.temperature), eol="\r\n")


# ---- telephones


PHYPHOX = "phyphox wiki, 'Exporting data': names with units, three separators"


@logger_file("phyphox.csv", PHYPHOX, found=INERTIAL)
def _(u):
    head = quoted(["Time (s)", *xyz("Gyroscope ? (rad/s)"), *xyz("Acceleration ? (m/s^2)")])
    return text(head, cells(u.t, u.gyro, u.accel, form="%.9E"))


@logger_file("phyphox_comma.csv", PHYPHOX, found=INERTIAL)
def _(u):
    head = quoted(["Time (s)", *xyz("Gyroscope ? (rad/s)"), *xyz("Acceleration ? (m/s^2)")])
    return text(head, cells(u.t, u.gyro, u.accel, form="%.9E"), ";", decimal=",")


@logger_file("phyphox.xlsx", PHYPHOX + "; a workbook with a sheet of the device behind", found=INERTIAL)
def _(u):
    head = ["Time (s)", *xyz("Gyroscope ? (rad/s)"), *xyz("Acceleration ? (m/s^2)")]
    return xlsx({"Raw Data": [head, *numbers(u.t, u.gyro, u.accel)], "Metadata Device": [["property", "value"]]})


@logger_file("Gyroscope.csv", "Sensor Logger (K. Choi), CSV: names x, y, z alone",
             given={"columns": {"gyro": "x,y,z"}}, found={"time": 1e-3, "gyro": 1e-6})  # fmt: skip
def _(u):
    nanoseconds = [str(1772720521000000000 + round(1e9 * t)) for t in u.t]
    return text(["time", "seconds_elapsed", "z", "y", "x"], cells(nanoseconds, u.t, u.gyro[:, ::-1]))


@logger_file("xyz_untold.csv", "Sensor Logger (K. Choi), CSV: names x, y, z alone", refused="--column gyro=")
def _(u):
    return text(["time", "seconds_elapsed", "z", "y", "x"], cells(1e9 * u.t, u.t, u.gyro[:, ::-1]))


@logger_file("physics_toolbox.csv", "Vieyra Physics Toolbox Sensor Suite, CSV: time, gFx, wx", found=INERTIAL)
def _(u):
    return text(["time", *xyz("gF?"), *xyz("w?"), ""], cells(u.t, u.accel / G, u.gyro), end=",")


# ---- programs


@logger_file("writetable.csv", "MATLAB writetable: a variable of three columns becomes _1, _2, _3", found=ALL)
def _(u):
    head = ["Time", *(f"Gyro_{k}" for k in (1, 2, 3)), *(f"Accel_{k}" for k in (1, 2, 3)), "Temp"]
    return text(head, cells(u.t, u.gyro, u.accel, u.temperature))


@logger_file("writetimetable.csv", "MATLAB writetimetable: durations as '0.02 sec'", found=ALL)
def _(u):
    head = ["Time", *(f"Gyro_{k}" for k in (1, 2, 3)), *(f"Accel_{k}" for k in (1, 2, 3)), "Temp"]
    return text(head, cells([f"{t:.6g} sec" for t in u.t], u.gyro, u.accel, u.temperature))


@logger_file("pandas.csv", "pandas to_csv: a nameless index first", found=ALL)
def _(u):
    head = ["", "t", *xyz("g?"), *xyz("a?"), "temp"]
    return text(head, cells(np.arange(ROWS), u.t, u.gyro, u.accel, u.temperature))


@logger_file("pandas_dates.csv", "pandas to_csv of a DatetimeIndex with a time zone", found=ALL)
def _(u):
    head = ["timestamp", *xyz("gyro_?"), *xyz("accel_?"), "temperature"]
    times = stamps(u, "%Y-%m-%d %H:%M:%S{f}+00:00", 6)
    return text(head, cells(times, u.gyro, u.accel, u.temperature))


@logger_file("iso.csv", "RFC 3339 time stamps, as InfluxDB and Grafana export them; all quoted", found=ALL)
def _(u):
    head = quoted(["_time", *xyz("gyro_?"), *xyz("accel_?"), "temperature"])
    rows = cells(stamps(u, "%Y-%m-%dT%H:%M:%S{f}Z"), u.gyro, u.accel, u.temperature)
    return text(head, [quoted(row) for row in rows])


@logger_file("savetxt.txt", "numpy savetxt with header=: a head behind #, blanks between", found=ALL)
def _(u):
    head = ["# t", *xyz("g?"), *xyz("a?"), "temp"]
    return text(head, cells(u.t, u.gyro, u.accel, u.temperature, form="%.18e"), " ")


@logger_file(
    "excel_german.csv", "Excel, German locale, 'CSV (Trennzeichen-getrennt)': semicolons, commas, cp1252", found=ALL
)
def _(u):
    head = ["Datum", *xyz("Drehrate ! [°/s]"), *xyz("Beschl. ! [m/s²]"), "Temperatur [°C]"]
    rows = cells(u.gyro / DEG, u.accel, u.temperature)
    times = stamps(u, "%d.%m.%Y %H:%M:%S{f}", 3, ",")
    lines = [[time, *(cell.replace(".", ",") for cell in row)] for time, row in zip(times, rows, strict=True)]
    return text(head, lines, ";", eol="\r\n").encode("cp1252")


@logger_file(
    "excel_german.xlsx", "Excel, German locale: the same as a workbook, with dates as serial numbers", found=ALL
)
def _(u):
    head = ["Datum", *xyz("Drehrate ! [°/s]"), *xyz("Beschl. ! [m/s²]"), "Temperatur [°C]"]
    times = [BEGIN + timedelta(milliseconds=round(1000 * float(t))) for t in u.t]
    return xlsx({"Tabelle1": [head, *numbers(times, u.gyro / DEG, u.accel, u.temperature)]})


@logger_file("excel_units.xlsx", "Excel: a title, a line of names, a line of units, on the second sheet", found=ALL)
def _(u):
    head = ["Elapsed", *xyz("Rate !"), *xyz("Accel !"), "Case temp"]
    rows = [["Soak of unit 7"], [], head, ["s", *3 * ["deg/s"], *3 * ["g"], "degF"]]
    rows += numbers(u.t, u.gyro / DEG, u.accel / G, 32 + 1.8 * u.temperature)
    return xlsx({"Notes": [["by the night shift"]], "Data": rows})


@logger_file("excel_unicode.txt", "Excel, 'Unicode text': UTF-16 and tabs", found=ALL)
def _(u):
    head = ["Elapsed (s)", *xyz("Rate ! (deg/s)"), *xyz("Accel ! (g)"), "Case temp (°C)"]
    return text(head, cells(u.t, u.gyro / DEG, u.accel / G, u.temperature), "\t", eol="\r\n").encode("utf-16")


# ---- microcontrollers and vehicles


@logger_file("arduino.txt", "Arduino Serial.print by commas: numbers without a head",
             given={"columns": {"time": "1", "gyro": "2,3,4", "accel": "5,6,7", "temperature": "8"}},
             found=ALL)  # fmt: skip
def _(u):
    return text(None, cells(1e3 * u.t, u.gyro, u.accel, u.temperature), eol="\r\n")


@logger_file("arduino_untold.txt", "Arduino Serial.print by commas: numbers without a head", refused="--column gyro=")
def _(u):
    return text(None, cells(1e3 * u.t, u.gyro, u.accel, u.temperature), eol="\r\n")


@logger_file("putty.log", "PuTTY session log of a serial port: its own line first", found=ALL)
def _(u):
    before = ["=~=~=~=~=~=~=~=~=~=~=~= PuTTY log 2026.03.05 14:22:01 =~=~=~=~=~=~=~=~=~=~=~="]
    head = ["millis", *xyz("gyro!"), *xyz("accel!"), "tempC"]
    return text(head, cells(1e3 * u.t, u.gyro, u.accel, u.temperature), before=before, eol="\r\n")


@logger_file("teensy.csv", "Teensy SD log: a comma behind each row and none behind the head", found=ALL)
def _(u):
    head = ["micros", *xyz("g?_dps"), *xyz("a?_g"), "temp"]
    return text(head, cells(1e6 * u.t, u.gyro / DEG, u.accel / G, u.temperature), end=",", eol="\r\n")


@logger_file("rostopic.csv", "ROS wiki, rostopic echo -p: %time and field. before each name", found=INERTIAL)
def _(u):
    covariance = [f"field.angular_velocity_covariance{k}" for k in range(9)]
    head = ["%time", "field.header.seq", "field.header.stamp", "field.header.frame_id",
            *(f"field.orientation.{a}" for a in "xyzw"), *xyz("field.angular_velocity.?"), *covariance,
            *xyz("field.linear_acceleration.?")]  # fmt: skip
    ns = [str(1772720521000000000 + round(1e9 * t)) for t in u.t]
    rest = np.tile([0.0, 0, 0, 1], (ROWS, 1))
    return text(head, cells(ns, np.arange(ROWS), ns, ["imu_link"] * ROWS, rest, u.gyro, np.zeros((ROWS, 9)), u.accel))


@logger_file("bagpy.csv", "bagpy message_by_topic: names of the message, seconds since 1970", found=INERTIAL)
def _(u):
    head = ["Time", "header.seq", "header.stamp.secs", "header.stamp.nsecs", "header.frame_id",
            *xyz("angular_velocity.?"), *xyz("linear_acceleration.?")]  # fmt: skip
    seconds = np.floor(u.t)
    rows = cells([f"{1772720521 + t:.6f}" for t in u.t], np.arange(ROWS), seconds + 1772720521, 1e9 * (u.t - seconds),
                 ["imu"] * ROWS, u.gyro, u.accel, form="%.10g")  # fmt: skip
    return text(head, rows)


@logger_file("euroc.csv", "EuRoC MAV data set, imu0/data.csv: a head behind #, units in brackets", found=INERTIAL)
def _(u):
    head = ["#timestamp [ns]", *xyz("w_RS_S_? [rad s^-1]"), *xyz("a_RS_S_? [m s^-2]")]
    return text(head, cells([str(1403636579758555392 + round(1e9 * t)) for t in u.t], u.gyro, u.accel), eol="\r\n")


@logger_file("blackbox.csv", "Betaflight blackbox-tools, blackbox_decode: blanks behind commas, counts of 1/2048 g",
             found={"time": 1e-3, "gyro": 1e-6, "accel": 0.02})  # fmt: skip
def _(u):
    head = ["loopIteration", "time (us)", *(f"axisP[{k}]" for k in range(3)),
            *(f"gyroADC[{k}] (deg/s)" for k in range(3)), *(f"accSmooth[{k}]" for k in range(3)),
            "vbatLatest (V)"]  # fmt: skip
    rows = cells(np.arange(ROWS), 1e6 * u.t + 2e6, np.zeros((ROWS, 3)), u.gyro / DEG, np.rint(u.accel / G * 2048),
                 np.full(ROWS, 16.2), form="%.10g")  # fmt: skip
    return text(head, rows, ", ")


@logger_file("explorer.csv", "Betaflight Blackbox Explorer, CSV export: properties in quotes before the names",
             found={"time": 1e-3, "gyro": 1e-6}, given={"units": {"gyro": "deg/s"}})  # fmt: skip
def _(u):
    before = ['"Product","Blackbox flight data recorder by Nicholas Sherlock"', '"Data version",2', '"gyro_scale",1.0',
              '"rollPID","42,85,35"']  # fmt: skip
    head = quoted(["loopIteration", "time", *(f"gyroADC[{k}]" for k in range(3)), *(f"motor[{k}]" for k in range(4))])
    rows = cells(np.arange(ROWS), 1e6 * u.t + 2e6, u.gyro / DEG, np.zeros((ROWS, 4)), form="%.10g")
    return text(head, rows, before=before)


# ---- archives, and what is no recording


def _packed(write: Callable[[Path], None]) -> Callable[[Path], None]:
    def packed(path: Path) -> None:
        plain = path.with_suffix("")
        write(plain)
        path.write_bytes(gzip.compress(plain.read_bytes(), 1))
        plain.unlink()

    return packed


LOG = {"time": 1e-3, "gyro": 1e-6, "temperature": 2e-2}


@logger_file("soak.ulg.gz", "PX4 ULog file format, packed", found=LOG)
def _(u):
    topics = [sensor("sensor_gyro", 0, u.t + 1, u.gyro, u.temperature, 1310988)]
    topics += [sensor("sensor_accel", 0, u.t + 1, u.accel, u.temperature, 1310988)]
    return _packed(lambda path: write_ulog(path, topics))


@logger_file("soak.bin.gz", "ArduPilot DataFlash log, packed", found=LOG)
def _(u):
    return _packed(lambda path: write_log(path, u.t + 1, [(u.gyro, u.accel, u.temperature)]))


@logger_file("soak.mat.gz", "MAT-file format of version 5, packed", found=ALL)
def _(u):
    imu = {"t": u.t[:, None], "gyro": u.gyro, "acc": u.accel, "temp": u.temperature[:, None]}
    return _packed(lambda path: savemat(path, {"imu": imu}, appendmat=False))


@logger_file("header_alone.csv", "a logger that was stopped at once", refused="no rows")
def _(u):
    return text(["t", *xyz("g?"), "temp"], [])


@logger_file("lines.jsonl", "JSON lines, as MQTT recorders write them", refused="JSON")
def _(u):
    return "".join(json.dumps({"t": t, "gyro": g, "temp": T}) + "\n"
                   for t, g, T in zip(u.t, u.gyro.tolist(), u.temperature, strict=True))  # fmt: skip


def read_back(file: LoggerFile, folder: Path) -> str:
    """Return what is wrong with what `init` makes of a file, empty where nothing is."""
    from driftlab.commands.init import init
    from driftlab.config import load_config
    from fusion_core.chunk import concatenate
    from fusion_core.errors import FusionError
    from fusion_core.faults import Faults

    path, unit = folder / file.name, truth(file.rate)
    file.write(path)
    try:
        done = init(path, out=folder / "unit.yaml", **file.given)
    except FusionError as error:
        return "" if file.refused and matches(file.refused, str(error)) else f"refused: {error}"
    if file.refused:
        return f"is not refused, asks {done.asked}"
    if file.asks:
        said = (*done.asked, *done.problems)
        return "" if any(matches(file.asks, text) for text in said) else f"asks {said}"
    try:
        got = concatenate(list(load_config(folder / "unit.yaml").source.chunks(100_000, Faults())))
    except FusionError as error:
        return f"the config does not run: {error}"
    for name, tolerance in file.found.items():
        is_time = name == "time"
        values = got.t - got.t[0] if is_time else got.channels.get(name)
        if values is None:
            return f"{name} is not found"
        expected = unit.t if is_time else getattr(unit, name)
        values = values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]
        if len(values) < len(expected):
            return f"{name}: {len(values)} rows"
        error = float(np.max(np.abs(values[: len(expected)].reshape(len(expected), -1) - expected.reshape(ROWS, -1))))
        if not error <= tolerance:
            return f"{name} is wrong by {error:.3g}"
    return ""


def matches(pattern: str, words: str) -> bool:
    """Tell whether one of the alternatives of a pattern stands in a text."""
    return any(part in words for part in pattern.split("|"))
