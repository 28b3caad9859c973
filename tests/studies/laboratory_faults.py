"""Faults of a laboratory, planted in the samples of a loop check: named, or shown harmless.

    python -m tests.studies.laboratory_faults

12 kinds in 5 sizes. The samples are changed here, by nothing that the product has. A fault is named
if a line of the loop check fails, with its remedy, or notices it, and for cells that bear nothing
then, if the first contact of the test stops it by name. It is harmless if it changes the tones of u
and of the mass's acceleration by at most 2 %, which is what two instruments of one body may differ
by.
"""

from collections.abc import Callable, Iterator

import numpy as np

from table_io.acquisition.session import SessionSetup, run_session
from table_io.block import Block, Float1D, Float2D, Label
from table_io.clock import ManualClock
from table_io.records import RunStart, Trip
from table_io.safety.loop_check import evaluate, find_notice, find_remedy
from table_io.sim.simulated_table import SimulatedBackend
from tests.builders.profiles import make_profile
from tests.builders.rigs import CHANNEL_ROWS, RIG
from tests.table_io.safety.test_loop_check import CheckRun, record_loop_check

Samples = dict[str, Float1D]
MAX_HARMLESS_CHANGE = 0.02
TESTS = ("g4_ss3", "ginf", "gm1", "g10", "gm10")
RATE_HZ = 2000.0


def shift(values: Float1D, seconds: float) -> Float1D:
    index = np.arange(values.size, dtype=float)
    return np.interp(index - seconds * RATE_HZ, index, values)


def list_faults() -> Iterator[tuple[str, str, str, Callable[[Samples], None]]]:
    """Yield (kind, size, test, change of the samples)."""

    def on_table(s: Samples) -> None:
        s["mass_disp_m"] = s["mass_disp_m"] - s["table_disp_m"]

    for test in TESTS:
        yield "mass laser on the table", test, test, on_table

    def change(name: str, function: Callable[..., Float1D]) -> Callable[[Samples], None]:
        def apply(s: Samples) -> None:
            s[name] = function(s[name])

        return apply

    def side(cells: tuple[str, str]) -> Callable[[Samples], None]:
        def apply(s: Samples) -> None:
            for cell in cells:
                s[cell] = -s[cell]

        return apply

    right, left = ("force_r1_n", "force_r2_n"), ("force_l1_n", "force_l2_n")
    for test, cells in (("gm1", right), ("gm1", left), ("gm10", right), ("gm10", left),
                        ("g4_ss3", right)):  # fmt: skip
        yield "side of cells reversed", f"{cells[0][6]} at {test}", test, side(cells)
    for ppm in (10, 20, 50, 100, 200):
        yield (
            "clocks drift, after 30 min",
            f"{ppm} ppm",
            "g4_ss3",
            change("mass_acc_m_s2", lambda v, lag=ppm * 1e-6 * 1800: shift(v, lag)),
        )
    for hold in (2, 5, 10, 20, 50):
        yield (
            "laser at a lower rate",
            f"1 of {hold}",
            "g4_ss3",
            change("mass_disp_m", lambda v, hold=hold: np.repeat(v[::hold], hold)[: v.size]),
        )
    for share in (0.01, 0.02, 0.05, 0.1, 0.2):

        def rock(values: Float1D, share: float = share) -> Float1D:
            spectrum = np.fft.rfft(values)
            f = np.fft.rfftfreq(values.size, 1 / RATE_HZ)
            gain = share / (1 - (f / 7.0) ** 2 + 0.1j * f / 7.0)
            return np.fft.irfft(spectrum * (1 + gain), values.size)

        yield "mass rocks", f"{100 * share:g} %", "g4_ss3", change("mass_acc_m_s2", rock)
    for name in ("table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2", "drive_disp_m"):
        yield "reversed", name, "g4_ss3", change(name, np.negative)
    pairs = (("table_disp_m", "mass_disp_m"), ("table_acc_m_s2", "mass_acc_m_s2"),
             ("table_disp_m", "table_acc_m_s2"), ("mass_disp_m", "force_r1_n"),
             ("force_r1_n", "force_l1_n"))  # fmt: skip
    for first, second in pairs:

        def swap(s: Samples, first: str = first, second: str = second) -> None:
            s[first], s[second] = s[second], s[first]

        yield "swapped", f"{first}, {second}", "gm1", swap
    for share in (0.01, 0.02, 0.05, 0.1, 0.3):
        yield (
            "gain of the mass laser",
            f"{100 * share:g} %",
            "g4_ss3",
            change("mass_disp_m", lambda v, share=share: (1 + share) * v),
        )
    for lag_ms in (0.2, 1, 5, 20, 50):
        yield (
            "lag of the mass laser",
            f"{lag_ms:g} ms",
            "g4_ss3",
            change("mass_disp_m", lambda v, lag=lag_ms * 1e-3: shift(v, lag)),
        )
    for hum in (0.005, 0.02, 0.1, 0.5, 2.0):
        yield (
            "hum of the accelerometer",
            f"{hum:g} m/s2",
            "g4_ss3",
            change(
                "mass_acc_m_s2",
                lambda v, hum=hum: v + hum * np.sin(2 * np.pi * 50 * np.arange(v.size) / RATE_HZ),
            ),
        )
    for offset_mm in (0.02, 0.1, 0.3, 1.0, 5.0):
        yield (
            "offset of the mass laser",
            f"{offset_mm:g} mm",
            "g4_ss3",
            change("mass_disp_m", lambda v, offset=offset_mm * 1e-3: v + offset),
        )
    for share in (0.001, 0.004, 0.02, 0.1, 0.5):

        def lose(values: Float1D, share: float = share) -> Float1D:
            lost = np.random.default_rng(2).random(values.size) < share
            return np.where(lost, np.nan, values)

        yield "loose cable", f"{100 * share:g} % lost", "g4_ss3", change("mass_acc_m_s2", lose)


