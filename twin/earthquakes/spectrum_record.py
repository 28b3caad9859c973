"""Records compatible with a required response spectrum.

A sum of sines with random phases under an envelope of rise, strong part and fall. Its Fourier
amplitudes are multiplied, again and again, by the required over the computed response spectrum
(Gasparini and Vanmarcke, Simulated earthquake motions compatible with prescribed response spectra,
MIT R76-4, 1976), within a band that keeps the displacement finite and at rest at its ends.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from table_io.block import Float1D
from table_io.config.base import format_toml, read_text
from table_io.config.excitation.waveform import smoothstep
from table_io.config.folders import find_config, resolve_config
from table_io.config.profile import MAX_FILE_BYTES, Profile, load_profile
from table_io.config.rig_file import load_rig
from table_io.config.tracking import RequiredSpectrum, parse_required_spectrum
from table_io.errors import InputError
from table_io.units import GRAVITY_M_S2
from twin.results.spectra import (
    USUAL_PER_OCTAVE,
    compute_arias_intensity,
    compute_response_spectrum,
    list_octave_frequencies,
)
from twin.results.tracking import MAX_BAND_RATIO

MATCH_ITERATIONS = 60
CORRECTION_GAIN = 0.6  # exponent on required over computed, per iteration
MATCHED_PER_OCTAVE = 12  # ordinates that are matched: twice as many as are judged
SAMPLES_PER_PERIOD = 10.0  # of the record at the upper end of the spectrum
MIN_RATE_HZ = 100.0
BAND_MARGIN = 2.0**0.5  # of the record beyond either end of the spectrum: half an octave
FILTER_MARGIN = 2.5  # of the filter of the test beyond either end of the spectrum
ROW_BYTES = 23  # of the file of a record, at most: 999.999900,-0.12345678
SIGNIFICANT_SHARES = 0.05, 0.95  # of the Arias intensity: significant duration


@dataclass(frozen=True)
class RecordShape:
    """Shape of a record in time, and of the oscillators of its spectrum.

    `aim` is the ratio to the required spectrum about which the ordinates are to lie.
    """

    duration_s: float = 30.0
    strong_s: float = 20.0
    rise_s: float = 4.0
    damping: float = 0.05
    aim: float = 1.08
    seed: int = 1
    count: int = 1

    def check(self) -> None:
        """Raise InputError if the parts of the record do not fit into its duration."""
        if not 0.0 < self.rise_s < self.rise_s + self.strong_s < self.duration_s:
            raise InputError(
                f"a rise of {self.rise_s:g} s and a strong part of {self.strong_s:g} s do not fit "
                f"into {self.duration_s:g} s",
                allowed="rise + strong < duration, all positive",
            )


@dataclass(frozen=True, eq=False)
class SpectrumRecord:
    """Record in m/s2, (sample,), with its response spectrum over the required one, (ordinate,)."""

    rate_hz: float
    acceleration_m_s2: Float1D
    frequencies_hz: Float1D
    ratios: Float1D

    @property
    def pga_m_s2(self) -> float:
        """Largest acceleration."""
        return float(np.abs(self.acceleration_m_s2).max())

    @property
    def significant_s(self) -> float:
        """Time from 5 to 95 % of the Arias intensity."""
        arias = compute_arias_intensity(self.acceleration_m_s2, self.rate_hz)
        first, last = np.searchsorted(arias, np.multiply(SIGNIFICANT_SHARES, arias[-1]))
        return float(last - first) / self.rate_hz


def make_spectrum_records(
    spectrum: RequiredSpectrum,
    shape: RecordShape,
    report: Callable[[str], None] = lambda stage: None,
    highest_hz: float = math.inf,
) -> list[SpectrumRecord]:
    """Return records compatible with a required spectrum, each with phases of its own.

    They end with the spectrum, or half an octave above it up to `highest_hz`, that of the rig.
    InputError if the record is too short for the lowest frequency of the spectrum.
    """
    shape.check()
    low_hz = float(spectrum.frequencies_hz[0])
    if shape.duration_s * low_hz < 5.0:
        raise InputError(
            f"a record of {shape.duration_s:g} s has fewer than 5 periods of {low_hz:g} Hz",
            allowed=f"a duration from {5.0 / low_hz:.3g} s",
        )
    records = []
    for number in range(shape.count):
        report(f"matching record {number + 1} of {shape.count}")
        records.append(_match_record(spectrum, shape, shape.seed + number, highest_hz))
    return records


def _find_record_rate(high_hz: float) -> float:
    """Return the rate in Hz of a record up to a frequency."""
    return max(MIN_RATE_HZ, 10.0 * math.ceil(0.1 * SAMPLES_PER_PERIOD * high_hz))


def _match_record(
    spectrum: RequiredSpectrum, shape: RecordShape, seed: int, highest_hz: float
) -> SpectrumRecord:
    low_hz, high_hz = spectrum.frequencies_hz[[0, -1]].tolist()
    rate_hz = _find_record_rate(high_hz)
    count = round(shape.duration_s * rate_hz)
    f = np.fft.rfftfreq(count, 1.0 / rate_hz)
    top_hz = min(high_hz * BAND_MARGIN, max(high_hz, highest_hz))
    band = (f >= low_hz / BAND_MARGIN) & (f <= top_hz)
    ln_f = np.log(np.where(band, f, 1.0))
    raw = np.asarray(np.random.PCG64(seed).random_raw(f.size), dtype=np.uint64)
    phases = (raw >> np.uint64(11)) * 2.0**-53
    hz = list_octave_frequencies(low_hz, high_hz, MATCHED_PER_OCTAVE)
    required = shape.aim * spectrum.interpolate(hz)
    envelope = _make_envelope(count, rate_hz, shape)
    amplitudes = np.where(band, np.interp(ln_f, np.log(hz), required) / np.sqrt(np.exp(ln_f)), 0.0)
    best, least = np.zeros(count), math.inf
    for _ in range(MATCH_ITERATIONS):
        motion = envelope * np.fft.irfft(amplitudes * np.exp(2j * math.pi * phases), count)
        motion = np.fft.irfft(np.fft.rfft(motion) * band, count)  # what the envelope spread
        ratios = compute_response_spectrum(motion, rate_hz, hz, shape.damping) / required
        # The factor that puts the extremes at equal distances from the aim.
        factor = 1.0 / math.sqrt(ratios.min() * ratios.max())
        spread = math.log(ratios.max() / ratios.min())
        if spread < least:
            best, least = factor * motion, spread
        amplitudes = amplitudes * np.interp(ln_f, np.log(hz), (factor * ratios) ** -CORRECTION_GAIN)
    judged = list_octave_frequencies(low_hz, high_hz, USUAL_PER_OCTAVE)
    computed = compute_response_spectrum(best, rate_hz, judged, shape.damping)
    return SpectrumRecord(rate_hz, best, judged, computed / spectrum.interpolate(judged))


def _make_envelope(count: int, rate_hz: float, shape: RecordShape) -> Float1D:
    """Return the envelope of a record, 0 to 1, (sample,)."""
    t = np.arange(count) / rate_hz
    fall_s = shape.duration_s - shape.rise_s - shape.strong_s
    rising = smoothstep(t / shape.rise_s)
    falling = smoothstep((t - shape.rise_s - shape.strong_s) / fall_s)
    return rising * (1.0 - falling)


def find_largest_correlation(records: list[SpectrumRecord]) -> float:
    """Return the largest magnitude of the correlation of any two records; 0 of one."""
    pairs = combinations([record.acceleration_m_s2 for record in records], 2)
    return max((abs(float(np.corrcoef(first, other)[0, 1])) for first, other in pairs), default=0.0)


@dataclass(frozen=True)
class SpectrumRecordOptions:
    """File of a required spectrum, profile that the tests are like, and shape of the records.

    `table` is the rig of the tests: a name or the path of a rig file; None: that of the profile.
    """

    spectrum: Path
    like: Path
    shape: RecordShape = RecordShape()
    table: str | None = None


@dataclass(frozen=True, eq=False)
class SpectrumRecordResult:
    """Records of a required spectrum and the texts of the files of their tests, by name."""

    records: tuple[SpectrumRecord, ...]
    largest_correlation: float
    files: dict[str, str]
    profiles: tuple[str, ...]

    def save(self, folder: Path) -> list[Path]:
        """Write all files to a folder; return the paths of the profiles."""
        for name, text in self.files.items():
            (folder / name).write_text(text, encoding="utf-8")
        return [folder / name for name in self.profiles]


def compute_spectrum_records(
    options: SpectrumRecordOptions, report: Callable[[str], None] = lambda stage: None
) -> SpectrumRecordResult:
    """Compute records compatible with a required spectrum, and a test of each.

    A test takes its rig, model, specimen, acquisition, loop check, protection and limits from the
    profile `like`.
    """
    text = read_text(options.spectrum, "required response spectrum")
    spectrum = parse_required_spectrum(text, options.spectrum.name)
    like_path = resolve_config(options.like, "tests")
    like, _ = load_profile(like_path)
    rig, _ = load_rig(find_config(options.table or like.rig, "rigs", like_path))
    _check_test_plays(spectrum, options, like)
    records = make_spectrum_records(spectrum, options.shape, report, rig.limits.frequency_hz)
    files, profiles = {options.spectrum.name: text}, []
    for number, record in enumerate(records, 1):
        stem = f"record_{number}"
        profiles.append(f"{stem}.toml")
        files[f"{stem}.csv"] = _format_record(record, options, number)
        files[f"{stem}.toml"] = _format_profile(record, options, like, stem)
    return SpectrumRecordResult(
        tuple(records), find_largest_correlation(records), files, tuple(profiles)
    )


def _check_test_plays(
    spectrum: RequiredSpectrum, options: SpectrumRecordOptions, like: Profile
) -> None:
    """Raise InputError if a test like `like` cannot judge the spectrum or read the record."""
    high_hz, rate_hz = float(spectrum.frequencies_hz[-1]), like.acquisition.rate_hz
    if high_hz > MAX_BAND_RATIO * rate_hz * (1 + 1e-9):
        raise InputError(
            f"the spectrum ends at {high_hz:g} Hz",
            where=options.spectrum,
            allowed=f"up to {MAX_BAND_RATIO * rate_hz:g} Hz, where the test samples at {rate_hz:g} "
            "Hz",
            remedy=f"set acquisition.rate_hz of {options.like} to "
            f"{high_hz / MAX_BAND_RATIO:g} or more, or end the spectrum earlier",
        )
    longest_s = MAX_FILE_BYTES / ROW_BYTES / _find_record_rate(high_hz)
    if options.shape.duration_s > longest_s:
        raise InputError(
            f"a record of {options.shape.duration_s:g} s up to {high_hz:g} Hz is too large a file",
            where=options.spectrum,
            allowed=f"at most {math.floor(longest_s)} s",
        )


def _format_record(record: SpectrumRecord, options: SpectrumRecordOptions, number: int) -> str:
    shape = options.shape
    lines = [
        f"# Compatible with {options.spectrum.name}: {shape.duration_s:g} s, strong part "
        f"{shape.strong_s:g} s, seed {shape.seed + number - 1}.",
        "time_s,acc_g",
        *(
            f"{index / record.rate_hz:.6f},{value / GRAVITY_M_S2:.8f}"
            for index, value in enumerate(record.acceleration_m_s2.tolist())
        ),
    ]
    return "\n".join(lines) + "\n"


def _format_profile(
    record: SpectrumRecord, options: SpectrumRecordOptions, like: Profile, stem: str
) -> str:
    low_hz, high_hz = record.frequencies_hz[[0, -1]].tolist()
    kept = like.model_dump(exclude_unset=True, include={"loop_check", "protection", "limits"})
    table = {
        "title": f"{options.spectrum.stem}, {stem.replace('_', ' ')}",
        "rig": options.table or like.rig,
        "model": like.model,
        "specimen": like.specimen.model_dump(exclude_none=True),
        "acquisition": like.acquisition.model_dump(exclude_none=True),
        "excitation": {
            "kind": "record",
            "file": f"{stem}.csv",
            "scale": 1.0,
            "baseline": "none",
            # Wider than the record, so that the filter only brings it to rest at its ends.
            "band_hz": [low_hz / FILTER_MARGIN, FILTER_MARGIN * high_hz],
        },
        "tracking": {
            "required_spectrum": options.spectrum.name,
            "damping": options.shape.damping,
            "band_hz": [low_hz, high_hz],
        },
        **kept,
    }
    return format_toml(table)
