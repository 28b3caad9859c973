"""A zoo of strangers' files: every one is read right, or refused with its true cause.

The heads follow the public manuals and export formats of the recorders that they are named for; the
samples are ours, a component in a smooth motion at 200 Hz. Nothing may be read wrong in silence.
"""

import gzip
import json
import pickle
from collections.abc import Callable, Iterable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.errors import InputError
from table_io.formats import read_table
from twin.exchange.columns import ColumnMap, ImportedSamples, read_samples
from twin.exchange.proposal import propose_map

ROW_COUNT = 240
COUNTS: Float1D = np.arange(ROW_COUNT, dtype=np.float64)
TIME: Float1D = COUNTS / 200.0
DISP_MM: Float1D = 10.0 * np.sin(2 * np.pi * 2.5 * TIME) + 2.0 * np.sin(2 * np.pi * 5.83 * TIME)
FORCE_N: Float1D = 36.0 * DISP_MM + 1.1 * np.gradient(DISP_MM, TIME)
START = datetime(2026, 3, 28, 23, 59, 59, 500000)
Rows = Iterable[tuple[float, ...]]
ROWS = [*zip(TIME.tolist(), DISP_MM.tolist(), FORCE_N.tolist(), strict=True)]


def text(
    head: str, rows: Rows = ROWS, mark: str = ",", digits: str = "{:.7f}", tail: str = ""
) -> str:
    """Return a text table below a head; a head that ends in no line feed gets one."""
    lines = [mark.join(digits.format(value) for value in row) for row in rows]
    return (head + "\n" if head else "") + "\n".join(lines) + "\n" + tail


def comma(content: str) -> str:
    """Return a table with decimal commas."""
    return content.replace(".", ",")


def with_stamps(head: str, stamp: Callable[[datetime, int], str], mark: str = ",") -> str:
    """Return a table whose first column is a text for each sample."""
    lines = [
        mark.join((stamp(START + timedelta(seconds=t), k), f"{u:.7f}", f"{f:.7f}"))
        for k, (t, u, f) in enumerate(ROWS)
    ]
    return head + "\n" + "\n".join(lines) + "\n"


def with_times(head: str, times: Float1D, digits: str = "{:.12g}") -> str:
    lines = [
        f"{digits.format(t)},{u:.7f},{f:.7f}"
        for t, (_, u, f) in zip(times.tolist(), ROWS, strict=True)
    ]
    return head + "\n" + "\n".join(lines) + "\n"


def with_scales(head: str, disp: float, force: float) -> str:
    return text(head, ((t, disp * u, force * f) for t, u, f in ROWS), digits="{:.12g}")


def lvm(x_columns: str, mark: str = "\t", decimal: str = ".", segments: int = 1) -> str:
    name = {"\t": "Tab", ",": "Comma"}[mark]
    lines = [
        "LabVIEW Measurement\t", "Writer_Version\t2", "Reader_Version\t2", f"Separator\t{name}",
        f"Decimal_Separator\t{decimal}", "Multi_Headings\tYes", f"X_Columns\t{x_columns}",
        "Time_Pref\tRelative", "Date\t2026/03/29", "Time\t01:59:59.5", "***End_of_Header***\t", "",
    ]  # fmt: skip
    lines = [line.replace("\t", mark) for line in lines]
    size = ROW_COUNT // segments
    for part in range(segments):
        first = part * size
        start = 0.0 if x_columns == "No" and part == 0 else TIME[first]
        head = [
            ("Channels", "2"), ("Samples", str(size), str(size)),
            ("Date", "2026/03/29", "2026/03/29"), ("Time", "01:59:59", "01:59:59"),
            ("Y_Unit_Label", "mm", "N"), ("X_Dimension", "Time", "Time"),
            ("X0", f"{start:.7E}", f"{start:.7E}"), ("Delta_X", "0.005000", "0.005000"),
        ]  # fmt: skip
        if x_columns == "Multi":
            head = [(head[0]), *((k, a, "", b) for k, a, b in head[1:])]
        lines += [mark.join(cells) for cells in head] + [f"***End_of_Header***{mark}"]
        names = ["X_Value", "Displacement", "Force"]
        if x_columns == "Multi":
            names = ["X_Value", "Displacement", "X_Value", "Force"]
        lines.append(mark.join([*names, "Comment"]))
        for t, u, f in ROWS[first : first + size]:
            x = "" if x_columns == "No" else f"{t:.6f}"
            cells = [x, f"{u:.7f}", f"{f:.7f}"]
            if x_columns == "Multi":
                cells = [x, f"{u:.7f}", x, f"{f:.7f}"]
            lines.append(mark.join(cells))
        lines.append("")
    joined = "\n".join(lines)
    return joined.replace(".", ",") if decimal == "," else joined


