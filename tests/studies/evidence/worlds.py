"""Laboratories of any size: specimens, tables, motions and instruments drawn at random.

A mass of 3 kg to 5 t on 0.7 to 7 Hz, with bumpers or without, under a logarithmic sweep, random
motion, an earthquake or bursts of sines. No model is stated, as in a stranger's file, and no gap
where there are load cells.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tests.studies.evidence.laboratory import FINE_HZ, Float1D, Instruments, Specimen

RATES_HZ = (200.0, 250.0, 320.0, 500.0, 640.0, 1000.0, 1600.0, 2000.0)
CELLS = ("force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n")
MISSING: tuple[tuple[str, ...], ...] = ((), (), ("mass_acc_m_s2",), ("table_acc_m_s2",), CELLS)
BURSTS = (0.5, 0.7, 0.85, 1.0, 1.15, 1.4, 1.8)  # over the natural frequency


@dataclass(frozen=True)
class Motion:
    """Motion about the natural frequency of a specimen, in Hz, with an acceleration in m/s2."""

    kind: str  # "sweep", "random", "quake" or "bursts"
    natural_hz: float
    acc: float
    rate_hz: float
    seed: int
    seconds: float

    def drive(self, rest_s: float) -> tuple[Float1D, Float1D]:
        """Return (displacement, acceleration) of the table at half the fine step."""
        dt = 0.5 / FINE_HZ
        t = dt * np.arange(round(self.seconds / dt), dtype=np.float64)
        play = {"sweep": self._sweep, "bursts": self._bursts}.get(self.kind, self._shake)
        still = np.zeros(round(rest_s / dt)), np.zeros(round(0.5 / dt))
        disp: Float1D = np.concatenate([still[0], play(t), still[1]])
        acc: Float1D = np.gradient(np.gradient(disp, dt), dt)
        return disp, acc

    def _ramp(self, t: Float1D, end: float, cycles: float) -> Float1D:
        share = np.clip(np.minimum(t, end - t) * self.natural_hz / cycles, 0.0, 1.0)
        ramp: Float1D = np.sin(0.5 * np.pi * share) ** 2
        return ramp

    def _sweep(self, t: Float1D) -> Float1D:
        low, rate = 0.4 * self.natural_hz, np.log(5.0) / t[-1]
        hz = low * np.exp(rate * t)
        sine = np.sin(2 * np.pi * (hz - low) / rate)
        return self.acc / (2 * np.pi * hz) ** 2 * sine * self._ramp(t, t[-1], 3.0)

    def _shake(self, t: Float1D) -> Float1D:
        rng = np.random.default_rng(self.seed + 77)
        hz = np.fft.rfftfreq(t.size, t[1])
        band = (hz > 0.3 * self.natural_hz) & (hz < 3.0 * self.natural_hz)
        spectrum = np.zeros(hz.size, complex)
        parts = rng.standard_normal((2, band.sum()))
        spectrum[band] = (parts[0] + 1j * parts[1]) / hz[band] ** 2
        envelope = self._ramp(t, t[-1], 3.0)
        if self.kind == "quake":
            envelope = envelope * (6 * t / t[-1]) * np.exp(1 - 6 * t / t[-1])
        disp = np.fft.irfft(spectrum, t.size) * envelope
        strong = np.gradient(np.gradient(disp, t[1]), t[1])[envelope > 0.5].std()
        return disp * self.acc * (1.3 if self.kind == "quake" else 1.0) / strong

    def _bursts(self, t: Float1D) -> Float1D:
        disp, size = np.zeros(t.size), t.size // len(BURSTS)
        own = t[:size]
        for number, ratio in enumerate(np.random.default_rng(self.seed + 77).permutation(BURSTS)):
            w = 2 * np.pi * ratio * self.natural_hz
            sine = self.acc / w**2 * np.sin(w * own) * self._ramp(own, 0.8 * own[-1], 2.0)
            disp[number * size : (number + 1) * size] = sine * (own < 0.8 * own[-1])
        return disp


def draw_world(
    seed: int, hide: str = ""
) -> tuple[Specimen, Instruments, Motion, str, Mapping[str, float]]:
    """Return specimen, instruments, motion, and name and size of what is hidden.

    `hide` is "effect" of the library, "stranger", or nothing.
    """
    rng = np.random.default_rng(9000 + seed)
    mass, natural_hz = 10 ** rng.uniform(0.5, 3.7), 10 ** rng.uniform(np.log10(0.7), np.log10(7))
    ratio_of_damping = rng.uniform(0.03, 0.1)
    w = 2 * np.pi * natural_hz
    k, c = mass * w**2, 2 * ratio_of_damping * mass * w
    acc = rng.uniform(0.05, 0.4) * 9.81 * min(1.0, (natural_hz / 2) ** 2)
    u = min(0.25 * acc / (w**2 * ratio_of_damping), 6 * acc / w**2)
    has_bumpers = bool(rng.integers(2))
    gap = u * rng.uniform(0.4, 0.9) if has_bumpers else np.inf
    ratio = rng.uniform(5, 25)
    kb = ratio * k
    cb = 2 * rng.uniform(0.02, 0.1) * np.sqrt(kb * mass)
    least_hz = 25 * natural_hz * np.sqrt(1 + (ratio if has_bumpers else 0)) / 2
    rate_hz = float(rng.choice([rate for rate in RATES_HZ if rate >= least_hz]))
    noise = 10 ** rng.uniform(-3.3, -2.3)
    lab = Instruments(
        laser=noise * u, acc=2 * noise * acc, cell=noise * (0.3 * kb if has_bumpers else k) * u,
        share=rng.uniform(0.46, 0.54), share_left=rng.uniform(0.46, 0.54),
        filter_share=float(rng.choice([0, 0, 0.2, 0.35])), rest_s=float(rng.choice([0, 2.0, 2.0])),
        missing=MISSING[int(rng.integers(len(MISSING)))], pink=float(rng.choice([0, 0, 0.5])),
        hum=float(rng.choice([0, 0, 1.0])) if rate_hz > 150 else 0.0,
    )  # fmt: skip
    force, v = k * u, w * u
    pools: dict[str, dict[str, dict[str, float]]] = {
        "effect": {
            "cubic_stiffness": {"k3": 0.25 * k / u**2}, "coulomb_friction": {"fc": 0.03 * force},
            "quadratic_damping": {"c2": 0.3 * c / v},
            "bouc_wen": {"bw_force": 0.08 * force, "bw_yield": 0.2 * u},
            "maxwell_damper": {"k1": 0.15 * k, "tau": 0.6 / w},
            "table_tilt": {"tilt": 0.03 * w**2},
        },
        "stranger": {
            "fifth power": {"k5": 0.3 * k / u**4},
            "saturating spring": {"tanh_force": 0.08 * force, "tanh_u": 0.2 * u},
            "warming": {"warming": 0.08}, "u |u|": {"softening": 0.2 * k / u},
            "friction with u": {"friction_u": 0.06 * k},
        },
    }  # fmt: skip
    if has_bumpers:
        relaxation_s = 0.3 / (natural_hz * np.sqrt(ratio) * 2 * np.pi)
        pools["effect"] |= {
            "bumper_hardening": {"k2": 0.8 * kb / u}, "hunt_crossley": {"hc": 8 * cb / u},
            "bumper_asymmetry": {"kr": 1.15 * kb},
            "bumper_maxwell": {"kb": 0.15 * kb, "tau_b": relaxation_s},
        }  # fmt: skip
        pools["stranger"]["soft layer"] = {"soft_depth": 0.1 * u, "soft_share": 0.3}
    names = [*pools.get(hide, {})]
    name = names[int(rng.integers(len(names)))] if names else ""
    hidden = pools[hide][name] if name else {}
    specimen = Specimen(mass, k, c, kb, cb, 2e3 * gap, hidden)
    kind = ("sweep", "random", "quake", "bursts")[seed % 4]
    seconds = min(max(60 / natural_hz, 20), 90)
    return specimen, lab, Motion(kind, natural_hz, acc, rate_hz, seed, seconds), name, hidden


def state_specimen(specimen: Specimen, lab: Instruments) -> dict[str, float]:
    """Return what an import is told: the mass, and the gap where no load cell shows it."""
    is_shown = not {*CELLS} & {*lab.missing} or not np.isfinite(specimen.gap_mm)
    return {"mass_kg": specimen.mass} | ({} if is_shown else {"gap_mm": float(specimen.gap_mm)})
