"""Files of loggers that were once read wrongly, or refused without the reason: twelve more, as in `logger_files`."""

from __future__ import annotations

import numpy as np
from logger_files import ALL, DEG, HELD, G, cells, logger_file, stamps, text, xyz

INERTIAL = [*xyz("g?_dps"), *xyz("a?_g"), "temp_C"]


@logger_file("graphtec.csv", "Graphtec GL840 User's Manual, CSV: a sign in a place of its own, a line of units",
             rate=0.1, found=HELD)  # fmt: skip
def _(u):
    before = ["Vendor,GRAPHTEC Corporation", "Model,GL840-M", "Version,Ver1.40", "Sampling interval,10s",
              "Start time,2026-03-05,14:22:01", "AMP settings", "CH,Signal name,Input,Range,Filter,Span",
              "CH1,case,TEMP,TC_K,Off,,+500.0,-100.0,degC,ms", "CH2,out,DC,5V,Off,,+5.0000,-5.0000,V,ms",
              "Logic/Pulse,Off", "Data"]  # fmt: skip
    head = ["Number", "Date&Time", "ms", "CH1", "CH2", "Alarm1-10"]
    times, volts = stamps(u, "%Y/%m/%d %H:%M:%S", 0), 5 + 1e-3 * u.gyro[:, 0]
    rows = [[str(k), t, "0", f"+{T:10.3f}", f"+{v:9.6f}", "LLLLLLLLLL"]
            for k, (t, T, v) in enumerate(zip(times, u.temperature, volts, strict=True), 1)]  # fmt: skip
    return text(head, rows, before=before, units=["NO.,Time,ms,degC,V,A1234567890"], eol="\r\n")


@logger_file("picolog.csv", "Pico Technology PicoLog 6, CSV export: dates with a zone, and no name above them",
             rate=0.1, found=HELD)  # fmt: skip
def _(u):
    head = ["", "TC-08 case Ave. (°C)", "ADC-24 supply Ave. (V)"]
    times = stamps(u, "%Y-%m-%dT%H:%M:%S+01:00", 0)
    return text(head, cells(times, u.temperature, 5 + 1e-4 * u.gyro[:, 0], form="%.10g"))


@logger_file("pipes.txt", "a shell script's log: | between cells, Greek letters, K", found=ALL)
def _(u):
    head = ["t [s]", *xyz("ω? [rad/s]"), *xyz("f? [m/s^2]"), "T [K]"]
    return text(head, cells(u.t, u.gyro, u.accel, u.temperature + 273.15), "|")


@logger_file("lsb_in_head.csv", "InvenSense MPU-6050 Product Specification 3.4, 6.1: LSB/(deg/s) and LSB/g",
             found={"time": 1e-3, "gyro": 0.004 * DEG, "accel": 4e-4, "temperature": 2e-2})  # fmt: skip
def _(u):
    head = ["Time [s]", *xyz("Gyro ! [131 LSB/(deg/s)]"), *xyz("Accel ! [16384 LSB/g]"), "Temp [degC]"]
    return text(head, cells(u.t, np.rint(u.gyro / DEG * 131), np.rint(u.accel / G * 16384), u.temperature))


@logger_file("lsb.csv", "Bosch BMI160 data sheet: counts by the names, whose size no name states",
             asks="the unit of gyro (raw counts, by the name")  # fmt: skip
def _(u):
    head = ["t_ms", *xyz("gyr_?_lsb"), *xyz("acc_?_lsb"), "temp_lsb"]
    counts = [np.rint(u.gyro / DEG * 16.4), np.rint(u.accel / G * 16384), np.rint((u.temperature - 23) * 512)]
    return text(head, cells(1e3 * u.t, *counts))


@logger_file("whole.csv", "a microcontroller's log: counts, and no word of it", asks="in whole numbers: raw counts?")
def _(u):
    counts = [np.rint(u.gyro / DEG * 16.4), np.rint(u.accel / G * 16384)]
    return text(["t_s", *xyz("g?"), *xyz("a?"), "temp"], cells(u.t, *counts, u.temperature))


@logger_file("thousands.csv", "Excel, English locale: commas between thousands, in quotes",
             asks="column 'Gyro X (deg/h)': '1,013.9308' is not a number")  # fmt: skip
def _(u):
    head = ["Time (ms)", *xyz("Gyro ! (deg/h)"), *xyz("Accel ! (mg)"), "Temp (C)"]
    values = np.column_stack([1e3 * u.t, u.gyro / DEG * 3600, 1e3 * u.accel / G, u.temperature]).tolist()
    return text(head, [[f'"{v:,.4f}"' if abs(v) >= 1000 else f"{v:.4f}" for v in row] for row in values])


@logger_file("head_again.csv", "a logger that was switched off and on: its line of names once more", found=ALL)
def _(u):
    lines = text(["t_s", *INERTIAL], cells(u.t, u.gyro / DEG, u.accel / G, u.temperature)).splitlines()
    return "\n".join([*lines[:301], lines[0], *lines[301:]]) + "\n"


@logger_file("whole_seconds.csv", "Excel, German locale: dates to the second, of 50 rows each",
             asks="'Datum + Uhrzeit' stays the same over some 50 rows")  # fmt: skip
def _(u):
    head = ["Datum", "Uhrzeit", *xyz("Drehrate ! [°/s]"), "Temperatur [°C]"]
    values = [[cell.replace(".", ",") for cell in row] for row in cells(u.gyro / DEG, u.temperature)]
    days, times = stamps(u, "%d.%m.%Y", 0), stamps(u, "%H:%M:%S", 0)
    return text(head, [[d, t, *row] for d, t, row in zip(days, times, values, strict=True)], ";", eol="\r\n")


@logger_file("serial_monitor.txt", "Arduino IDE 1.8 serial monitor, 'Show timestamp': a moment and -> before each line",
             asks="'14:22:01.000 -> 0.281647443' is not a number")  # fmt: skip
def _(u):
    lines = text(INERTIAL, cells(u.gyro / DEG, u.accel / G, u.temperature), "\t").splitlines()
    return "".join(
        f"{t} -> {line}\n" for t, line in zip(["14:22:00.990", *stamps(u, "%H:%M:%S{f}")], lines, strict=True)
    )


@logger_file(
    "serial_plotter.txt", "Arduino IDE serial plotter: NAME:VALUE in each cell", refused="'ms:20' is not a number"
)
def _(u):
    rows = cells(1e3 * u.t, u.gyro / DEG, u.accel / G, u.temperature)
    return text(None, [[f"{n}:{c}" for n, c in zip(["ms", *INERTIAL], row, strict=True)] for row in rows])


@logger_file("flukeview.csv", "Fluke FlukeView Forms, CSV export: a value and its unit in a cell", rate=0.1,
             refused="(no numbers in Sample, Supply)")  # fmt: skip
def _(u):
    times, volts = stamps(u, "%m/%d/%Y %H:%M:%S", 0), 5 + 1e-4 * u.gyro[:, 0]
    rows = [[str(k), t, f"{T:.3f} °C", f"{v:.8f} V DC"]
            for k, (t, T, v) in enumerate(zip(times, u.temperature, volts, strict=True), 1)]  # fmt: skip
    return text(["Reading", "Start Time", "Sample", "Supply"], rows, eol="\r\n")
