"""Residuals: measured minus modelled forces, evaluated on the measured motion.

    damper            -M a - F_R - F_L - D; the damper force from the force balance, or measured
    right, left       F_R - model, -(F_L - model), where contact was measured
    mass, table       sensor-consistency residuals, see `motion`
    right, left cells difference of the two load cells of a side
    right, left pull  tension of a side just after release, where every bumper law gives zero force
    rest              reading of each channel before the motion starts, and of u; one entry each
Each row is divided by its noise. Without load cells the damper row holds all forces, and contact
comes from the model. Nothing is simulated (inverse dynamics), so a fit converges from distant start
values and in chaotic motion.

Residuals of real rigs are autocorrelated (colored): statistics use blocks, never single samples.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.ndimage import convolve1d, maximum_filter1d

from table_io.block import Bool2D, Float1D, Float2D, Int1D, Label
from table_io.channels import LEFT_CELLS, RIGHT_CELLS
from twin.compare.spectra import exclude_margins
from twin.discovery.contact import find_contact_thresholds, read_contact
from twin.discovery.facts import BlockBasis
from twin.discovery.motion import (
    ConsistencyResidual,
    MeasuredMotion,
    RecordScale,
    measure_scale,
)
from twin.discovery.noise import number_bands
from twin.discovery.parameters import SLIP_SPEED, NuisanceKey, ParameterSet
from twin.discovery.signals import LOST_MARGIN_S, LogSignals, derives_acc
from twin.model.inverse_dynamics import depends_on_history, forces_along
from twin.model.model import Model, SensorModel

MAX_GAP_ERROR_M = 1e-3  # of the readings of the set-up: with more, a gap is to be measured again
CONTACT_MARGIN_S = 0.012  # around contact and release, where the low pass smears the force step
# The same after an anti-alias filter: periods of its corner until its response to a step has died.
FILTER_SETTLING_CYCLES = 3.0
BLOCK_S = 1.0  # block length where there are no forcing cycles
FORCE_ROWS = ("damper", "right", "left")
CONTACT_ROWS = ("right", "left")
TARED_CHANNELS = ("acc", "right", "left")
PULL_ROWS = ("right pull", "left pull")
PULLING_CELLS = {"right pull": "right cells", "left pull": "left cells"}
# of the largest contact force: undershoot of the low pass after a release
MAX_UNDERSHOOT_SHARE = 0.005
MAX_RESIDUAL = 1e30  # times the noise: beyond it a model diverges, however far
MAX_CACHED_MOTIONS = 3  # for assumed sensor models other than the nominal one
MAX_KNOWN_FORCES = 8  # of the models last evaluated, which limits memory
MAX_SAMPLES = 120_000  # moving samples of all logs together; limits time and memory


@dataclass(frozen=True, slots=True)
class Nuisance:
    """Nuisance of a log: kind and place (channel or side), and typical size in its SI unit.

    `usual` is that of an ordinary laboratory, where the log itself shows another one.
    """

    kind: str
    place: str
    size: float
    unit: str = ""
    usual: float = 0.0


@dataclass(frozen=True, eq=False)
class NuisanceTerms:
    """Linear terms of a log: `columns`, (nuisance, entry) without the rest row, per typical size.

    `centre` are the values, (nuisance,), for which the `raw` signals have been corrected already.
    """

    raw: LogSignals
    log_number: int
    nuisances: tuple[Nuisance, ...]
    columns: npt.NDArray[np.float32]
    centre: Float1D

    @cached_property
    def keys(self) -> tuple[NuisanceKey, ...]:
        """Keys of the nuisances in a parameter set."""
        return tuple(NuisanceKey(self.log_number, n.kind, n.place) for n in self.nuisances)

    def values(self, parameters: ParameterSet) -> Float1D:
        """Return the values of the nuisances in a parameter set, (nuisance,)."""
        return np.array([parameters.values.get(key, 0.0) for key in self.keys])


@dataclass(frozen=True, slots=True, eq=False)
class ConsistencyEntries:
    """Entries of a consistency residual over their noise, (entry,).

    `slope` is their change per m/s2 of a tare error of the accelerometer, (entry,).
    """

    body: str
    values: Float1D
    slope: Float1D


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """Motion at the samples where forces are needed, and whole: some depend on its history.

    `contact` (2, sample) is the contact state at these samples. `known_forces` are those of the
    last models and tare errors of u: some parameters of a fit, as other tares, change no force.
    """

    whole: MeasuredMotion
    samples: Int1D | slice
    m: MeasuredMotion
    contact: npt.NDArray[np.int8]
    consistency: tuple[ConsistencyEntries, ...] = ()
    known_forces: list[tuple[Model, float, Float2D]] = field(default_factory=list)

    @cached_property
    def largest_pushes(self) -> tuple[float, float]:
        """Largest measured force of the right and of the left side of the whole motion in N."""
        return float(np.nanmax(self.whole.right)), float(np.nanmax(self.whole.left))


@dataclass(frozen=True, eq=False)
class LogResiduals:
    """Regression problem of one log: residual rows, sample selection, blocks and noise.

    `log_number` is the index of the log; `reference` supplies the stiffness and damping that
    convert noise of the motion into noise of the forces. `contact_n` is a least contact threshold
    in N, which may be 0: see `contact_thresholds_n`.
    """

    log_number: int
    signals: LogSignals
    contact_n: float
    reference: Model
    scale: RecordScale
    # Noise multiplier of each row, and of "rest", by name; above 1 where errors that are no noise
    # of a sensor limit the fit.
    weights: Mapping[str, float] = field(default_factory=dict)
    thinning: int = 1  # keep one in `thinning` of the cycles of a step and of the other blocks
    nuisances: NuisanceTerms | None = None
    known_contact: npt.NDArray[np.int8] | None = None  # (2, sample), else from the load cells
    # What repeated cycles show of the noise of each row, over that of the sensors, (band,).
    noise_scale: Mapping[str, Float1D] = field(default_factory=dict)
    # Of the residuals that these are a copy of: noise of the rows, and samples of each row.
    fixed_noise: tuple[Float1D, ...] | None = None
    fixed_mask: Bool2D | None = None
    # Mean square of the entries of each row, by name, of noise and unknown errors alone.
    expected_squares: Mapping[str, float] = field(default_factory=dict)
    # Highest frequency of the facts of the bumpers' rows in Hz, by name.
    row_bands: Mapping[str, float] = field(default_factory=dict)
    is_sampled: bool = False  # entries are samples, for maps and subsets, in place of facts
    motion_cache: list[tuple[tuple[SensorModel, ...], MeasuredMotion]] = field(default_factory=list)

    def motion(self, sensors: tuple[SensorModel, ...] = ()) -> MeasuredMotion:
        """Return the motion for assumed sensor models; the most recent ones are cached."""
        motion = next((m for key, m in self.motion_cache if key == sensors), None)
        if motion is None:
            motion = self.signals.fuse_motion(sensors)
            unmodified = [pair for pair in self.motion_cache if not pair[0]]
            recent = [pair for pair in self.motion_cache if pair[0]][-MAX_CACHED_MOTIONS + 1 :]
            # a single assignment, because other threads may be reading
            self.motion_cache[:] = [*unmodified, *recent, (sensors, motion)]
        return motion

    @property
    def knows_noise(self) -> bool:
        """Whether readings at rest, or cycles that repeat, show the noise of the forces."""
        m = self.motion()
        repeats = (m.label == Label.MEASURE) & (m.step >= 0) & (m.cycle > 0)
        return bool(self.signals.rest_noise) or bool(repeats.any())

    @cached_property
    def contact_state(self) -> npt.NDArray[np.int8]:
        """Measured contact of right and left, (2, sample): 1 contact, 0 none, -1 unknown."""
        if self.known_contact is not None:
            return self.known_contact
        m = self.motion()
        if not m.has_load_cells:
            right, left = m.gaps_m
            excess = max(float(np.nanmax(m.u)) - right, float(np.nanmax(-m.u)) - left)
            known = -1 if excess > -MAX_GAP_ERROR_M else 0
            return np.full((2, m.u.size), known, dtype=np.int8)
        return read_contact(self.signals, m, self.contact_thresholds_n)

    @cached_property
    def contact_thresholds_n(self) -> tuple[float, float]:
        """Force of the right and of the left cells in N above which there is contact."""
        return find_contact_thresholds(self.signals, self.motion(), self.contact_n)

    @cached_property
    def shows_bumpers(self) -> bool:
        """Whether forces of the bumpers can be in the residual: not if no contact is long enough.

        It is seen between the margins in which filters settle: in the rows of the load cells, or
        without them beyond the gaps.
        """
        m, rows = self.motion(), dict(zip(self.rows, self.row_mask, strict=True))
        if m.has_load_cells:
            return any(rows[name].any() for name in CONTACT_ROWS)
        right, left = m.gaps_m
        return bool((rows["damper"] & ((m.u > right) | (-m.u > left))).any())

    def explain_hidden_bumpers(self) -> str:
        """Return why no force of a bumper is in the residual; "" if one is."""
        if self.shows_bumpers:
            return ""
        if not self.contact_state.any():
            return "there was no contact with a bumper"
        if self.motion().has_load_cells:
            return "no contact lasts longer than its filters settle"
        return (
            "no load cell shows contact, and the motion hardly exceeds the stated gap; if the gap "
            "is less, state it"
        )

    @cached_property
    def row_mask(self) -> Bool2D:
        """Sample selection of each residual row, (row, sample)."""
        if self.fixed_mask is not None:
            return self.fixed_mask
        m = self.motion()
        used = np.zeros((len(self.rows), m.u.size), dtype=bool)
        used[0] = m.moving & np.isfinite(self.measured_forces(m, m.mass_kg)[0])
        margin_s = max(CONTACT_MARGIN_S, FILTER_SETTLING_CYCLES / self.signals.filter_hz)
        margin = max(round(margin_s * m.rate_hz), 1)
        if m.has_load_cells and m.damper is None:
            for row in range(2):
                in_contact = self.contact_state[row] > 0
                used[1 + row] = m.moving & exclude_margins(in_contact, margin, margin)
        contact = self._expected_contact
        is_steady = (np.diff(contact, axis=1, prepend=contact[:, :1]) == 0).all(axis=0)
        smooth = exclude_margins(is_steady, margin, margin)
        if contact is not self.contact_state:
            used[0] &= smooth
        for row, name in enumerate(self.rows):
            if name in PULL_ROWS:
                is_free = self.contact_state[PULL_ROWS.index(name)] <= 0
                was_free = exclude_margins(is_free, margin, 0)
                # a filter of linear phase rings before the step of the force at touch, too
                used[row] = m.moving & ~was_free & exclude_margins(is_free, 0, margin)
            elif row >= len(FORCE_ROWS):
                side = {"right cells": 0, "left cells": 1}.get(name)
                used[row] = m.moving & smooth if side is None else used[1 + side]
        return used & self._thinning_mask

    @cached_property
    def _expected_contact(self) -> npt.NDArray[np.int8]:
        """Contact of right and left, (2, sample), without load cells as the model expects."""
        contact = self.contact_state
        if not (contact < 0).any():
            return contact
        m = self.motion()
        forces = forces_along(self.reference_for(m), m.u, m.v, m.table_acc, m.time_s, contact)
        return np.array([forces[1] > 0, forces[2] < 0], dtype=np.int8)

    def reference_for(self, m: MeasuredMotion) -> Model:
        """Return the reference model with the mass and the stated gaps of this log."""
        right, left = m.gaps_m
        base = replace(self.reference.base, mass=m.mass_kg, gap_r=right, gap_l=left)
        return Model(base, self.reference.effects)

    @cached_property
    def _thinning_mask(self) -> Bool2D:
        """Samples kept after thinning, (sample,): the last cycles of each step, every n-th block.

        At least two consecutive cycles are kept: their difference gives the noise.
        """
        m = self.motion()
        if self.thinning == 1:
            return np.ones(m.u.size, dtype=bool)
        cycle_count = np.zeros(int(m.step.max(initial=-1)) + 2, dtype=np.int64)
        np.maximum.at(cycle_count, m.step, m.cycle + 1)  # step -1 is the last entry
        is_counted = m.cycle >= (cycle_count - np.maximum(cycle_count // self.thinning, 2))[m.step]
        counting: Bool2D = np.where(
            m.cycle >= 0, is_counted, self.sample_block % self.thinning == 0
        )
        return counting

    @cached_property
    def rest_channels(self) -> tuple[str, ...]:
        """Channels that must read zero at rest."""
        if min(self.signals.gaps_m) <= 0:  # precompression: forces at rest are real
            return ()
        return tuple(self.signals.rest_values)

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows that have samples; the rest row follows them."""
        m = self.motion()
        pulls = PULL_ROWS if m.has_load_cells and m.damper is None else ()
        return (*FORCE_ROWS, *(consistency.body for consistency in m.consistency_residuals), *pulls)

    @cached_property
    def _row_samples(self) -> tuple[Int1D, ...]:
        """Samples of each row."""
        return tuple(np.flatnonzero(row) for row in self.row_mask)

    @cached_property
    def _used_samples(self) -> Int1D:
        """Samples of any row, (used,); all samples where the rows are whitened over time."""
        if self.whitening is not None:
            return np.arange(self.row_mask.shape[1])
        return np.flatnonzero(self.row_mask.any(axis=0))

    @cached_property
    def _row_places(self) -> tuple[Int1D, ...]:
        """Places of the samples of each row among the used ones."""
        return tuple(np.flatnonzero(row[self._used_samples]) for row in self.row_mask)

    @cached_property
    def _sampled_motions(self) -> list[SampledMotion]:
        """Cache of `_sample_motion`: of the motions in the cache of motions, and the last one."""
        return []

    def _sample_motion(self, m: MeasuredMotion) -> SampledMotion:
        """Return what the residual needs of a motion; the most recent ones are cached."""
        sampled = next((known for known in self._sampled_motions if known.whole is m), None)
        if sampled is None:
            samples = self._used_samples
            consistency = tuple(
                self._enter_consistency(row, residual)
                for row, residual in enumerate(m.consistency_residuals, len(FORCE_ROWS))
            )
            sampled = SampledMotion(
                m, samples, m.select(samples), self.contact_state[:, samples], consistency
            )
            cached = [motion for _, motion in self.motion_cache]
            kept = [s for s in self._sampled_motions if any(s.whole is motion for motion in cached)]
            self._sampled_motions[:] = [*kept, sampled]
        return sampled

    @cached_property
    def bases(self) -> tuple[BlockBasis | None, ...]:
        """Components of each row; None for a row whose samples are its entries.

        The rectified noise of a row of tension has a mean, which no component may collect.
        """
        if self.is_sampled:
            return (None,) * len(self.rows)
        rate_hz = self.motion().rate_hz
        block = dict.fromkeys(CONTACT_ROWS, self._contact_block)
        return tuple(
            None
            if name in PULL_ROWS
            else BlockBasis(
                _split_at_gaps(samples, block.get(name, self.sample_block)),
                rate_hz,
                band_hz := self.row_bands.get(name, self.signals.band_hz),
                samples,
                tuple(hz for hz in self.signals.hum_hz if hz < band_hz),
            )
            for name, samples in zip(self.rows, self._row_samples, strict=True)
        )

    @cached_property
    def _entry_samples(self) -> tuple[Int1D, ...]:
        """Sample of each entry of each row: itself, or the middle of the block of a fact."""
        return tuple(
            samples if basis is None else samples[basis.middle]
            for samples, basis in zip(self._row_samples, self.bases, strict=True)
        )

    @cached_property
    def entry_row(self) -> Int1D:
        """Row of each residual entry, (entry,)."""
        rows = np.repeat(np.arange(len(self.rows)), [s.size for s in self._entry_samples])
        return np.concatenate([rows, np.full(self._rest_entry_count, len(self.rows))])

    @property
    def _rest_entry_count(self) -> int:
        """Number of residual entries in the rest row."""
        return len(self.rest_channels) + len(self.signals.zero_channels) + self.prior_count

    @cached_property
    def entry_weight(self) -> Float1D:
        """Noise multiplier of each entry, (entry,); the priors of nuisances keep their own."""
        by_row = np.array([self.weights.get(name, 1.0) for name in (*self.rows, "rest")])
        weight: Float1D = by_row[self.entry_row]
        weight[weight.size - self.prior_count :] = 1.0
        return weight

    @cached_property
    def expected_entries(self) -> Float1D:
        """Mean square of each entry, (entry,), of noise and unknown errors alone."""
        by_row = [self.expected_squares.get(name, 1.0) for name in self.rows]
        at_rest = self.weights.get("rest", 1.0) ** -2
        expected: Float1D = np.array([*by_row, at_rest])[self.entry_row]
        expected[expected.size - self.prior_count :] = 1.0
        return expected

    @property
    def sensor_square(self) -> float:
        """Mean square of the entries in motion of the noise of sensors alone."""
        moving = self.entry_weight[self.entry_row < len(self.rows)]
        return float(np.mean(moving**-2.0)) if moving.size else 1.0

    @property
    def prior_count(self) -> int:
        """Number of priors of nuisances, the last entries."""
        return len(self.nuisances.keys) if self.nuisances is not None else 0

    @cached_property
    def entry_sample(self) -> Int1D:
        """Sample of each residual entry, (entry,)."""
        at_rest = np.zeros(self._rest_entry_count, dtype=np.int64)
        return np.concatenate([*self._entry_samples, at_rest])

    @cached_property
    def entry_block(self) -> Int1D:
        """Block of each residual entry, (entry,)."""
        return self.sample_block[self.entry_sample]

    @cached_property
    def entry_contact_block(self) -> Int1D:
        """Block of each entry, (entry,), without splitting a contact at a block boundary."""
        return self._contact_block[self.entry_sample]

    @cached_property
    def _contact_block(self) -> Int1D:
        """Block of each sample, (sample,), without splitting a contact at a block boundary.

        Slow errors of u bias C_j in one direction during compression and in the other during
        restitution; a contact split in two would look like two strong gradients. A contact longer
        than two blocks is split nevertheless.
        """
        in_flight = (self.contact_state <= 0).all(axis=0)
        last_flight = np.maximum.accumulate(np.where(in_flight, np.arange(in_flight.size), 0))
        start_block = self.sample_block[last_flight]
        contact_block: Int1D = np.where(
            self.sample_block - start_block <= 1, start_block, self.sample_block
        )
        return contact_block

    def measured_forces(
        self, m: MeasuredMotion, mass_kg: float, parameters: ParameterSet | None = None
    ) -> tuple[Float1D, Float1D, Float1D]:
        """Return the damper force from the force balance of the mass, F_R, -F_L; (sample,), N."""
        zero_error = {
            channel: parameters.tare_error(self.log_number, channel) if parameters else 0.0
            for channel in TARED_CHANNELS
        }
        if m.damper is not None:
            nothing = np.full(m.u.size, np.nan)
            return m.damper, nothing, nothing
        inertia, right, left = (
            -mass_kg * (m.acc - zero_error["acc"]), m.right - zero_error["right"],
            m.left - zero_error["left"]
        )  # fmt: skip
        return (inertia - right + left if m.has_load_cells else inertia), right, left

    def force_noise(self, m: MeasuredMotion, mass_kg: float) -> Float1D:
        """Return the rms sensor noise of the force rows in N, (3,).

        Use the assumed mass and sensor gains; otherwise a smaller mass would seem to fit better
        only because it scales the noise of the accelerometer down.
        """
        n, p = m.noise, self.reference.parameters
        motion = math.hypot(p.stiffness * n.u, p.damping * n.v)
        sides = [
            math.hypot(cells, k * n.u, c * n.v)
            for cells, k, c in (
                (n.right, p.bumper_stiffness_r, p.bumper_damping_r),
                (n.left, p.bumper_stiffness_l, p.bumper_damping_l),
            )
        ]
        if m.damper is not None:
            return np.array([math.hypot(n.force, motion), np.nan, np.nan])
        cells = (n.right, n.left) if m.has_load_cells else ()
        if self.whitening is not None:
            return np.array([mass_kg, *sides])
        return np.array([math.hypot(mass_kg * n.acc, motion, *cells), *sides])

    @cached_property
    def whitening(self) -> Float1D | None:
        """Whitening filter of the damper row, (frequency,); None with an accelerometer."""
        if not derives_acc(self.signals.channels) or self.motion().damper is not None:
            return None
        p, mass = self.reference.parameters, self.signals.mass_kg
        return self.signals.whitening(p.stiffness / mass, p.damping / mass)

    @cached_property
    def sample_block(self) -> Int1D:
        """Block number of each sample, (sample,): a forcing cycle, or one second outside steps."""
        m = self.motion()
        second_number = (m.time_s / BLOCK_S).astype(np.int64)
        second = np.where(m.cycle >= 0, 0, second_number)
        key = np.stack([m.step, m.cycle, second])
        change = np.any(np.diff(key, axis=1) != 0, axis=0)
        numbers: Int1D = np.concatenate([[0], np.cumsum(change)])
        return numbers

    def evaluate(self, parameters: ParameterSet) -> Float1D:
        """Return the residual over its noise, (entry,): measured minus model, row after row.

        Finite also for a model that diverges, as one of a trial may.
        """
        m = self.motion(parameters.assumed_sensors())
        rows, rest = self._list_rows(parameters, m), self._rest_entries(parameters)
        if self.nuisances is None:
            entries = np.concatenate([*rows, rest])
            entries /= self.entry_weight
            return _bound_diverged(entries)
        values, columns = self.nuisances.values(parameters), self.nuisances.columns
        priors = self.nuisances.centre + values
        entries = np.concatenate([*rows, rest, priors])
        entries[: columns.shape[1]] += values.astype(np.float32) @ columns
        entries /= self.entry_weight
        return _bound_diverged(entries)

    @property
    def gap_correction(self) -> float:
        """Right gap of the signals minus the stated one, and stated minus left, in m."""
        raw = self.signals if self.nuisances is None else self.nuisances.raw
        return self.signals.gaps_m[0] - raw.gaps_m[0] if math.isfinite(raw.gaps_m[0]) else 0.0

    def gap_reading_error(self, parameters: ParameterSet) -> float:
        """Return true right gap minus that of the signals, and the opposite of the left, in m."""
        if (terms := self.nuisances) is None:
            return 0.0
        values = zip(terms.nuisances, terms.values(parameters), strict=True)
        return sum(nuisance.size * float(z) for nuisance, z in values if nuisance.kind == "gap")

    def nuisance_slope(self, key: NuisanceKey) -> Float1D:
        """Return d residual / d nuisance, (entry,); zero for a nuisance of another log."""
        slope = np.zeros(self.entry_row.size)
        if self.nuisances is not None and key in self.nuisances.keys:
            number, count = self.nuisances.keys.index(key), len(self.nuisances.keys)
            column = self.nuisances.columns[number]
            slope[: column.size] = column / self.entry_weight[: column.size]
            slope[slope.size - count + number] = 1.0
        return slope

    def force_errors(self, parameters: ParameterSet, m: MeasuredMotion) -> Float2D:
        """Return measured minus modelled damper force, F_R and -F_L on a motion in N, (3, sample).

        Without load cells the damper force is the sum of all forces.
        """
        model, whole = self._take_whole(parameters, m)
        return np.array(self._force_errors(model, parameters, whole))

    def expect_forces(self, parameters: ParameterSet, m: MeasuredMotion) -> Float2D:
        """Return the modelled damper force, F_R and -F_L on a motion in N, (3, sample).

        Without load cells the damper force is the sum of all forces.
        """
        model, whole = self._take_whole(parameters, m)
        return np.array(self._expect_forces(model, parameters, whole))

    def _take_whole(
        self, parameters: ParameterSet, m: MeasuredMotion
    ) -> tuple[Model, SampledMotion]:
        """Return the model of this log, and a motion at all of its samples."""
        model = parameters.model_for_log(self.log_number, m)
        return model, SampledMotion(m, slice(None), m, self.contact_state)

    def _force_errors(
        self, model: Model, parameters: ParameterSet, sampled: SampledMotion
    ) -> tuple[Float1D, Float1D, Float1D]:
        """Return `force_errors` of the model of this log, (used,) each."""
        measured = self.measured_forces(sampled.m, model.parameters.mass, parameters)
        d, right, left = self._expect_forces(model, parameters, sampled)
        return measured[0] - d, measured[1] - right, measured[2] - left

    def _expect_forces(
        self, model: Model, parameters: ParameterSet, sampled: SampledMotion
    ) -> tuple[Float1D, Float1D, Float1D]:
        """Return `expect_forces` of the model of this log, (used,) each."""
        m = sampled.m
        d, right, left = self._model_forces(model, parameters, sampled)
        if SLIP_SPEED in parameters.values:
            d = d + model.break_away_force_n * (
                np.tanh(m.v / parameters.values[SLIP_SPEED]) - np.where(m.v > 0, 1.0, -1.0)
            )
        if not m.has_load_cells and m.damper is None:
            d = d + right + left
        added = model.added_acceleration(m.table_disp)
        if added is not None:
            d = d + model.parameters.mass * added
        return d, right, -left

    def _model_forces(
        self, model: Model, parameters: ParameterSet, sampled: SampledMotion
    ) -> Float2D:
        """Return D, F_R >= 0 and F_L <= 0 of a model in N, (3, used)."""
        zero_error = parameters.tare_error(self.log_number, "u")
        latest = [*sampled.known_forces]
        known = [each for each in latest if each[1] == zero_error and each[0] == model]
        forces = known[0][2] if known else self._compute_forces(model, zero_error, sampled)
        kept = [each for each in latest if each[2] is not forces][: MAX_KNOWN_FORCES - 1]
        # a single assignment, because other threads may be reading
        sampled.known_forces[:] = [(model, zero_error, forces), *kept]
        return forces

    def _compute_forces(self, model: Model, zero_error: float, sampled: SampledMotion) -> Float2D:
        """Return `_model_forces` for a tare error of u in m."""
        if self._knows_contact and not depends_on_history(model):
            m, contact = sampled.m, sampled.contact
        else:
            m, contact = sampled.whole, self.contact_state
        added = model.added_acceleration(m.table_disp)
        base_acc = m.table_acc if added is None else m.table_acc + added
        forces = forces_along(model, m.u - zero_error, m.v, base_acc, m.time_s, contact)
        return forces if m is sampled.m else forces[:, sampled.samples]

    @cached_property
    def _knows_contact(self) -> bool:
        return bool((self.contact_state >= 0).all())

    def evaluate_rows(self, parameters: ParameterSet, m: MeasuredMotion) -> Float1D:
        """Return the residual over its noise on a given motion, (entry,), without the rest row."""
        return np.concatenate(self._list_rows(parameters, m))

    def _list_rows(self, parameters: ParameterSet, m: MeasuredMotion) -> list[Float1D]:
        """Return the rows of `evaluate_rows`, each at its own samples."""
        model, sampled = parameters.model_for_log(self.log_number, m), self._sample_motion(m)
        forces = self._force_errors(model, parameters, sampled)
        places = self._row_places[: len(FORCE_ROWS)]
        rows = [f[place] for f, place in zip(forces, places, strict=True)]
        if self.whitening is not None:
            rows[0] = self._whiten(forces[0], self.whitening)[places[0]]
        entries = [self._enter_row(row, values) for row, values in enumerate(rows)]
        entries += [self._correct_consistency(c, parameters) for c in sampled.consistency]
        if m.has_load_cells and m.damper is None:
            pulls = self._pull_rows(sampled, parameters, forces)
            entries += [self._enter_row(row, v) for row, v in enumerate(pulls, len(entries))]
        return entries

    def _whiten(self, force_n: Float1D, gain: Float1D) -> Float1D:
        """Return a force on the mass, (sample,), as an acceleration over its noise."""
        return self.signals.grid.apply_gain(
            self._filtered_share * force_n / self.signals.mass_kg, gain
        )

    @cached_property
    def _filtered_share(self) -> Float1D:
        """Share with which samples enter a filter, (sample,): 1 where good, 0 far from it.

        The second derivative at an open end is no force, and the filter, which integrates, would
        spread it for seconds; as it would what a sharp end cuts off of a displacement's noise. So
        the share falls within the least margin that is excluded around what is not good.
        """
        m = self.motion()
        fade = np.hanning(round(LOST_MARGIN_S * m.rate_hz) | 1)
        near = maximum_filter1d(m.good.astype(np.float64), fade.size)
        return np.asarray(convolve1d(near, fade / fade.sum(), mode="nearest"), dtype=np.float64)

    def _enter_row(self, row: int, values: Float1D) -> Float1D:
        """Return the entries of a row over their noise, (entry,), from its samples, (sample,)."""
        basis = self.bases[row]
        return (values if basis is None else basis.project(values)) / self._row_noise[row]

    @cached_property
    def _louder_signals(self) -> LogSignals:
        """Signals with the noise that comparisons of sensors have shown."""
        return self.signals.with_louder_channels(self.noise_scale)

    @cached_property
    def _row_noise(self) -> tuple[Float1D, ...]:
        """Rms noise of the entries of each row: a number, or (entry,); that of the readings.

        With assumed sensors it stays the same: a misfit must not shrink by its own denominator.
        """
        if self.fixed_noise is not None:
            return self.fixed_noise
        louder = replace(self.motion(), noise=self._louder_signals.motion_noise)
        rms = self.force_noise(louder, self.signals.mass_kg)
        if self.whitening is not None:
            rms[0] = 1.0
        # rows of rms 1 through a low pass are louder within its band
        passes = {name: self.signals.pass_of(name) for name in self.rows}
        in_band = {
            name: np.array([1.0 / math.sqrt(float(np.mean(gain**2)))])
            for name, gain in passes.items()
        }
        noise = [rms[k : k + 1] for k in range(len(FORCE_ROWS))]
        for k, basis in enumerate(self.bases):
            if k >= len(FORCE_ROWS):
                noise.append(np.ones(1) if basis is None else in_band[self.rows[k]])
            elif basis is not None:
                is_whitened = k == 0 and self.whitening is not None
                noise[k] = in_band[self.rows[k]] if is_whitened else self._fact_noise(k, basis)
        return tuple(
            each * self._scale_of(PULLING_CELLS.get(name, name), basis)
            for name, each, basis in zip(self.rows, noise, self.bases, strict=True)
        )

    def _scale_of(self, name: str, basis: BlockBasis | None) -> Float1D:
        """Return the noise scale of a row at its facts, (fact,); of samples the mean, (1,)."""
        if name not in self.noise_scale:
            return np.ones(1)
        if basis is not None:
            return self.noise_scale[name][number_bands(basis.frequency_hz)]
        hz = self.signals.omega / (2.0 * np.pi)
        return np.sqrt(np.mean(self.noise_scale[name][number_bands(hz)] ** 2, keepdims=True))

    @cached_property
    def entry_noise(self) -> Float1D:
        """Rms noise of each entry but those at rest, (entry,)."""
        sizes = [samples.size for samples in self._entry_samples]
        return np.concatenate(
            [np.broadcast_to(n, size) for n, size in zip(self._row_noise, sizes, strict=True)]
        )

    @cached_property
    def noise_copy(self) -> "LogResiduals":
        """Residuals of the readings with their noise once more, always the same.

        The terms of the nuisances have no noise: they stay as they are.
        """
        noisy = self._louder_signals.add_noise()
        fixed = self.with_signals(replace(self.signals, spectra=noisy.spectra))
        return replace(fixed, fixed_noise=self._row_noise, fixed_mask=self.row_mask)

    def with_signals(self, signals: LogSignals) -> "LogResiduals":
        """Return the residuals of other readings of the same test, with the same contacts."""
        return replace(self, signals=signals, motion_cache=[], known_contact=self.contact_state)

    def _fact_noise(self, row: int, basis: BlockBasis) -> Float1D:
        """Return the rms noise of the components of a force row in N, (fact,)."""
        signals, hz = self._louder_signals, basis.frequency_hz
        stiffness, damping = self._fact_stiffness(row, basis)

        def at_facts(density: Float1D) -> Float1D:
            return np.interp(hz, signals.omega / (2 * np.pi), density)

        parts = [at_facts(signals.motion_density) * np.hypot(stiffness, 2 * np.pi * hz * damping)]
        readings = dict.fromkeys((RIGHT_CELLS, LEFT_CELLS)[row - 1], 1.0) if row else {}
        if row == 0 and "damper_force_n" in signals.channels:
            readings = {"damper_force_n": 1.0}
        elif row == 0:
            readings = dict.fromkeys((*RIGHT_CELLS, *LEFT_CELLS), 1.0)
            readings["mass_acc_m_s2"] = signals.mass_kg
        thinned = 1.0 / math.sqrt(signals.grid.decimation)
        parts += [
            factor * thinned * at_facts(signals.noise[name])
            for name, factor in readings.items()
            if name in signals.noise
        ]
        return np.hypot.reduce(parts)

    def _fact_stiffness(self, row: int, basis: BlockBasis) -> tuple[Float1D, Float1D]:
        """Return K in N/m and C in N s/m of the specimen that a force row has at its facts.

        Without load cells the bumpers are in the row of the damper, and so is what they make of
        the noise of u.
        """
        p = self.reference.parameters
        elements = np.array([
            (p.stiffness, p.damping),
            (p.bumper_stiffness_r, p.bumper_damping_r),
            (p.bumper_stiffness_l, p.bumper_damping_l),
        ])  # fmt: skip
        present = np.zeros((len(elements), basis.size))
        present[row] = 1.0
        m = self.motion()
        if row == 0 and not m.has_load_cells and m.damper is None:
            present[1:] = self._expected_contact[:, self._row_samples[0][basis.middle]] > 0
        stiffness, damping = elements.T @ present
        return stiffness, damping

    def enter_forces(self, forces: Float2D) -> Float1D:
        """Return what forces add to the residual if a model has them, (entry,).

        `forces`, (3, sample) in N, are those of the damper, F_R and -F_L.
        """
        m = self.motion()
        damper, right, left = forces
        if not m.has_load_cells and m.damper is None:
            damper = damper + right - left
        return self._enter_rows(-np.array([damper, right, left]))

    @cached_property
    def measured_entries(self) -> Float1D:
        """Measured forces over their noise in the entries of the force rows, (entry,); 0 elsewhere.

        Their norm tells how large a force is beside the noise.
        """
        forces = np.array(self.measured_forces(self.motion(), self.signals.mass_kg))
        return self._enter_rows(np.nan_to_num(forces))

    def _enter_rows(self, forces: Float2D) -> Float1D:
        """Return entries over the noise, (entry,), from forces of the three rows, (3, sample)."""
        rows = [values[samples] for values, samples in zip(forces, self._row_samples, strict=False)]
        if self.whitening is not None:
            rows[0] = self._whiten(forces[0], self.whitening)[self._row_samples[0]]
        return self._fill_entries(rows)

    def _fill_entries(self, rows: Sequence[Float1D]) -> Float1D:
        """Return entries over the noise, (entry,), from the samples of the force rows."""
        entries = np.zeros(self.entry_row.size)
        first = 0
        for row, samples in enumerate(rows):
            values = self._enter_row(row, samples)
            entries[first : first + values.size] = values
            first += values.size
        return entries / self.entry_weight

    def _enter_consistency(self, row: int, residual: ConsistencyResidual) -> ConsistencyEntries:
        """Return the entries of the row of a consistency residual."""
        values = self._enter_row(row, residual.values[self._row_samples[row]])
        slope = residual.acc_sensitivity * self._constant_entries[row]
        return ConsistencyEntries(residual.body, values, slope)

    @cached_property
    def _constant_entries(self) -> tuple[Float1D, ...]:
        """Entries of each row of which every sample is 1, (entry,)."""
        return tuple(
            self._enter_row(row, np.ones(samples.size))
            for row, samples in enumerate(self._row_samples)
        )

    def _correct_consistency(
        self, consistency: ConsistencyEntries, parameters: ParameterSet
    ) -> Float1D:
        """Return a consistency residual less the tare errors of the accelerometers, (entry,)."""
        signs = {"mass": (1, 0), "table": (0, 1), "mass against table": (1, -1)}
        mass, table = signs.get(consistency.body, (0, 0))
        zero_error = mass * parameters.tare_error(
            self.log_number, "acc"
        ) + table * parameters.tare_error(self.log_number, "table")
        return consistency.values - zero_error * consistency.slope

    def _pull_rows(
        self, sampled: SampledMotion, parameters: ParameterSet, errors: Sequence[Float1D]
    ) -> list[Float1D]:
        """Return the tension of each side over the noise of its cells, in its row; 0 for pushes.

        Where the model has tension, `errors` of the force rows enter as they are. Elsewhere the
        mean square of pure noise is at most 1: only its negative half enters, scaled by sqrt(2),
        and the undershoot of the low pass after a release is not counted as tension.
        """
        m = sampled.m
        # a side without cells has no noise and no samples in these rows
        sides = (
            (m.right, "right", m.noise.right or 1.0),
            (m.left, "left", m.noise.left or 1.0),
        )
        rows = []
        for (push, name, rms), place, largest, error in zip(
            sides, self._row_places[-len(PULL_ROWS) :], sampled.largest_pushes, errors[1:],
            strict=True,
        ):  # fmt: skip
            measured = push[place] - parameters.tare_error(self.log_number, name)
            tension = np.minimum(measured + MAX_UNDERSHOOT_SHARE * largest, 0.0) * math.sqrt(2.0)
            is_held = error[place] > measured
            rows.append(np.where(is_held, error[place], tension) / rms)
        return rows

    def _rest_entries(self, parameters: ParameterSet) -> Float1D:
        """Return the rest row, (entry,): readings at rest less offsets, tare errors, over noise."""
        offsets = {sensor.channel: sensor.offset for sensor in parameters.assumed_sensors()}
        expected = [
            (self.signals.rest_values[name], offsets.get(name, 0.0)) for name in self.rest_channels
        ]
        entries = [(mean - offset_si) / sigma for (mean, sigma), offset_si in expected]
        for quantity, channels in self.signals.zero_channels.items():
            mean, sigma = self.signals.rest_value(quantity)
            offset_sum = sum(sign * offsets.get(name, 0.0) for name, sign in channels)
            entries.append(
                (mean - offset_sum - parameters.tare_error(self.log_number, quantity)) / sigma
            )
        return np.array(entries)


