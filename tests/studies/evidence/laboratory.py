"""Recordings of a laboratory that shares no code with the product, as tables of a data logger.

A mass on a bearing between two bumpers, excited by a table; integrated by a fourth-order
Runge-Kutta method at a fine step, with force laws in forms of their own. Its instruments err as
real ones do: shared load cells, gains, lags, filters, hum, drift, missing channels, no rest.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol

import numba
import numpy as np
import numpy.typing as npt
from scipy.signal import butter, oaconvolve, sosfilt

Float1D = npt.NDArray[np.float64]
FINE_HZ = 16_000.0
GRAVITY_M_S2 = 9.80665

# Slots of the vector of laws.
SLOTS = (
    "k", "c", "kr", "cr", "kl", "cl", "gap_r", "gap_l", "k3", "c2", "fc", "stribeck", "bw_force",
    "bw_yield", "k1", "tau", "k2", "hc", "soft_depth", "soft_share", "mount_k", "kb", "tau_b",
    "pull", "friction_u", "softening", "preload", "warming", "cooling", "tanh_force", "tanh_u",
    "k5", "lifted", "dead_band", "wear", "stop_power", "tilt", "plate_mass", "mount_kg",
)  # fmt: skip
SLOT = {name: number for number, name in enumerate(SLOTS)}


@dataclass(frozen=True)
class Specimen:
    """Mass in kg, base parameters in SI, and what is hidden, by slot."""

    mass: float = 550.0
    k: float = 36e3
    c: float = 1.1e3
    kb: float = 510e3
    cb: float = 900.0
    gap_mm: float = 4.0  # a negative gap is a precompression
    hidden: Mapping[str, float] = field(default_factory=dict)

    def vector(self) -> Float1D:
        p = np.zeros(len(SLOTS))
        gap = 0.5e-3 * self.gap_mm if np.isfinite(self.gap_mm) else 1e3
        base = {
            "k": self.k, "c": self.c, "kr": self.kb, "cr": self.cb, "kl": self.kb, "cl": self.cb,
            "gap_r": gap, "gap_l": gap, "bw_yield": 1e-3, "tau": 0.05, "tau_b": 0.02,
            "tanh_u": 1e-3,
        }  # fmt: skip
        for name, value in {**base, **self.hidden}.items():
            p[SLOT[name]] = value
        return p


@numba.njit(cache=True)
def _damper(p, u, v, z, q, t):
    """Force of the bearing; z is the hysteretic state, q the elongation of the dashpot branch."""
    heat = 1.0 - p[27] * (1.0 - np.exp(-t / 60.0))
    force = p[0] * heat * u + p[1] * (1.0 - p[28] * (1.0 - np.exp(-t / 60.0))) * v
    force += p[8] * u**3 + p[31] * u**5 + p[9] * v * abs(v)
    friction = p[10] * (1.0 + p[11] * np.exp(-((v / 0.02) ** 2)))
    force += friction * np.tanh(v / 5e-4)
    force += p[24] * abs(u) * np.tanh(v / 5e-4)
    force += p[12] * z + p[14] * (u - q)
    force += p[29] * np.tanh(u / p[30]) + p[26]
    if p[33] > 0.0:
        force -= p[0] * min(max(u, -p[33]), p[33])
    if p[25] > 0.0:
        force -= p[25] * u * abs(u)
    return force


@numba.njit(cache=True)
def _bumper(p, d, w, k, c, q, t):
    """Force of a bumper, compression positive; d depth, w its rate, q the relaxing branch."""
    if d <= 0.0:
        return -p[23] * max(0.0, 1.0 + d / 5e-4) if (p[23] > 0.0 and d > -5e-4 and w < 0.0) else 0.0
    if p[18] > 0.0:
        soft = p[19] * k
        force = soft * d if d < p[18] else soft * p[18] + k * (d - p[18])
    else:
        force = k * d
    if p[35] > 0.0:
        force = k * d * (d / 1e-3) ** (p[35] - 1.0)
    force += p[16] * d * d + c * w + p[17] * d * w + p[21] * (d - q)
    return max(force, 0.0)


@numba.njit(cache=True)
def _rates(p, mass, y, table_acc, table_disp, t, out):
    u, v, z, q, qr, ql = y[0], y[1], y[2], y[3], y[4], y[5]
    opened = p[34] * t
    dr, dl = u - p[6] - opened - y[6], -u - p[7] - opened - y[8]
    fr = _bumper(p, dr, v - y[7], p[2], p[3], qr, t)
    fl = _bumper(p, dl, -v - y[9], p[4], p[5], ql, t)
    fd = _damper(p, u, v, z, q, t)
    out[0] = v
    out[1] = -(fd + fr - fl) / mass - table_acc - GRAVITY_M_S2 * p[36] * table_disp
    x = v / p[13]
    out[2] = x * (1.0 - abs(z) ** 2 * (0.5 + 0.5 * np.sign(x * z))) if p[12] != 0.0 else 0.0
    out[3] = (u - q) / p[15]
    out[4] = (max(dr, 0.0) - qr) / p[22]
    out[5] = (max(dl, 0.0) - ql) / p[22]
    if p[38] > 0.0:  # each bumper stands on a mass of its own, on a spring with 3 % of damping
        damping = 0.06 * np.sqrt(p[20] * p[38])
        out[6], out[7] = y[7], (fr - p[20] * y[6] - damping * y[7]) / p[38] - table_acc
        out[8], out[9] = y[9], (fl - p[20] * y[8] - damping * y[9]) / p[38] + table_acc
    return fr, fl, fd


@numba.njit(cache=True)
def _integrate(p, mass, acc, disp, dt, out):
    y = np.zeros(10)
    k1, k2, k3, k4, s = np.zeros(10), np.zeros(10), np.zeros(10), np.zeros(10), np.zeros(10)
    for i in range(acc.size // 2):
        t = i * dt
        fr, fl, fd = _rates(p, mass, y, acc[2 * i], disp[2 * i], t, k1)
        out[0, i], out[1, i], out[2, i] = y[0], y[1], k1[1]
        out[3, i], out[4, i], out[5, i] = fr, fl, fd
        s[:] = y + 0.5 * dt * k1
        _rates(p, mass, s, acc[2 * i + 1], disp[2 * i + 1], t + 0.5 * dt, k2)
        s[:] = y + 0.5 * dt * k2
        _rates(p, mass, s, acc[2 * i + 1], disp[2 * i + 1], t + 0.5 * dt, k3)
        s[:] = y + dt * k3
        j = min(2 * i + 2, acc.size - 1)
        _rates(p, mass, s, acc[j], disp[j], t + dt, k4)
        y += dt / 6.0 * (k1 + 2 * k2 + 2 * k3 + k4)


@dataclass(frozen=True)
class Instruments:
    """Errors of the instruments; noises are rms values of one sample in SI."""

    laser: float = 1e-5
    acc: float = 0.01
    cell: float = 1.0
    share: float = 0.52
    share_left: float = 0.48
    gain: float = 0.003  # one standard deviation, of every channel
    lag_s: float = 1e-4
    offset: float = 0.001  # of the rms
    filter_share: float = 0.0  # corner of an anti-alias filter over the rate; 0 for none
    hum: float = 0.0  # of 50 Hz, over the noise of the channel
    beat_hz: float = 0.0
    pink: float = 0.0  # corner of 1/f noise in Hz
    plate_kg: float = 0.0
    bits: int = 0  # of the converter, over the largest reading; 0 for a fine one
    curve: float = 0.0  # of cells and accelerometers: too much at the largest reading, as a share
    skew_s: float = 0.0  # between successive channels of a multiplexed logger
    has_relative_laser: bool = False  # on the table: it reads the mass relative to that
    missing: tuple[str, ...] = ()
    rest_s: float = 2.0
    faults: Mapping[str, float] = field(default_factory=dict)  # gain of a channel


@dataclass(frozen=True)
class StepTest:
    """Stepped sine up and down, with a constant amplitude of the table's acceleration."""

    start_hz: float = 1.6
    stop_hz: float = 4.4
    step_hz: float = 0.4
    cycles: int = 8
    acc: float = 0.05 * GRAVITY_M_S2
    rate_hz: float = 1000.0

    def drive(self, rest_s: float) -> tuple[Float1D, Float1D]:
        """Return (displacement, acceleration) of the table at half the fine step."""
        count = round((self.stop_hz - self.start_hz) / self.step_hz) + 1
        grid = np.linspace(self.start_hz, self.stop_hz, count)
        grid = np.concatenate([grid, grid[::-1]])
        dt = 0.5 / FINE_HZ
        amplitude, phase = [], []
        for hz in grid:
            n = round(self.cycles / hz / dt)
            phase.append(np.full(n, 2 * np.pi * hz * dt))
            amplitude.append(np.full(n, self.acc / (2 * np.pi * hz) ** 2))
        a, rate = np.concatenate(amplitude), np.concatenate(phase)
        smooth = round(0.4 / dt)
        kernel = np.hanning(smooth) / np.hanning(smooth).sum()
        a = oaconvolve(np.concatenate([np.zeros(smooth), a, np.zeros(smooth)]), kernel, "same")
        # no table changes its velocity at once
        rate = np.concatenate([np.full(2 * smooth, rate[0]), rate, np.full(2 * smooth, rate[-1])])
        rate = oaconvolve(rate, kernel, "same")[smooth:-smooth]
        disp = a * np.sin(np.cumsum(rate))
        disp = np.concatenate([np.zeros(round(rest_s / dt)), disp, np.zeros(round(0.5 / dt))])
        acc = np.gradient(np.gradient(disp, dt), dt)
        return disp, acc


