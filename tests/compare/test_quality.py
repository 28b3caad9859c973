"""Samples and channels that cannot be right: found where they were planted, and nowhere else."""

from collections.abc import Callable

import numpy as np
import pytest

from table_io.block import Block, Float1D
from table_io.errors import InputError
from tests.earthquakes.hydraulic_rig import make_random_motion
from tests.studies.bad_samples import KINDS, RATES_HZ, is_found, list_findings, make_clean
from twin.compare.quality import clean_blocks, find_bad_samples, find_doubts, find_hold

RATE_HZ = 200.0
TIME = np.arange(3000) / RATE_HZ
RAMP = np.clip((TIME - 1.0) / 2.0, 0.0, 1.0) * np.clip((14.0 - TIME) / 2.0, 0.0, 1.0)
DISP: Float1D = RAMP * (0.01 * np.sin(2 * np.pi * 0.9 * TIME) + 0.004 * np.sin(15.0 * TIME))
FORCE: Float1D = 36e3 * DISP + 1.1e3 * np.gradient(DISP, TIME)
NOISE = np.random.default_rng(5).normal(size=(2, TIME.size))
CLEAN = {"rel_disp_m": DISP + 1e-5 * NOISE[0], "damper_force_n": FORCE + NOISE[1]}
FIRST_BAD = 1400  # a sample in motion


def change(name: str, alter: Callable[[Float1D], Float1D]) -> dict[str, Float1D]:
    return {**CLEAN, name: alter(CLEAN[name].copy())}


def set_samples(first: int, values: list[float]) -> Callable[[Float1D], Float1D]:
    def alter(x: Float1D) -> Float1D:
        x[first : first + len(values)] = values
        return x

    return alter


def find(channels: dict[str, Float1D]) -> dict[tuple[str, str], list[int]]:
    """Return the bad samples by (channel, reason)."""
    samples: dict[tuple[str, str], list[int]] = {}
    for gap in find_bad_samples(channels):
        samples.setdefault((gap.channel, gap.reason), []).extend(range(gap.index, gap.end))
    return samples


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("damper_force_n", [-9999.0]),
        ("damper_force_n", [1e10, 1e10]),
        ("damper_force_n", [32767.0, -32768.0, 32767.0]),
        ("damper_force_n", [-9999.0] * 40),
        ("rel_disp_m", [-9.999]),
        ("rel_disp_m", [0.05]),
    ],
)
def test_find_bad_samples_finds_wild_ones(name: str, values: list[float]) -> None:
    expected = {(name, "wild"): [*range(FIRST_BAD, FIRST_BAD + len(values))]}
    assert find(change(name, set_samples(FIRST_BAD, values))) == expected


def test_find_bad_samples_finds_a_dropout_to_zero_and_a_wild_end() -> None:
    top = int(np.argmax(FORCE))
    assert find(change("damper_force_n", set_samples(top, [0.0]))) == {
        ("damper_force_n", "wild"): [top]
    }
    assert find(change("damper_force_n", set_samples(0, [-9999.0] * 30))) == {
        ("damper_force_n", "wild"): [*range(30)]
    }


def test_find_bad_samples_takes_a_jump_in_several_channels_for_an_impact() -> None:
    impact = change("damper_force_n", set_samples(FIRST_BAD, [1000.0]))
    impact["rel_disp_m"] = set_samples(FIRST_BAD, [0.02])(impact["rel_disp_m"].copy())
    assert find(impact) == {}


@pytest.mark.parametrize("share", [0.95, 0.7, 0.4])
def test_find_bad_samples_finds_what_is_clipped(share: float) -> None:
    limit = share * float(np.abs(CLEAN["damper_force_n"]).max())
    clipped = change("damper_force_n", lambda x: np.clip(x, -limit, limit))
    ((place, samples),) = find(clipped).items()
    assert place == ("damper_force_n", "clipped")
    changed = np.flatnonzero(clipped["damper_force_n"] != CLEAN["damper_force_n"])
    assert set(changed.tolist()) == set(samples)


def test_find_bad_samples_finds_a_sensor_that_is_stuck_and_no_rest() -> None:
    stuck = change(
        "rel_disp_m", set_samples(FIRST_BAD, [float(CLEAN["rel_disp_m"][FIRST_BAD])] * 60)
    )
    assert find(stuck) == {("rel_disp_m", "stuck"): [*range(FIRST_BAD, FIRST_BAD + 60)]}
    to_end = [float(CLEAN["rel_disp_m"][FIRST_BAD])] * (TIME.size - FIRST_BAD)
    assert len(
        find(change("rel_disp_m", set_samples(FIRST_BAD, to_end)))["rel_disp_m", "stuck"]
    ) == (TIME.size - FIRST_BAD)
    without_noise = {"rel_disp_m": DISP, "damper_force_n": FORCE}
    assert find(without_noise) == {}
    assert find({"rel_disp_m": DISP * (TIME > 3), "damper_force_n": FORCE * (TIME > 3)}) == {}