class ReversedCells(SimulatedBackend):
    """The simulated table with the cells of a side reversed."""

    cells: tuple[str, ...] = ()

    def tare(self, samples: int) -> Float2D:
        return self._reverse(super().tare(samples))

    def take(self, samples: int) -> Float2D:
        return self._reverse(super().take(samples))

    def _reverse(self, volts: Float2D) -> Float2D:
        signs = [-1.0 if name in self.cells else 1.0 for name in self._rig.channels]
        return volts * np.array(signs)[:, None]


def stop_at_contact(cells: tuple[str, str]) -> str:
    """Return the trip of a test through contact with reversed cells; "" if it has none."""
    profile, clock = make_profile(), ManualClock()
    backend = ReversedCells(RIG, profile.specimen, profile.acquisition.rate_hz, clock)
    backend.cells = cells
    start = RunStart(0, "", "", "table", "", "", "", RATE_HZ, 20, (), (), 0, {}, {}, "", "", 0.0)
    items = run_session(SessionSetup(profile, RIG), backend, clock, lambda *_: start, lambda: None)
    return next((item.text for item in items if isinstance(item, Trip)), "")


def find_tones(check_run: CheckRun, samples: Samples) -> Float1D:
    """Return the amplitudes of u and of the mass's acceleration in each held motion, complex."""
    drive = check_run[2]
    u = samples["mass_disp_m"] - samples["table_disp_m"]
    tones = []
    for segment in drive.sine_segments:
        if segment.label != Label.CHECK:
            continue
        part = slice(segment.start + segment.count // 2, segment.start + segment.count)
        turn = np.exp(-2j * np.pi * segment.f1 * np.arange(part.start, part.stop) / RATE_HZ)
        for values in (u, samples["mass_acc_m_s2"]):
            known = np.isfinite(values[part])
            centred = (values[part] - np.nanmean(values[part])) * turn * np.hanning(turn.size)
            tones.append(np.mean(centred[known]))
    return np.array(tones)


def main() -> None:
    good = count = 0
    for kind, size, test, plant in list_faults():
        check_run = record_loop_check(test)
        profile, block, drive, noise = check_run
        samples = {name: block.values[row].copy() for name, row in CHANNEL_ROWS.items()}
        clean = find_tones(check_run, samples)
        plant(samples)
        values = np.array([samples[name] for name in block.channels])
        checks, _ = evaluate(
            Block("meas", 0, block.rate_hz, block.channels, values, *drive.labels(0, len(block))),
            drive, profile, RIG, noise,
        )  # fmt: skip
        failed = [check for check in checks if not check.passed]
        change = float(np.abs(find_tones(check_run, samples) / clean - 1).max())
        notices = [text for check in checks if (text := find_notice(check))]
        is_named = bool(failed) and all(find_remedy(check) for check in failed)
        is_named |= not failed and bool(notices)
        if kind.startswith("side") and not is_named:
            first = size[0]
            notices = [stop_at_contact((f"force_{first}1_n", f"force_{first}2_n"))]
            is_named = "turn the cells around" in notices[0]
        if kind.startswith("side"):  # u and a are right, but the forces are not
            change = 2.0
        end = "named" if is_named else "harmless" if change <= MAX_HARMLESS_CHANGE else "MISSED"
        good, count = good + (end != "MISSED"), count + 1
        lines = "; ".join([f"{check.name} ({check.channel})" for check in failed[:3]] or notices)
        print(
            f"{kind}, {size}: {end}, {100 * change:.2g} % of a tone{': ' + lines if lines else ''}"
        )
    print(f"{good} of {count}")


if __name__ == "__main__":
    main()