def _read(
    values: Float1D, rate_hz: float, noise: float, lab: Instruments, rng: np.random.Generator,
    name: str,
) -> Float1D:  # fmt: skip
    """Return what a channel reads, at the rate of the logger, from values at the fine rate."""
    step = round(FINE_HZ / rate_hz)
    t = np.arange(values.size) / FINE_HZ
    gain = 1.0 + lab.gain * rng.standard_normal() if lab.gain else 1.0
    gain *= lab.faults.get(name, 1.0)
    if lab.curve and not name.endswith("disp_m"):
        values = values * (1.0 + lab.curve * values / np.abs(values).max())
    lag = abs(lab.lag_s * rng.standard_normal())
    read = gain * np.interp(t - lag, t, values)
    fine_noise = rng.standard_normal(values.size) * noise * np.sqrt(step if lab.filter_share else 1)
    if lab.filter_share:
        sos = butter(4, lab.filter_share * rate_hz, fs=FINE_HZ, output="sos")
        read = sosfilt(sos, read + fine_noise)[::step]
    else:
        read = read[::step] + noise * rng.standard_normal(read[::step].size)
    t = t[::step]
    if lab.hum:
        level = 1.0 + 0.5 * np.sin(2 * np.pi * lab.beat_hz * t) if lab.beat_hz else 1.0
        read = read + lab.hum * noise * level * np.sin(2 * np.pi * 50.0 * t + rng.uniform(0, 6.28))
    if lab.pink:
        white = rng.standard_normal(t.size)
        f = np.maximum(np.fft.rfftfreq(t.size, 1 / rate_hz), 1.0 / t[-1])
        read = read + noise * np.fft.irfft(np.fft.rfft(white) * np.sqrt(lab.pink / f), t.size)
    return read + lab.offset * float(values.std()) * rng.standard_normal()