def measure_level(
    log_residuals: Sequence[LogResiduals], entries: Sequence[Float1D], forces_only: bool = False
) -> float:
    """Return the mean of the squares of entries over what noise and unknown errors alone leave.

    `entries`, (entry,) per log, are residuals. `forces_only` leaves out those in which no force of
    a model acts: at rest, and where sensors are compared.
    """
    ratios = []
    for residuals, values in zip(log_residuals, entries, strict=True):
        ratio = values**2 / residuals.expected_entries
        of_forces = [name in (*FORCE_ROWS, *PULL_ROWS) for name in (*residuals.rows, "rest")]
        ratios.append(ratio[np.array(of_forces)[residuals.entry_row]] if forces_only else ratio)
    return float(np.concatenate(ratios).mean())


def build_log_residuals(
    logs: Sequence[tuple[LogSignals, float]], reference: Model
) -> tuple[LogResiduals, ...]:
    """Build the residuals of several logs, each (signals, contact threshold in N), on one scale."""
    motions = [signals.fuse_motion() for signals, _ in logs]
    readings: dict[str, float] = {}
    for signals, _ in logs:
        for channel in signals.channels:
            readings[channel] = max(readings.get(channel, 0.0), signals.largest_reading(channel))
    scale = measure_scale(motions, readings)
    thinning = math.ceil(sum(int(m.moving.sum()) for m in motions) / MAX_SAMPLES) or 1
    return tuple(
        LogResiduals(number, signals, contact_n, reference, scale, thinning=thinning)
        for number, (signals, contact_n) in enumerate(logs)
    )


def _split_at_gaps(samples: Int1D, block: Int1D) -> Int1D:
    """Return the block of each of some samples, (used,), a new one after each gap between them."""
    is_new = (np.diff(samples, prepend=-1) > 1) | (np.diff(block[samples], prepend=-1) != 0)
    numbers: Int1D = np.cumsum(is_new) - 1
    return numbers


def _bound_diverged(entries: Float1D) -> Float1D:
    """Return the entries, changed in place to be finite and at most `MAX_RESIDUAL` in magnitude."""
    if not -MAX_RESIDUAL <= entries.min(initial=0.0) <= entries.max(initial=0.0) <= MAX_RESIDUAL:
        np.nan_to_num(entries, copy=False, nan=MAX_RESIDUAL)
        np.clip(entries, -MAX_RESIDUAL, MAX_RESIDUAL, out=entries)
    return entries