MTS = "MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A\n\nData Acquisition:\tTimed\t\tTime:\t1.2\tSec\t29/03/2026"
CATMAN = "HBM_CATMANSOFTWARE 5.2\nT - worksheet\nDATUM\t29.03.2026\nNummer der Kanaele\t3"
TOA5 = '"TOA5","CR6","CR6","1234","CR6.Std.10","CPU:test.CR6","9999","Fast"'
EXPRESS = (
    "channel names:\nDisp (mm)\tForce (N)\nstart times:\n28/03/2026 23:59:59.5\t"
    "28/03/2026 23:59:59.5\ndt:\n0.005000\t0.005000\n"
)
HIOKI = (
    '"File name","WAVE0001.CSV","V1.00"\n"Title comment",""\n"Start trigger time","\'26-03-29"\n'
    '"CH","CH1","CH2",\n"Mode","DC","DC",\n"Range","500mV","2V",\n"Scaling","On","On",\n'
)
YOKOGAWA = (
    '"Header Size",9\n"Model Name","DL850E"\n"TraceName","Disp","Force"\n"BlockSize",240,240\n'
    '"VUnit","mm","N"\n"SampleRate",200,200\n"HUnit","s","s"\n"Date","2026/03/29","2026/03/29"\n'
    '"Time","10:00:00","10:00:00"\n'
)
GRAPHTEC = (
    "Vendor,GRAPHTEC Corporation\nSampling interval,5ms\nStart time,2026-03-29,01:59:59\n"
    "CH1,Disp,DC,1V,Off,100,-100,mm\nData\nNumber,Date&Time,ms,Disp,Force\nNO.,Time,ms,mm,N"
)
KYOWA = (
    "DCS-100A\nSampling Frequency,200 Hz\nCH No.,CH-1,CH-2\nCH Name,Disp,Force\nRange,OFF,OFF\n"
    "Unit,mm,N\nTime,Data,Data"
)


def rows_of_channels(mark: str = ",", *, has_units: bool = False) -> str:
    """Return a table whose channels are in rows."""
    head = ("Time", "s"), ("Disp", "mm"), ("Force", "N")
    return "\n".join(
        mark.join([*(names if has_units else [f"{names[0]} ({names[1]})"]), *map(str, values)])
        for names, values in zip(head, zip(*ROWS, strict=True), strict=True)
    )


def with_units(mark: str, form: str) -> str:
    return "\n".join(form.format(t, u, f).replace("|", mark) for t, u, f in ROWS)


