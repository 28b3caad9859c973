"""What the quality pass finds: bad samples and channels planted in clean recordings, and no others.

    python -m tests.studies.bad_samples planted     10 kinds x 20 sizes: the share that is found
    python -m tests.studies.bad_samples fit         parameters with bad samples, and without them
    python -m tests.studies.bad_samples clean 300   false findings on clean recordings

The recordings are those of the laboratory of the study of evidence, which shares no code with the
product; every instrument of it, 50 Hz to 20 kHz, table tests and component tests.
"""

import re
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from table_io.block import Float1D
from table_io.channels import CHANNEL_BY_NAME
from table_io.errors import InputError
from tests.studies.evidence import laboratory
from tests.studies.evidence.__main__ import draw_clean_cases, draw_component_cases
from tests.studies.evidence.imported import format_profile, import_columns
from tests.studies.evidence.laboratory import StepTest, record, record_component
from twin.compare.quality import find_bad_samples, find_doubts
from twin.discovery.task import identify
from twin.exchange.plausibility import list_implausible

Channels = dict[str, Float1D]
RATES_HZ = (50.0, 100.0, 200.0, 500.0, 1000.0, 2000.0, 5000.0, 10_000.0, 20_000.0)
FAST_HZ = 4000.0  # from which a test is short, as a laboratory would make it
SENTINELS = (-9999.0, 9999.0, 1e10, -1e10, 32767.0, -32768.0, -999.25, 1e30, 0.0, 65535.0)
SIZES = range(20)
# Seeds of table tests in which every channel has another one of its motion, and the bumpers touch.
COMPLETE = (0, 1, 3, 4, 8, 10, 11)


@cache
def make_clean(
    seed: int, component: bool, rate_hz: float, is_long: bool = False
) -> Mapping[str, Float1D]:
    """Return the channels of a clean recording, (sample,) each; a long one can be fitted."""
    fine_hz = laboratory.FINE_HZ
    laboratory.FINE_HZ = max(16_000.0 if 16_000.0 % rate_hz == 0.0 else 20_000.0, rate_hz)
    try:
        if component:
            case = next(draw_component_cases(range(seed, seed + 1)))
            assert case.component is not None
            hz, amplitudes, _ = case.component
            seconds = 40.0 if is_long else 4.0 if rate_hz >= FAST_HZ else 12.0
            columns = record_component(
                case.specimen, case.lab, seed, hz, amplitudes, rate_hz, seconds
            )
        else:
            case = next(draw_clean_cases(range(seed, seed + 1)))
            columns = record(case.specimen, case.lab, seed, _make_test(rate_hz, is_long))
    finally:
        laboratory.FINE_HZ = fine_hz
    return {name: values for name, values in columns.items() if name != "time_s"}


def _make_test(rate_hz: float, is_long: bool) -> StepTest:
    step_hz, cycles = 1.2 if rate_hz >= FAST_HZ else 0.8, 15 if is_long else 6
    return StepTest(2.0, 4.4, step_hz, cycles=cycles, rate_hz=rate_hz)


def list_findings(channels: Mapping[str, Float1D], rate_hz: float) -> set[tuple[str, str]]:
    """Return (kind, channel) of all that the product finds."""
    gaps = find_bad_samples(channels)
    good = {name: np.array(values) for name, values in channels.items()}
    for gap in gaps:
        good[gap.channel][gap.index : gap.end] = np.nan
    units = {name: CHANNEL_BY_NAME[name].unit for name in channels}
    return {
        *((gap.reason, gap.channel) for gap in gaps),
        *((doubt.kind, name) for doubt in find_doubts(good, rate_hz) for name in doubt.channels),
        *(
            ("unit", name)
            for each in list_implausible(good, units, rate_hz)
            if not each.is_possible
            for name in each.channels
        ),
    }


def _choose(rng: np.random.Generator, channels: Channels, prefixes: tuple[str, ...]) -> str:
    """Return a channel in motion whose name begins with one of these."""
    return str(rng.choice(_list_loud(channels, prefixes)))


def _list_loud(channels: Channels, prefixes: tuple[str, ...]) -> list[str]:
    """Return the channels that move far beyond their noise."""
    return [
        name
        for name, values in channels.items()
        if name.startswith(prefixes)
        and np.std(values) > 10.0 * np.median(np.abs(np.diff(values, 2))) / 1.65
    ]