class Test(Protocol):
    """What a table plays, and the rate of the logger."""

    @property
    def rate_hz(self) -> float: ...

    def drive(self, rest_s: float) -> tuple[Float1D, Float1D]:
        """Return (displacement, acceleration) of the table at half the fine step."""


def record(
    specimen: Specimen, lab: Instruments, seed: int, test: Test = StepTest()
) -> dict[str, Float1D]:
    """Return the channels of a recording by canonical name, (sample,) each."""
    rng = np.random.default_rng(seed)
    disp, acc = test.drive(lab.rest_s)
    out = np.zeros((6, acc.size // 2))
    _integrate(specimen.vector(), specimen.mass, acc, disp, 1.0 / FINE_HZ, out)
    disp, acc = disp[::2][: out.shape[1]], acc[::2][: out.shape[1]]
    right, left = out[3], out[4]
    plate = lab.plate_kg * acc
    true = {
        "table_disp_m": disp,
        "table_acc_m_s2": acc,
        "mass_disp_m": out[0] + disp,
        "mass_acc_m_s2": out[2] + acc,
        "force_r1_n": lab.share * right + 0.5 * plate,
        "force_r2_n": (1 - lab.share) * right + 0.5 * plate,
        "force_l1_n": lab.share_left * left - 0.5 * plate,
        "force_l2_n": (1 - lab.share_left) * left - 0.5 * plate,
        "rel_disp_m": out[0],
    }
    noise = {"disp": lab.laser, "acc": lab.acc, "r1": lab.cell, "r2": lab.cell, "l1": lab.cell,
             "l2": lab.cell}  # fmt: skip
    columns = {}
    absent = {*lab.missing, "mass_disp_m" if lab.has_relative_laser else "rel_disp_m"}
    for number, (name, values) in enumerate(true.items()):
        level = noise[name.split("_")[1]]
        time = np.arange(values.size) / FINE_HZ
        skewed = np.interp(time - number * lab.skew_s, time, values) if lab.skew_s else values
        read = _read(skewed, test.rate_hz, level, lab, rng, name)
        if lab.bits:
            step = 2.0 * float(np.abs(read).max()) / 2**lab.bits
            read = step * np.round(read / step)
        if name not in absent:
            columns[name] = read
    size = min(values.size for values in columns.values())
    skip = 0 if lab.rest_s > 0 else round(0.6 * test.rate_hz)
    return {
        "time_s": np.arange(size - skip) / test.rate_hz,
        **{name: values[skip:size] for name, values in columns.items()},
    }


def record_component(
    specimen: Specimen, lab: Instruments, seed: int, frequencies: tuple[float, ...],
    amplitudes_m: tuple[float, ...], rate_hz: float = 1000.0, seconds: float = 20.0,
) -> dict[str, Float1D]:  # fmt: skip
    """Return a component test of the bearing: displacement and force of an actuator."""
    rng = np.random.default_rng(seed)
    p = specimen.vector()
    n = round(seconds * FINE_HZ)
    t = np.arange(n) / FINE_HZ
    us, fs = [], []
    for hz in frequencies:
        for amplitude in amplitudes_m:
            w = 2 * np.pi * hz
            ramp = np.minimum(np.minimum(t, t[-1] - t) / 1.0, 1.0)
            u = amplitude * np.sin(w * t) * np.sin(0.5 * np.pi * ramp) ** 2
            v = np.gradient(u, 1.0 / FINE_HZ)
            fs.append(_play_damper(p, u, v, 1.0 / FINE_HZ))
            us.append(u)
    u, force = np.concatenate(us), np.concatenate(fs)
    return {
        "time_s": np.arange(-(-u.size // round(FINE_HZ / rate_hz))) / rate_hz,
        "rel_disp_m": _read(u, rate_hz, lab.laser, lab, rng, "rel_disp_m"),
        "damper_force_n": _read(force, rate_hz, lab.cell, lab, rng, "damper_force_n"),
    }


@numba.njit(cache=True)
def _play_damper(p, u, v, dt):
    force, z, q = np.empty(u.size), 0.0, 0.0
    for i in range(u.size):
        force[i] = _damper(p, u[i], v[i], z, q, i * dt)
        x = v[i] / p[13]
        if p[12] != 0.0:
            z += dt * x * (1.0 - abs(z) ** 2 * (0.5 + 0.5 * np.sign(x * z)))
        q += dt * (u[i] - q) / p[15]
    return force


def write_table(columns: Mapping[str, Float1D], path: Path) -> Path:
    """Write the columns as comma-separated values."""
    header = ",".join(columns)
    np.savetxt(path, np.column_stack([*columns.values()]), delimiter=",", header=header,
               comments="", fmt="%.9g")  # fmt: skip
    return path


def vary(specimen: Specimen, rng: np.random.Generator) -> Specimen:
    """Return a specimen of the same kind, scattered by 5 %."""
    s = 1.0 + 0.05 * rng.uniform(-1, 1, 4)
    return replace(
        specimen, k=specimen.k * s[0], c=specimen.c * s[1], kb=specimen.kb * s[2],
        cb=specimen.cb * s[3],
    )  # fmt: skip