GOOD: dict[str, str | bytes] = {
    "plain.csv": text("Time (s),Disp (mm),Force (N)"),
    "square.csv": text("Time [s],Disp [mm],Force [N]"),
    "bom.csv": ("\ufeff" + text("Time (s),Disp (mm),Force (N)")).encode(),
    "utf16.txt": text("Time (s)\tDisp (mm)\tForce (N)", mark="\t").encode("utf-16"),
    "unmarked16.txt": text("Time (s),Disp (mm),Force (N)").encode("utf-16-le"),
    "utf16be.txt": b"\xfe\xff" + text("Time (s),Disp (mm),Force (N)").encode("utf-16-be"),
    "latin1.csv": comma(text("Prüfzeit [s];Weg [mm];Kraft [N]", mark=";")).encode("cp1252"),
    "mac.csv": text("Time (s),Disp (mm),Force (N)").replace("\n", "\r"),
    "dos.csv": text("Time (s),Disp (mm),Force (N)").replace("\n", "\r\n"),
    "semicolon.csv": text("Time (s);Disp (mm);Force (N)", mark=";"),
    "german.csv": comma(text("Zeit [s];Weg [mm];Kraft [N]", mark=";")),
    "tab.txt": text("Time (s)\tDisp (mm)\tForce (N)", mark="\t"),
    "blanks.dat": text("Time Disp Force\ns mm N", mark="   "),
    "aligned.txt": text("   t[s]    Disp[mm]     Force[N]", mark="  ", digits="{:14.7f}"),
    "second_row.csv": text("Time,Disp,Force\ns,mm,N"),
    "second_row_brackets.csv": text("Time,Disp,Force\n[s],[mm],[N]"),
    "second_row_parentheses.csv": text("Time,Extension,Load\n(s),(mm),(N)"),
    "names_below_units.csv": text("Test 17\n\nTime,Disp,Force\ns,mm,N\n"),
    "trailing.csv": text("Time (s),Disp (mm),Force (N),").replace("\n", ",\n").replace(",,", ","),
    "quoted_names.csv": text('"Time (s)","Disp (mm)","Force (N)"'),
    "instron_bluehill.csv": "\n".join(
        ['"Time","Extension","Load"', '"(s)","(mm)","(N)"']
        + [f'"{t:.4f}","{u:.7f}","{f:.7f}"' for t, u, f in ROWS]
    ),
    "zwick.csv": text('"Prüfzeit";"Weg";"Standardkraft"\n"s";"mm";"N"', mark=";").encode("cp1252"),
    "mts_testsuite.txt": text(
        f"{MTS}\nRunning Time\tAxial Displacement\tAxial Force\nSec\tmm\tN", mark="\t"
    ),
    "catman.asc": comma(text(f"{CATMAN}\nZeit\tWeg\tKraft\ns\tmm\tN", mark="\t")),
    "campbell_toa5.dat": with_stamps(
        f'{TOA5}\n"TIMESTAMP","Disp","Force"\n"TS","mm","N"\n"","Smp","Smp"', lambda d, k: f'"{d}"'
    ),
    "dewesoft.csv": text(
        "File name: run7.dxd\nStart time: 29.03.2026 01:59:59\nSample rate: 200 Hz\n\n"
        "Time (s),Disp (mm),Force (N)"
    ),
    "polytec.txt": text(
        "Source File Name:\trun.pvd\nSignal:\tAnalog\n\nTime\tDisplacement\tForce\n"
        "[ s ]\t[ mm ]\t[ N ]", mark="\t",
    ),
    "phyphox.csv": text('"Time (s)","Displacement (mm)","Force (N)"', digits="{:.9E}"),
    "pandas_index.csv": text(
        ",Time (s),Disp (mm),Force (N)", ((k, *row) for k, row in enumerate(ROWS)), digits="{:.9g}"
    ),
    "r_row_names.csv": "\n".join(
        ['"","Time (s)","Disp (mm)","Force (N)"']
        + [f'"{k + 1}",{t:.4f},{u:.7f},{f:.7f}' for k, (t, u, f) in enumerate(ROWS)]
    ),
    "numpy_savetxt.txt": text("# Time (s) Disp (mm) Force (N)", mark=" ", digits="{:.18e}"),
    "percent.txt": text("% Time (s), Disp (mm), Force (N)", mark=", "),
    "sep_hint.csv": text("sep=;\nTime (s);Disp (mm);Force (N)", mark=";"),
    "footer.csv": text("Time (s),Disp (mm),Force (N)", tail="End of data\n"),
    "comments.csv": text("Time (s),Disp (mm),Force (N)").replace("\n0.5", "\n# mark\n0.5", 1),
    "status.csv": "\n".join(
        ["Time (s),Status,Disp (mm),Force (N)"]
        + [f"{t:.4f},OK,{u:.7f},{f:.7f}" for t, u, f in ROWS]
    ),
    "spare_name.csv": text("Time (s),Disp (mm),Force (N),remark"),
    "twice_alike.csv": text(
        "Time (s),Disp (mm),Disp (mm),Force (N)", ((t, u, u, f) for t, u, f in ROWS)
    ),
    "empty_rows.csv": text("Time (s),Disp (mm),Force (N)", tail=",,\n,,\n"),
    "micrometre.csv": with_scales("Time (s),Disp (µm),Force (kN)", 1e3, 1e-3).encode(),
    "micro_cp1252.csv": with_scales("Time (s),Disp (µm),Force (kN)", 1e3, 1e-3).encode("cp1252"),
    "inch_kip.csv": with_scales("Time (sec),Disp (in),Force (kips)", 1 / 25.4, 1 / 4448.2216152605),
    "pound.csv": with_scales("Time (sec),Stroke (inch),Load (lbs)", 1 / 25.4, 1 / 4.4482216152605),
    "kgf.csv": with_scales("Time (s),Disp (cm),Force (kgf)", 0.1, 1 / 9.80665),
    "one_clock_twice.csv": text(
        "Time 1 (s),Disp (mm),Time 2 (s),Force (N)", ((t, u, t, f) for t, u, f in ROWS)
    ),
    "date_and_time.csv": text(
        "Time (s),Epoch time (s),Disp (mm),Force (N)",
        ((t, 1774742399.5 + t, u, f) for t, u, f in ROWS),
    ),
    "ms.csv": with_times("Time (ms),Disp (mm),Force (N)", 1e3 * TIME),
    "minutes.csv": with_times("Time [min],Disp [mm],Force [N]", TIME / 60),
    "hours.csv": with_times("Time [h],Disp [mm],Force [N]", TIME / 3600),
    "epoch.csv": with_times("Timestamp,Disp (mm),Force (N)", 1774742399.5 + TIME, "{:.16g}"),
    "epoch_ms.csv": with_times("Time,Disp (mm),Force (N)", 1774742399500 + 1e3 * TIME, "{:.16g}"),
    "epoch_ns.csv": with_times("Time,Disp (mm),Force (N)", 1.7747423995e18 + 1e9 * TIME, "{:.0f}"),
    "serial.csv": with_times("Time,Disp (mm),Force (N)", 46109.99999 + TIME / 86400, "{:.16g}"),
    "iso.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: d.isoformat()),
    "iso_z.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"{d.isoformat()}Z"),
    "iso_zone.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"{d.isoformat()}+01:00"),
    "clock.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"{d:%H:%M:%S.%f}"),
    "german_date.csv": with_stamps(
        "Zeit;Weg [mm];Kraft [N]", lambda d, k: f"{d:%d.%m.%Y %H:%M:%S.%f}", ";"
    ),
    "us_date.csv": with_stamps(
        "Time,Disp (mm),Force (N)", lambda d, k: f"{d:%m/%d/%Y %I:%M:%S.%f %p}"
    ),
    "day_first.csv": with_stamps(
        "Time,Disp (mm),Force (N)", lambda d, k: f"{d:%d/%m/%Y %H:%M:%S.%f}"
    ),
    "bars.txt": text("Time (s)|Disp (mm)|Force (N)", mark="|"),
    "units_above_names.csv": text("s;mm;N\nTime;Disp;Force", mark=";"),
    "repeated_head.csv": "".join(
        ("Time,Disp,Force\ns,mm,N\n" if k % 100 == 0 else "") + f"{t:.4f},{u:.7f},{f:.7f}\n"
        for k, (t, u, f) in enumerate(ROWS)
    ),
    "thousands.csv": "\n".join(
        ["Time (s),Disp (µm),Force (N)"] + [f'{t:.4f},"{1e3 * u:,.4f}",{f:.7f}' for t, u, f in ROWS]
    ),
    "numbered.csv": with_times("Scan interval: 5 ms\nSample,Disp (mm),Force (N)", COUNTS),
    "minutes_seconds.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"{d:%M:%S.%f}"),
    "no_times.csv": text(
        "Sampling rate: 200 Hz\nDisp (mm),Force (N)", ((u, f) for _, u, f in ROWS)
    ),
    "interval.csv": text("dt = 0.005 s\nDisp (mm),Force (N)", ((u, f) for _, u, f in ROWS)),
    "lost.csv": text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", ""),
    "lost_nan.csv": text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", "NaN"),
    "fortran.dat": text("Time[s] Disp[mm] Force[N]", mark="  ", digits="{:.9E}").replace("E", "D")
    .replace("Disp", "Disp"),
    "din_slash.csv": text("t/s,Weg/mm,Kraft/N"),
    "in_unit.csv": text("Zeit in s;Weg in mm;Kraft in N", mark=";"),
    "french_thousands.csv": "\n".join(
        ["Temps (s);Déplacement (µm);Effort (N)"]
        + [f"{t:.4f};{1e3 * u:,.4f};{f:.7f}".replace(",", "\u202f").replace(".", ",")
           for t, u, f in ROWS]
    ),
    "unicode_minus.csv": text("Time (s),Disp (mm),Force (N)").replace("-", "−"),
    "lost_excel.csv": text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", "#N/A"),
    "lost_qnan.csv": text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", "1.#QNAN"),
    "waveform.txt": text(
        "waveform\t[0]\t[1]\nt0\t28.03.2026 23:59:59.5\t28.03.2026 23:59:59.5\n"
        "delta t\t0.005000\t0.005000\n\nDisp (mm)\tForce (N)", ((u, f) for _, u, f in ROWS),
        mark="\t",
    ),
    "per_second.csv": text(
        "Samples per second,200\nDisp (mm),Force (N)", ((u, f) for _, u, f in ROWS)
    ),
    "no_line_feed.csv": text("Time (s),Disp (mm),Force (N)").rstrip(),
    "footer_no_line_feed.csv": text("Time (s),Disp (mm),Force (N)", tail="End"),
    "signal_express.txt": EXPRESS + text(
        "data:", ((u, f) for _, u, f in ROWS), mark="\t"
    ),
    "line_feeds.csv": text('"Test 17,\nsecond"\n"Time\n(s)","Disp\n(mm)","Force\n(N)"'),
    "german_thousands.csv": "\n".join(
        ["Zeit [s];Weg [µm];Kraft [N]"]
        + [f"{t:.4f};{1e3 * u:,.4f};{f:.7f}".translate(str.maketrans(",.", ".,"))
           for t, u, f in ROWS]
    ),
    "colon_before_ms.csv": with_stamps(
        "Time,Disp (mm),Force (N)", lambda d, k: f"{d:%H:%M:%S}:{d.microsecond // 1000:03d}"
    ),
    "timedelta.csv": with_stamps(
        "Time,Disp (mm),Force (N)", lambda d, k: f"0 days 00:00:{k / 200:09.6f}"
    ),
    "blank_before_quote.csv": text('"Time (s)", "Disp (mm)", "Force (N)"', mark=", "),
    "unit_inside_name.csv": text("Time (s) Run #1,[mm] Disp,Force {N}"),
    "ruled.txt": text(
        "  Time   Disp   Force\n  (sec)   (mm)    (N)\n ------ ------ ------", mark="  "
    ),
    "utf32.csv": text("Time (s),Disp (mm),Force (N)").encode("utf-32"),
    "two_rates_one_right.csv": text(
        "Sampling rate: 1000 Hz\nExport rate: 200 Hz\nTime (s),Disp (mm),Force (N)"
    ),
    "hioki.csv": text(f'{HIOKI}"Time","CH1[mm]","CH2[N]",'),
    "yokogawa.csv": "\n".join([YOKOGAWA, *(f",{u:.7E},{f:.7E}" for _, u, f in ROWS)]),
    "graphtec.csv": with_stamps(GRAPHTEC, lambda d, k: f"{k},{d:%Y/%m/%d %H:%M:%S},{5 * k % 1000}"),
    "kyowa.csv": text(KYOWA),
    "rows.csv": rows_of_channels(), "rows_units.csv": rows_of_channels(";", has_units=True),
    "unit_cells.csv": "Time,Disp,Force\n" + with_units(",", "{:.4f} s|{:.7f} mm|{:.7f} N"),
    "unit_cells_no_head.txt": with_units(", ", "{:.4f}s|{:.7f}mm|{:.7f}N"),
    "unit_cells_commas.csv": "Zeit;Weg;Kraft\n" + comma(
        with_units(";", "{:.4f} s|{:.7f} mm|{:.7f} N")
    ),
    "matlab_datetime.csv": with_stamps(
        "Time,Disp (mm),Force (N)", lambda d, k: f"{d:%d-%b-%Y %H:%M:%S.%f}"
    ),
    "basic_iso.csv": with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"{d:%Y%m%dT%H%M%S.%f}"),
    "famos.asc": text('"Time" "Disp" "Force"\n"s" "mm" "N"', mark=" "),
    "capitals.csv": with_scales(
        "TIME (SEC),DISPLACEMENT (IN),LOAD (KIPS)", 1 / 25.4, 1 / 4448.2216152605
    ),
    "micros.csv": with_times("micros,Disp (mm),Force (N)", 5000 * COUNTS),
    "settings_beside.csv": "\n".join(
        ["Time (s),Disp (mm),Force (N),,Setting,Value"]
        + [f"{t:.4f},{u:.7f},{f:.7f},,{'Span,500' if k < 3 else ','}"
           for k, (t, u, f) in enumerate(ROWS)]
    ),
    "one.lvm": lvm("One"), "no.lvm": lvm("No"), "multi.lvm": lvm("Multi"),
    "comma.lvm": lvm("One", mark=","), "decimal.lvm": lvm("One", decimal=","),
    "segments.lvm": lvm("One", segments=3), "segments_no.lvm": lvm("No", segments=2),
}  # fmt: skip
BAD: dict[str, tuple[str | bytes, str]] = {
    "empty.csv": (b"", "empty"),
    "blank.csv": (b"\n \n", "empty"),
    "only_head.csv": ("Time (s),Disp (mm),Force (N)\n", "no samples"),
    "image.csv": (b"\x89PNG\r\n\x1a\n" + bytes(99), "PNG image"),
    "paper.csv": (b"%PDF-1.7\n" + bytes(99), "PDF document"),
    "sound.csv": (b"RIFF\0\0\0\0WAVE" + bytes(99), "sound"),
    "old.xls": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(99), "old Excel"),
    "packed.csv": (gzip.compress(text("Time (s),Disp (mm)").encode()), "gzip"),
    "page.csv": ("<!DOCTYPE html>\n<html><body>Not found</body></html>\n", "HTML"),
    "data.xml": ("<?xml version='1.0'?>\n<run><x>1</x></run>\n", "XML"),
    "data.json": (json.dumps({"time": TIME.tolist(), "disp": DISP_MM.tolist()}), "JSON"),
    "data.pkl": (pickle.dumps({"t": TIME}), "pickle"),
    "data.npy": (b"\x93NUMPY\x01\x00" + bytes(120), "numpy"),
    "data.arrow": (b"ARROW1\0\0" + bytes(120), "Arrow"),
    "mixed.csv": (
        comma(text("Time;Disp;Force\ns;mm;N", mark=";")).replace("\n0,5", "\n0.5", 1), "decimal"
    ),
    "touching.dat": (
        text("Time[s] Disp[mm] Force[N]", mark=" ", digits="{:.4f}").replace(" -", "-"), "cells"
    ),
    "infinite.csv": (
        text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", "inf"), "infinite"
    ),
    "footer_sums.csv": (
        text("Time (s),Disp (mm),Force (N)", tail="\nMaximum,11.9,430\n"), "'Maximum'"
    ),
    "overflow.csv": (
        text("Time (s),Disp (mm),Force (N)").replace(f"{FORCE_N[9]:.7f}", "OVERFLOW"), "OVERFLOW"
    ),
    "cut_off.csv": (text("Time (s),Disp (mm),Force (N)")[:-9], "cut off"),
    "unknown_unit.csv": (with_scales("Time (s),Disp (mil),Force (N)", 39.37, 1.0), "'mil'"),
    "unknown_force.csv": (with_scales("Time (s),Disp (mm),Force (daN)", 1.0, 0.1), "'daN'"),
    "ten_newtons.csv": (with_scales("Time (s),Disp (mm),Force (10 N)", 1.0, 0.1), "'10 N'"),
    "thousandfold.csv": (with_scales("Time (s),Disp (mm),Force (N) x1000", 1.0, 1e-3), "x1000"),
    "hundredths.csv": (with_scales("Time (s),Disp (1/100 mm),Force (N)", 1e2, 1.0), "'1/100 mm'"),
    "hundredths_of_seconds.csv": (
        with_times("Time (1/100 s),Disp (mm),Force (N)", 1e2 * TIME), "'1/100 s'"
    ),
    "two_units.csv": (text("Time (s),Disp (m),Force (N)\ns,mm,N"), "states m, but its unit mm"),
    "interval_in_ms.txt": (
        text("dt = 5\nDisp (mm)\tForce (N)", ((u, f) for _, u, f in ROWS), mark="\t"), "0.2 Hz"
    ),
    "two_rates_stated.csv": (
        text(
            "Sampling rate: 1000 Hz\nExport rate: 200 Hz\nDisp (mm),Force (N)",
            ((u, f) for _, u, f in ROWS),
        ),
        "1000 Hz and 200 Hz",
    ),
    "starts_apart.txt": (
        text(
            "waveform\t[0]\t[1]\nt0\t23:59:59.5\t23:59:57\ndelta t\t0.005\t0.005\n"
            "Disp (mm)\tForce (N)", ((u, f) for _, u, f in ROWS), mark="\t",
        ),
        "2.5 s apart",
    ),
    "express_starts.txt": (
        EXPRESS.replace("59.5\nd", "57.0\nd")
        + text("data:", ((u, f) for _, u, f in ROWS), mark="\t"),
        "start at -2.5 s and 0 s",
    ),
    "hidden_thousands.csv": (
        "\n".join(
            ["Zeit;Weg [µm];Kraft [N]"]
            + [f"{START + timedelta(seconds=t):%H:%M:%S.%f};{300 * u:,.0f};{f:.7f}"
               .replace(",", "-").replace(".", ",").replace("-", ".", 1) for t, u, f in ROWS]
        ),
        "thousands",
    ),
    "hioki_volts.csv": (
        text(f'{HIOKI}"Time","CH1[V]","CH2[V]",'),
        "'CH1[V]' in V, 'CH2[V]' in V: state in a map what each one is, volts with their gain",
    ),
    "rigol.csv": (
        "\n".join(
            ["X,CH1,CH2,Start,Increment,", "Sequence,Volt,Volt,0.0,5.0E-03"]
            + [f"{k},{u:.6E},{f:.6E},," for k, (_, u, f) in enumerate(ROWS)]
        ),
        "'CH1' in V, 'CH2' in V",
    ),
    "rigol_t0.csv": (
        text("CH1V,CH2V,t0 = 0.0, tInc = 5.0e-3", ((u, f) for _, u, f in ROWS)), "'CH1V', 'CH2V'"
    ),
    "tektronix.csv": (
        "\n".join(
            f"{key},{t:.6f},{u:.6f},"
            for key, (t, u, _) in zip(
                ["Record Length,240,", "Source,CH1,", "Vertical Units,V,", *[",,"] * 237], ROWS,
                strict=True,
            )
        ),
        "of 'CH1' in V",
    ),
    "changing_unit.csv": (
        "Time,Disp,Force\n"
        + "\n".join(
            f"{t:.4f} s,{u:.7f} mm,{f / 1e3 if k > 9 else f:.7f} {'kN' if k > 9 else 'N'}"
            for k, (t, u, f) in enumerate(ROWS)
        ),
        "kN' is no number in 'N'",
    ),
    "two_units_in_cells.csv": (
        "Time,Disp (m),Force\n" + with_units(",", "{:.4f} s|{:.7f} mm|{:.7f} N"),
        "in m by its head, in mm by its cells",
    ),
    "gram_force.csv": (
        with_scales("Time (s),Disp (mm),Load (g)", 1.0, 1e3 / 9.80665),
        "of force by its name, of acceleration by its unit g",
    ),
    "counter_wraps.csv": (
        with_times("millis,Disp (mm),Force (N)", (65000 + 5 * COUNTS) % 65536), "time must rise"
    ),
    "rounded_days.csv": (
        with_times("JD,Disp (mm),Force (N)", 2461128.5 + TIME / 86400, "{:.9f}"),
        "'JD' rises throughout",
    ),
    "wrapped.txt": (
        "\n".join(" ".join(f"{u:.5f}" for u in DISP_MM[k : k + 8]) for k in range(0, 240, 8)),
        "a series of 240 values in lines of 8",
    ),
    "fdsn.txt": ("TIMESERIES XX_A__HNZ_D, 240 samples, 200 sps\n1 2 3\n", "of FDSN"),
    "geonet.V1A": ("Uncorrected accelerogram 2016_NBLC GNS Science\n1 2 3\n", "of GeoNet"),
    "frames.csv": (
        with_stamps("Time,Disp (mm),Force (N)", lambda d, k: f"00:00:{k // 25:02d}:{k % 25:02d}"),
        "'Time' is text",
    ),
    "backwards.csv": (text("Time (s),Disp (mm),Force (N)", reversed(ROWS)), "time"),
    "twice.csv": (text("Time (s),Disp (mm),Force (N)", [*ROWS, *ROWS]), "time must rise"),
    "two_clocks.csv": (
        text(
            "Time 1 (s),Disp (mm),Time 2 (s),Force (N)",
            ((t, u, t + 0.25, f) for t, u, f in ROWS),
        ),
        "'Time 1 (s)' and 'Time 2 (s)' are different times, up to 0.25 s apart",
    ),
    "counts.csv": (with_times("No,Disp (mm),Force (N)", 1.0 + COUNTS), "rate"),
    "sample_numbers.csv": (with_times("Time,Disp (mm),Force (N)", COUNTS), "counts"),
    "ms_unstated.csv": (with_times("Time,Disp (mm),Force (N)", 1e3 * TIME), "ms"),
    "days_unstated.csv": (with_times("Time,Disp (mm),Force (N)", TIME / 86400), "day"),
    "no_rate.csv": (text("Disp (mm),Force (N)", ((u, f) for _, u, f in ROWS)), "rate"),
    "no_units.csv": (text("Time (s),Disp,Force"), "unit is not stated"),
    "no_names.csv": (text(""), "no column is known"),
    "volts.csv": (text("Time,Channel A,Channel B\n(s),(V),(V)"), "no column is known"),
    "two_rates.csv": (text("Sampling rate: 100 Hz\nTime (s),Disp (mm),Force (N)"), "100 Hz"),
    "twice_different.csv": (
        text("Time (s),Force (N),Force (N)"), "2 columns have this name"
    ),
    "reversed.csv": (with_scales("Time (s),Disp (mm),Force (N)", 1.0, -1.0), "reversed"),
    "metres.csv": (with_scales("Time (s),Disp (m),Force (N)", 35.0, 1.0), "m"),
    "smc.smc": ("2 CORRECTED ACCELEROGRAM\n" + "1 2 3\n" * 40, "SMC record of USGS whose"),
    "starts.lvm": (
        lvm("No").replace("X0\t0.0000000E+00\t0.0", "X0\t0.0000000E+00\t2.5", 1), "2.5 s apart"
    ),
    "empty.lvm": ("LabVIEW Measurement\t\nWriter_Version\t2\n***End_of_Header***\n", "no segment"),
    "not.tdms": (b"hello" * 30, "not a LabVIEW TDMS file"),
    "not.parquet": (b"hello" * 30, "not a Parquet file"),
    "not.mat": (b"hello" * 60, ""),
}  # fmt: skip