def plant(
    kind: str, size: int, channels: Channels, rate_hz: float, rng: np.random.Generator
) -> tuple[Channels, str, Float1D]:
    """Return (channels with a fault of one of SIZES, its channel, its samples as True)."""
    bad = {name: np.array(values) for name, values in channels.items()}
    share = size / (len(SIZES) - 1)
    if kind in ("clipped", "stuck", "wild"):
        return _plant_samples(kind, size, share, bad, rate_hz, rng)
    at = np.zeros(len(next(iter(bad.values()))), dtype=bool)
    is_component = "damper_force_n" in bad
    sensors = ("table_disp", "table_acc", "mass_disp", "mass_acc")
    name = "damper_force_n" if is_component else _choose(rng, bad, sensors)
    if kind == "held":
        hold = 2 + size // 2
        for each in [name] if size % 2 else bad:
            bad[each] = bad[each][np.arange(at.size) // hold * hold]
    elif kind == "reversed":
        bad[name] = -bad[name]
    elif kind in ("delayed", "another start"):
        least_s = 0.05 if is_component else 0.008
        delay_s = least_s + 0.1 * share if kind == "delayed" else 0.3 + 2.0 * share
        lag = max(round(delay_s * rate_hz), 4)
        cut = {each: values[lag:] for each, values in bad.items()}
        cut[name] = bad[name][:-lag]
        return cut, name, at[lag:]
    elif kind == "swapped":
        pairs = [
            ("mass_disp_m", "table_disp_m"), ("force_r1_n", "force_l1_n"),
            ("table_disp_m", "table_acc_m_s2"), ("mass_disp_m", "mass_acc_m_s2"),
            ("damper_force_n", "rel_disp_m"),
        ]  # fmt: skip
        pairs = [p for p in pairs if {*p} <= bad.keys() and p[1] in _list_loud(bad, p)]
        name, other = pairs[size % len(pairs)]
        bad[name], bad[other] = bad[other], bad[name]
        if name == "force_r1_n":
            bad["force_r2_n"], bad["force_l2_n"] = bad["force_l2_n"], bad["force_r2_n"]
    else:
        factors = {"unit 9.81, 1000": (9.80665, 1000.0), "unit 25.4": (25.4, 25.4)}[kind]
        factor = factors[size % 2]
        bad[name] = bad[name] * (factor if size // 2 % 2 else 1.0 / factor)
    return bad, name, at


def _plant_samples(
    kind: str, size: int, share: float, bad: Channels, rate_hz: float, rng: np.random.Generator
) -> tuple[Channels, str, Float1D]:
    """Return the channels with bad samples in one of them, as `plant` does."""
    name = _choose(rng, bad, ("",))
    x = bad[name]
    count, middle = x.size, slice(x.size // 3, 2 * x.size // 3)
    at = np.zeros(count, dtype=bool)
    if kind == "clipped":
        middle_value = np.median(x)
        limit = float(np.quantile(np.abs(x - middle_value), 0.99 - 0.4 * share))
        limit = max(limit, 6.0 * float(np.median(np.abs(np.diff(x, 2)))))  # beyond its noise
        bad[name] = np.clip(x, middle_value - limit, middle_value + limit)
        return bad, name, bad[name] != x
    if kind == "stuck":
        first = middle.start + int(np.argmax(np.abs(np.diff(x))[middle]))  # while it moves
        length = max(6, round((0.03 + 1.0 * share) * rate_hz))
        bad[name] = x.copy()
        bad[name][first : first + length] = x[first]
        at[first + 1 : first + length] = True
        return bad, name, at
    value = SENTINELS[size % len(SENTINELS)]
    for _ in range(1 + size // 4):
        first = int(rng.integers(10, count - 10))
        if value == 0.0:  # where a dropout shows
            first = middle.start + int(np.argmax(np.abs(x[middle])))
        length = 1 if size < 10 else 1 + int(rng.integers(3))
        x[first : first + length] = value
        at[first : first + length] = True
    return bad, name, at


KINDS = (
    "clipped", "stuck", "held", "wild", "reversed", "delayed", "another start", "swapped",
    "unit 9.81, 1000", "unit 25.4",
)  # fmt: skip


@dataclass(frozen=True)
class Planted:
    """A recording, the same one with a fault in a channel, and which of its samples are bad."""

    seed: int
    component: bool
    rate_hz: float
    clean: Mapping[str, Float1D]
    bad: Channels
    name: str
    at: Float1D


def draw_planted(kind: str, size: int, seed: int = 0, is_long: bool = False) -> Planted:
    """Return a recording with a fault of a kind."""
    rng = np.random.default_rng([seed, size, KINDS.index(kind)])
    component = size % 2 == 0 and not kind.startswith("unit") and kind != "swapped"
    rate_hz = float(rng.choice(RATES_HZ[3:6] if is_long else RATES_HZ[1:6]))
    case = (COMPLETE if not component else range(7))[size % 7]
    clean = make_clean(case, component, rate_hz, is_long)
    return Planted(case, component, rate_hz, clean, *plant(kind, size, {**clean}, rate_hz, rng))


def is_found(kind: str, size: int, seed: int = 0) -> bool:
    """Return True if a planted fault is found, as what it is or as what looks the same."""
    planted = draw_planted(kind, size, seed)
    bad, name, at, rate_hz = planted.bad, planted.name, planted.at, planted.rate_hz
    findings = list_findings(bad, rate_hz)
    if at.any():
        gaps = [g for g in find_bad_samples(bad) if g.channel == name]
        marked = np.zeros(at.size, dtype=bool)
        for gap in gaps:
            marked[gap.index : gap.end] = True
        return bool((marked & at).sum() >= 0.9 * at.sum())
    wanted = {
        "delayed": ("delayed", "reversed"), "another start": ("delayed", "reversed"),
        "swapped": ("swapped", "delayed", "reversed", "unit"), "held": ("held",),
        "reversed": ("reversed",),
    }.get(kind, ("unit",))  # fmt: skip
    return any(finding in wanted for finding, _ in findings)


def fit(planted: Planted, channels: Channels) -> dict[str, tuple[float, float]]:
    """Return (value, half width) of the parameters identified from an import of channels."""
    profile = ""
    if not planted.component:
        case = next(draw_clean_cases(range(planted.seed, planted.seed + 1)))
        profile = format_profile(case.specimen, _make_test(planted.rate_hz, is_long=True))
    time_s = np.arange(len(next(iter(channels.values())))) / planted.rate_hz
    with tempfile.TemporaryDirectory() as folder:
        log = import_columns({"time_s": time_s, **channels}, Path(folder), profile)
        parameters = identify([log]).report.parameters
    return {
        name: (each.value, 0.5 * (each.high - each.low))
        for name, each in parameters.items()
        if each.low is not None and each.high is not None
    }


def compare_fits(kind: str, size: int, seed: int) -> dict[str, float]:
    """Return by parameter how far bad samples move it, in half widths of its interval."""
    planted = draw_planted(kind, size, seed, is_long=True)
    absent = {name: np.array(values) for name, values in planted.clean.items()}
    absent[planted.name][planted.at] = np.nan
    try:
        without = fit(planted, absent)
    except InputError as error:  # too little is left
        with pytest.raises(InputError, match=re.escape(str(error))):
            fit(planted, planted.bad)
        return {"refused alike": 0.0}
    with_bad = fit(planted, planted.bad)
    return {name: (with_bad[name][0] - value) / half for name, (value, half) in without.items()}


def main(what: str, count: int = 0) -> None:
    """Print the counts of the study: of `count` recordings, or of the seed `count`."""
    seed = count
    start = time.process_time()
    if what == "clean":
        false = 0
        for case in range(count):
            rate_hz = RATES_HZ[case % len(RATES_HZ)]
            clean = make_clean(case, case % 3 == 0, rate_hz)
            if findings := list_findings(clean, rate_hz):
                false += 1
                print(f"seed {case} at {rate_hz:g} Hz: {sorted(findings)}", flush=True)
            make_clean.cache_clear()
        print(f"{false} of {count} clean recordings with a finding")
    elif what == "fit":
        for kind, size in product(("clipped", "stuck", "wild"), SIZES):
            moved = compare_fits(kind, size, seed)
            worst = max(moved, key=lambda name: abs(moved[name]))
            print(f"{kind} {size}: {worst} {moved[worst]:+.2f} half widths", flush=True)
    else:
        for kind in KINDS:
            missed = [size for size in SIZES if not is_found(kind, size, seed)]
            print(
                f"{kind}: {len(SIZES) - len(missed)} of {len(SIZES)}, missed {missed}", flush=True
            )
    print(f"{time.process_time() - start:.0f} s")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "planted", *map(int, sys.argv[2:3]))