@pytest.mark.parametrize("steps", [20, 100, 1000])
def test_find_bad_samples_takes_a_coarse_converter_for_what_it_is(steps: int) -> None:
    coarse = {name: np.round(x * steps / x.max()) * x.max() / steps for name, x in CLEAN.items()}
    assert find(coarse) == {}
    assert not any(find_hold(values) for values in coarse.values())
    slow = np.round(0.5 * steps * np.sin(0.5 * TIME))
    assert find({"rel_disp_m": slow, "damper_force_n": 2.0 * slow}) == {}


def test_find_bad_samples_takes_no_rounded_peak_for_clipping() -> None:
    """A random motion at 1 kHz through 18 bits stands in its highest value for 3 or 4 samples."""
    for seed in range(20):
        motion = make_random_motion(20.0, (0.3, 35.0), 0.2, seed)
        step = 0.12 / 2**18
        assert find({"table_disp_m": np.round(motion / step) * step}) == {}
        limit = 0.95 * np.abs(motion).max()
        clipped = np.round(np.clip(motion, -limit, limit) / step) * step
        assert list(find({"table_disp_m": clipped})) == [("table_disp_m", "clipped")]


@pytest.mark.parametrize("hold", [2, 3, 10])
def test_find_doubts_finds_a_channel_that_is_held(hold: int) -> None:
    held = change("damper_force_n", lambda x: x[np.arange(x.size) // hold * hold])
    (doubt,) = find_doubts(held, RATE_HZ)
    assert (doubt.kind, doubt.channels) == ("held", ("damper_force_n",))
    assert f"{RATE_HZ / hold:.4g} Hz" in doubt.problem


@pytest.mark.parametrize("name", ["damper_force_n", "rel_disp_m"])
def test_find_doubts_finds_a_force_that_does_work(name: str) -> None:
    (doubt,) = find_doubts(change(name, np.negative), RATE_HZ)
    assert (doubt.kind, doubt.channels) == ("reversed", ("damper_force_n", "rel_disp_m"))
    assert "gain = -1.0" in doubt.remedy
    assert find_doubts(CLEAN, RATE_HZ) == []


def test_find_doubts_takes_a_negative_stiffness_for_what_it_is() -> None:
    outward = -5e3 * DISP + 1.1e3 * np.gradient(DISP, TIME)
    assert find_doubts({**CLEAN, "damper_force_n": outward + NOISE[1]}, RATE_HZ) == []


@pytest.mark.parametrize("delay", [20, 60, 300])
def test_find_doubts_finds_a_force_that_is_late(delay: int) -> None:
    late = change("damper_force_n", lambda x: np.roll(x, delay))
    kinds = {doubt.kind for doubt in find_doubts(late, RATE_HZ)}
    assert kinds & {"delayed", "reversed"}


def test_find_doubts_of_load_cells() -> None:
    """A cell counted the other way; and cells in each other's place."""
    u = np.sin(2 * np.pi * TIME) + 0.01 * NOISE[0]
    right, left = (1e3 * np.clip(sign * u - 0.5, 0.0, None) + NOISE[1] for sign in (1.0, -1.0))
    cells = {"rel_disp_m": 0.01 * u, "force_r1_n": right, "force_l1_n": left}
    assert find_doubts(cells, RATE_HZ) == []
    (pulls,) = find_doubts({**cells, "force_r1_n": -right}, RATE_HZ)
    assert (pulls.kind, pulls.channels) == ("reversed", ("force_r1_n",))
    (swapped,) = find_doubts({**cells, "force_r1_n": left, "force_l1_n": right}, RATE_HZ)
    assert (swapped.kind, swapped.channels) == ("swapped", ("force_r1_n", "force_l1_n"))


@pytest.mark.parametrize(
    ("alter", "kind"),
    [
        (lambda acc: -acc, "reversed"),
        (lambda acc: np.roll(acc, 4), "delayed"),
        (lambda acc: np.roll(acc, 200), "delayed"),
        (lambda acc: 9.80665 * acc, "unit"),
        (lambda acc: acc / 25.4, "unit"),
    ],
)
def test_find_doubts_of_an_accelerometer(alter: Callable[[Float1D], Float1D], kind: str) -> None:
    acc = np.gradient(np.gradient(DISP, TIME), TIME) + 0.01 * NOISE[1]
    table = {"table_disp_m": CLEAN["rel_disp_m"], "table_acc_m_s2": acc}
    assert find_doubts(table, RATE_HZ) == []
    (doubt,) = find_doubts({**table, "table_acc_m_s2": alter(acc)}, RATE_HZ)
    assert (doubt.kind, {*doubt.channels}) == (kind, {*table})


@pytest.mark.parametrize(("drift_s", "middle_s"), [(0.04, 0.0), (-0.04, 0.0), (0.04, 50.0)])
def test_find_doubts_of_clocks_that_drift(drift_s: float, middle_s: float) -> None:
    """Where they agree at first, or in the middle, so that no mean delay is left."""
    time = np.arange(20_000) / RATE_HZ
    disp = 0.01 * np.sin(2 * np.pi * 0.9 * time) + 0.004 * np.sin(15.0 * time)
    acc = np.gradient(np.gradient(disp, time), time)
    late = np.interp(time - drift_s * (time - middle_s) / time[-1], time, acc)
    assert find_doubts({"table_disp_m": disp, "table_acc_m_s2": acc}, RATE_HZ) == []
    (doubt,) = find_doubts({"table_disp_m": disp, "table_acc_m_s2": late}, RATE_HZ)
    assert doubt.kind == "drifting"
    assert f"{abs(drift_s):g} s" in doubt.problem


@pytest.mark.parametrize("amplification", [0.1, 0.7, 1.3, 8.0])
def test_find_doubts_of_a_laser_on_the_table(amplification: float) -> None:
    """At any motion of the mass that its own noise does not hide."""
    mass = amplification * np.roll(DISP, 12)
    accs = [np.gradient(np.gradient(disp, TIME), TIME) for disp in (DISP, mass)]
    channels = {
        "table_disp_m": CLEAN["rel_disp_m"],
        "table_acc_m_s2": accs[0] + 0.01 * NOISE[0],
        "mass_disp_m": mass + 1e-5 * NOISE[1],
        "mass_acc_m_s2": accs[1] + 0.01 * NOISE[1],
    }
    assert find_doubts(channels, RATE_HZ) == []
    (doubt,) = find_doubts({**channels, "mass_disp_m": mass - DISP}, RATE_HZ)
    assert doubt.kind == "mounted"
    assert "rel_disp_m" in doubt.remedy


def test_find_doubts_takes_no_narrow_band_for_a_delay() -> None:
    """A slow sweep, whose lines lie so close that a delay and a high pass look alike."""
    for low_hz, high_hz, corner_hz in ((0.84, 1.36, 0.0), (2.5, 3.3, 0.0), (1.6, 2.4, 0.25)):
        phase = np.cumsum(2 * np.pi * (low_hz + (high_hz - low_hz) * TIME / TIME[-1])) / RATE_HZ
        disp = 0.01 * RAMP * (1.0 + 0.3 * np.sin(0.7 * TIME)) * np.sin(phase)
        acc = np.gradient(np.gradient(disp, TIME), TIME)
        if corner_hz:
            lines = 1j * np.fft.rfftfreq(TIME.size, 1.0 / RATE_HZ)
            acc = np.fft.irfft(np.fft.rfft(acc) * lines / (lines + corner_hz), TIME.size)
        table = {
            "table_disp_m": disp + 1e-5 * NOISE[0],
            "table_acc_m_s2": acc + 0.01 * NOISE[1],
        }
        assert find_doubts(table, RATE_HZ) == []


def make_blocks(channels: dict[str, Float1D]) -> list[Block]:
    """Return blocks of 100 samples from sample 50 on; the third one is lost."""
    none = np.zeros(100, dtype=np.int64)
    values = np.array([*channels.values()])
    return [
        Block("meas", 50 + k, RATE_HZ, tuple(channels), values[:, k : k + 100], none, none, none)
        for k in range(0, TIME.size, 100)
        if k != 200
    ]


def test_clean_blocks_takes_out_what_is_bad_and_says_so() -> None:
    blocks, lines = clean_blocks(make_blocks(CLEAN), "a.mcap")
    assert lines == []
    wild = make_blocks(change("damper_force_n", set_samples(FIRST_BAD, [-9999.0])))
    blocks, lines = clean_blocks(wild, "a.mcap")
    (block,) = [block for block in blocks if np.isnan(block.values).any()]
    assert np.argwhere(np.isnan(block.values)).tolist() == [[1, FIRST_BAD % 100]]
    assert block.index == FIRST_BAD + 50 - FIRST_BAD % 100
    (line,) = lines
    assert "damper_force_n" in line
    assert "-9999 N" in line
    with pytest.raises(InputError, match="reversed"):
        clean_blocks(make_blocks(change("damper_force_n", np.negative)), "a.mcap")


@pytest.mark.parametrize(("kind", "size"), [(kind, 7 * k % 20) for k, kind in enumerate(KINDS)])
def test_planted_faults_of_an_independent_laboratory_are_found(kind: str, size: int) -> None:
    assert is_found(kind, size)


@pytest.mark.parametrize(("seed", "component"), [(0, True), (1, False), (3, False)])
@pytest.mark.parametrize("rate_hz", [RATES_HZ[0], RATES_HZ[4]])
def test_clean_recordings_of_an_independent_laboratory_have_no_finding(
    seed: int, component: bool, rate_hz: float
) -> None:
    assert list_findings(make_clean(seed, component, rate_hz), rate_hz) == set()