def read_stranger(path: Path) -> ImportedSamples:
    """Return the samples by the proposed map; InputError with the cause or the open questions."""
    table = read_table(path)
    proposal = propose_map(table)
    if proposal.questions:
        raise InputError("; ".join([*proposal.questions, *proposal.dropped]), where=path)
    column_map = ColumnMap.model_validate(proposal.to_map().model_dump(exclude_unset=True))
    samples = read_samples(table, column_map)
    if samples.doubts:
        raise InputError("; ".join(doubt.problem for doubt in samples.doubts), where=path)
    return samples


def check(samples: ImportedSamples, lost: int = 0) -> None:
    assert samples.rate_hz == pytest.approx(200.0, rel=1e-6)
    assert samples.index.tolist() == list(range(ROW_COUNT))
    expected = {"rel_disp_m": 1e-3 * DISP_MM, "damper_force_n": FORCE_N}
    for name, values in expected.items():
        read = samples.channels[name]
        good = np.isfinite(read)
        assert good.sum() >= ROW_COUNT - lost, name
        np.testing.assert_allclose(read[good], values[good], rtol=1e-5, atol=1e-6, err_msg=name)


def write(path: Path, content: str | bytes) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize("name", GOOD)
def test_a_stranger_is_read_right(tmp_path: Path, name: str) -> None:
    check(read_stranger(write(tmp_path / name, GOOD[name])), lost=name.startswith("lost"))


@pytest.mark.parametrize("name", BAD)
def test_a_stranger_is_refused_with_its_true_cause(tmp_path: Path, name: str) -> None:
    content, cause = BAD[name]
    with pytest.raises(InputError) as caught:
        read_stranger(write(tmp_path / name, content))
    assert cause in str(caught.value)
    assert "sweep." not in str(caught.value)
