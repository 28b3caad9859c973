"""Task `import`: conversion of a table of samples to a log."""

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from table_io.block import Block, Float1D, Float2D, Int1D, Label, find_stretches
from table_io.channels import CHANNEL_BY_NAME
from table_io.config.base import format_toml, load_config, parse_toml
from table_io.config.channel import declare_table_channels, read_channels
from table_io.config.folders import find_config, resolve_config
from table_io.config.profile import Profile, load_profile
from table_io.config.rig import RigConfig
from table_io.errors import InputError
from table_io.formats import read_table
from table_io.formats.table import TOML_TEXTS, ForeignTable
from table_io.formats.timing import find_holes
from table_io.records import Event, RunStart, RunStop, SampleGap, Step
from twin.compare.step_detection import DetectedSteps, find_steps
from twin.exchange.columns import (
    ColumnMap,
    ImportColumns,
    ImportedSamples,
    read_samples,
)
from twin.exchange.proposal import MapProposal, propose_map
from twin.log import Log, open_log
from twin.recording.tabular import DIRECTION_SIGNS
from twin.setup.run_config import RunConfig, from_texts, make_run_id, read_model
from twin.setup.unpaced import SIMULATED_BLOCK_SAMPLES, add_twin_items, record_items
from twin.setup.warm_up import compile_kernels
from twin.transport.codec import Item

NO_PROFILE = (
    "warning: no --profile: {mass}, {bumpers}, a placeholder model; PRC and twin are "
    "meaningless, give --profile"
)
MOTION_CHANNELS = (
    "drive_disp_m",
    "table_disp_m",
    "table_acc_m_s2",
    "rel_disp_m",
)  # steps are detected in the first one present
NO_REST = "nothing is taken as rest: no channel has a zero, noise is taken from the motion"
MAX_REST_SHARE = 0.1  # of the range of the motion, by which a channel may be off zero at rest
TARED_CHANNELS = CHANNEL_BY_NAME.keys() - {"drive_disp_m", "damper_force_n"}
MIN_ZERO_ERRORS = 4.0  # of its standard errors, from which a zero at rest is taken off
MAX_COUNT = 10**6  # of steps, and of cycles in a step
MAX_CYCLES_PER_STEP = 1000  # allowed in a profile
MAX_GAPS = 1000  # per channel: beyond, lost samples are only counted
PLAIN_PROFILE = """\
title = {title}
notes = {notes}
rig = {rig}
[specimen]
mass_kg = {mass_kg!r}
gap_mm = {gap_mm!r}
[acquisition]
rate_hz = {rate_hz!r}
[sweep]
start_hz = {hz!r}
stop_hz = {hz!r}
step_hz = {hz!r}
cycles = {cycles}
measured_cycles = {measured}
"""
OTHER_MODEL = (
    "state a model of this specimen in the profile in place of {model}, or import without a "
    "profile, with --mass and --gap"
)
NO_PROFILE_NOTE = "Imported without a profile: {mass}, {bumpers}."
PLAIN_MODEL = """\
title = "Placeholder: {hz:.3g} Hz, 5 % damping; the specimen is unknown, give --model"
[base]
stiffness_n_m = {stiffness!r}
damping_n_s_m = {damping!r}
bumper_stiffness_n_m = 1.0
bumper_damping_n_s_m = 0.0
"""
MIN_PLACEHOLDER_HZ, MAX_PLACEHOLDER_HZ = 0.01, 1.0  # the least that a sweep may have
PLACEHOLDER_DAMPING = 0.05
SAMPLES_PER_CYCLE = 128  # of the placeholder


@dataclass(frozen=True, eq=False)
class _SampleGrid:
    """Samples on the uniform time grid, values (channel, sample), NaN in holes and bad samples."""

    channels: tuple[str, ...]
    values: Float2D
    holes: list[tuple[int, int]]
    bad: tuple[SampleGap, ...] = ()

    @property
    def size(self) -> int:
        return int(self.values.shape[1])

    @property
    def segments(self) -> Iterator[tuple[int, int]]:
        """(first, end) of the segments between the holes."""
        first = 0
        for hole, count in self.holes:
            yield first, hole
            first = hole + count
        yield first, self.size


@dataclass(frozen=True)
class ImportOptions:
    """What is stated of the files of an import besides themselves.

    `columns` is the file of a column map; `accept`: the proposed map is taken. `settings` are keys
    of a column map, which win over those in it. `rig`: in place of that of the profile.
    """

    profile: Path | None = None
    rig: str | None = None
    columns: Path | None = None
    accept: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)

    def read_map(self) -> ColumnMap | None:
        """Read the column map; None without one. InputError lists all its faults."""
        return (
            None if self.columns is None else load_config(self.columns, ColumnMap, "column map")[0]
        )

    def apply_settings(self, column_map: ColumnMap | None) -> ColumnMap | None:
        """Return the map with the settings; None if there is nothing to state."""
        if not self.settings:
            return column_map
        stated = {}
        if column_map is not None:
            stated = column_map.model_dump(exclude_unset=True, exclude_none=True)
        return parse_toml(format_toml(stated | dict(self.settings)), ColumnMap, "options")


@dataclass(frozen=True)
class _StatedSpecimen:
    """What is stated of a specimen without a profile."""

    mass_kg: float | None = None
    gap_mm: float | None = None

    @classmethod
    def from_map(cls, column_map: ColumnMap | None) -> "_StatedSpecimen":
        return cls() if column_map is None else cls(column_map.mass_kg, column_map.gap_mm)

    def refuse_beside(self, place: str) -> None:
        """Raise InputError if mass or gap are stated beside a profile."""
        for key, value in asdict(self).items():
            if value is not None:
                problem = f"{place} states the {key.split('_')[0]}"
                raise InputError(problem, key=key, value=value, remedy="leave one out")

    def describe(self) -> dict[str, str]:
        """Return the words for mass and bumpers."""
        mass = "unit mass" if self.mass_kg is None else f"{self.mass_kg:g} kg"
        named = {None: "no gap stated", math.inf: "no bumpers"}
        bumpers = named.get(self.gap_mm) or f"a gap of {self.gap_mm:g} mm"
        return {"mass": mass, "bumpers": bumpers}


@dataclass(frozen=True)
class Imported:
    """New log of an import: its samples and channels, gaps, and what was decided on the way."""

    log: Path
    samples: int
    channels: tuple[str, ...]
    gaps: int
    notes: tuple[str, ...]


def import_table(
    file: Path,
    out: Path,
    options: ImportOptions = ImportOptions(),
    on_item: Callable[[Item], None] = lambda _: None,
) -> Imported:
    """Convert the table in `file` to a new log at `out`; `on_item` gets each item of the log."""
    if out.exists():
        raise InputError("exists already", where=out, remedy="nothing recorded is ever overwritten")
    if out.suffix != ".mcap":
        raise InputError("not the name of a log", where=out, allowed="names that end in .mcap")
    column_map = options.read_map()
    options.apply_settings(None)  # report errors before reading a long table
    if options.profile is not None:
        load_profile(options.profile)
    table = read_table(file, column_map.group if column_map is not None else "")
    rig_toml = _read_rig_toml(table, options)
    known = ImportColumns(read_channels(rig_toml))
    if options.accept:
        column_map = _accept_proposal(table, known, options)
    column_map = options.apply_settings(column_map)
    is_mapped = options.columns is not None or options.accept
    samples = read_samples(table, column_map, known, leave_out=is_mapped)
    file_labels = read_labels(table, samples) if samples.labels else None
    specimen = _StatedSpecimen.from_map(column_map)
    config = _build_run_config(table, options, rig_toml, samples.rate_hz, file_labels, specimen)
    if samples.doubts:
        remedies = dict.fromkeys(doubt.remedy for doubt in samples.doubts)
        raise InputError(
            "; ".join(doubt.problem for doubt in samples.doubts),
            where=file,
            remedy=f"{'; '.join(remedies)}; or, if that is how it was, state trusted = true for "
            "the column in a --columns file",
        )
    grid = _to_grid(samples)
    labels = file_labels or _detect_labels(grid, config, on_grid=options.profile is not None)
    is_rest = column_map.rest if column_map is not None else None
    labels = _judge_rest(grid, labels, is_rest, is_component=options.profile is None)
    tared: tuple[str, ...] = ()
    if config.profile.specimen.gap_mm > 0 and not _has_config_texts(table):
        grid, tared = _tare(grid, labels)
    is_history = not labels.steps and bool((labels.step >= 0).any())
    is_plain = options.profile is None and not _has_config_texts(table)
    # the steps of a placeholder's sweep were never played
    steps = labels.steps or (() if is_history or is_plain else config.steps)
    config = replace(config, drive=replace(config.drive, steps=steps))
    missing_profile = (NO_PROFILE.format(**specimen.describe()),) if is_plain else ()
    notes = (*missing_profile, *samples.notes, *labels.messages, *tared, _describe_steps(labels))
    run = make_run_id(file.stem)
    start = replace(
        config.make_start_factory(run, "table")({}, 0.0),
        channels=grid.channels,
        planned_samples=grid.size,
    )
    items = _iter_items(file, start, grid, labels, notes)
    if "table_acc_m_s2" in grid.channels:
        compile_kernels(config)
        items = add_twin_items(items, config.prepare_twin())
    gaps = 0

    def count_gaps(item: Item) -> None:
        nonlocal gaps
        gaps += isinstance(item, SampleGap)
        on_item(item)

    out.parent.mkdir(parents=True, exist_ok=True)
    record_items(items, out, run, samples.rate_hz, count_gaps)
    return Imported(out, grid.size, grid.channels, gaps, notes)


def import_data(
    file: str | Path,
    out: str | Path,
    columns: str | Path | None = None,
    profile: str | Path | None = None,
) -> Log:
    """Import a table of samples (CSV, xlsx, Parquet, MAT, ...) to the new log `out`; open it.

    `columns` is the file of a column map; without it the proposed map is taken, whose units and
    channels are in the log's events. `profile` states specimen, gaps and steps. InputError where
    the file leaves a question open, or `out` exists.
    """
    options = ImportOptions(
        profile=None if profile is None else resolve_config(Path(profile), "tests"),
        columns=None if columns is None else Path(columns),
        accept=columns is None,
    )
    import_table(Path(file), Path(out), options)
    return open_log(out)


def propose_import(file: Path, options: ImportOptions) -> MapProposal:
    """Return the proposed map of the columns of a file; what its samples leave open is asked."""
    options.apply_settings(None)
    if options.profile is not None:
        load_profile(options.profile)
    table = read_table(file)
    known = ImportColumns(read_channels(_read_rig_toml(table, options)))
    proposal = propose_map(table, known, options.settings)
    if proposal.questions:
        return proposal
    column_map = options.apply_settings(proposal.to_map())
    try:
        samples = read_samples(table, column_map, known, leave_out=True)
    except InputError as error:
        return replace(proposal, questions=(error.problem,))
    findings = (note for note in samples.notes if note.startswith("warning: "))
    questions = (f"{doubt.problem}: {doubt.remedy}, or trusted = true" for doubt in samples.doubts)
    return replace(proposal, findings=(*findings,), questions=(*questions,))


def _accept_proposal(
    table: ForeignTable, known: ImportColumns, options: ImportOptions
) -> ColumnMap:
    """Return the proposed map; raise InputError if it is open. A profile states its own mass."""
    proposal = propose_map(table, known, options.settings)
    if proposal.questions:
        raise InputError(
            "the proposed map is open: " + "; ".join(proposal.questions),
            where=table.path,
            remedy="save it by --save-map MAP, answer there, and import with --columns MAP",
        )
    column_map = proposal.to_map()
    has_profile = options.profile is not None
    return column_map.model_copy(update={"mass_kg": None}) if has_profile else column_map


def _detect_labels(grid: _SampleGrid, config: RunConfig, on_grid: bool) -> DetectedSteps:
    """Detect the steps of the sweep in the motion of the table."""
    signal, is_acc = _motion_signal(grid)
    rate_hz = config.profile.acquisition.rate_hz
    return find_steps(signal, rate_hz, config.profile.sweep, is_acc=is_acc, on_grid=on_grid)


def _judge_rest(
    grid: _SampleGrid, labels: DetectedSteps, is_rest: bool | None, is_component: bool
) -> DetectedSteps:
    """Return the labels without rest if it is no zero, by `is_rest` or by the readings there.

    A mass on its spring comes to rest at zero. An actuator holds a component anywhere, so its still
    part is no zero if its displacement is far from it.
    """
    offsets = _measure_rest_offsets(grid, labels) if is_rest is None else {}
    is_held = is_component and {"damper_force_n", "rel_disp_m"} <= {*grid.channels}
    if is_rest is None:
        is_rest = not (is_held and "rel_disp_m" in offsets)
        advice = (
            "if it is none, as after the mean was removed, import with --no-rest"
            if is_rest
            else "a component may be held anywhere; if this is its zero, import with --rest"
        )
        taken = "rest is taken as its zero" if is_rest else "nothing is taken as rest"
        labels = replace(
            labels,
            messages=(
                *labels.messages,
                *(
                    f"warning: {name} reads {offset:.4g} while it is still: {taken}; {advice}"
                    for name, offset in offsets.items()
                ),
            ),
        )
    if is_rest:
        return labels
    moving = np.where(labels.label == Label.REST, int(Label.SETTLE), labels.label)
    return replace(labels, label=moving, messages=(*labels.messages, NO_REST))


def _measure_rest_offsets(grid: _SampleGrid, labels: DetectedSteps) -> dict[str, float]:
    """Return the mean of each channel that is far from zero in the still beginning, in SI."""
    moving = np.flatnonzero(labels.label != Label.REST)
    offsets: dict[str, float] = {}
    for name, offset, _ in _measure_rest(grid, labels):
        motion = grid.values[grid.channels.index(name), moving[0] : moving[-1] + 1]
        motion = motion[np.isfinite(motion)]
        if motion.size and abs(offset) > MAX_REST_SHARE * float(np.ptp(motion)):
            offsets[name] = offset
    return offsets


def _measure_rest(grid: _SampleGrid, labels: DetectedSteps) -> Iterator[tuple[str, float, float]]:
    """Yield (channel, mean, its standard error if noise is white) in the still beginning, in SI."""
    moving = np.flatnonzero(labels.label != Label.REST)
    for name, values in zip(grid.channels, grid.values, strict=True):
        rest = values[: moving[0] if moving.size else 0]
        rest = rest[np.isfinite(rest)]
        if rest.size:
            yield name, float(rest.mean()), float(rest.std()) / math.sqrt(rest.size)


def _tare(grid: _SampleGrid, labels: DetectedSteps) -> tuple[_SampleGrid, tuple[str, ...]]:
    """Return the samples less what they read in the still beginning, and a note of it.

    As a laboratory's own tests are tared before they begin. A force that a damper holds at rest is
    that of its friction or of a preload, which is real; so is a temperature.
    """
    zeros = {
        name: zero
        for name, zero, error in _measure_rest(grid, labels)
        if abs(zero) > MIN_ZERO_ERRORS * error and name in TARED_CHANNELS
    }
    if not zeros:
        return grid, ()
    values = grid.values - np.array([[zeros.get(name, 0.0)] for name in grid.channels])
    parts = (f"{name} by {zero:.3g}" for name, zero in zeros.items())
    return replace(grid, values=values), (f"tared where it is still: {', '.join(parts)}",)


def _has_config_texts(table: ForeignTable) -> bool:
    """Return whether the table carries profile, rig and model, as an export does."""
    return len(table.texts) == len(TOML_TEXTS)


def _read_rig_toml(table: ForeignTable, options: ImportOptions) -> str:
    """Read the text of the rig file: the one given, else of the table, else of the profile."""
    profile, rig = options.profile, options.rig
    if rig is None and profile is None and _has_config_texts(table):
        return table.texts["rig_toml"]
    option = "" if rig is None else "--table"
    if rig is None:
        rig = (
            "simulated" if profile is None else load_config(profile, Profile, "test profile")[0].rig
        )
    rig_toml = load_config(find_config(rig, "rigs", profile, option), RigConfig, "rig file")[1]
    return declare_table_channels(rig_toml, table.columns)


def _build_run_config(
    table: ForeignTable,
    options: ImportOptions,
    rig_toml: str,
    rate_hz: float,
    labels: DetectedSteps | None,
    specimen: _StatedSpecimen,
) -> RunConfig:
    """Build the run config of the log, with the sampling rate of the file."""
    file, profile = table.path, options.profile
    if profile is None and _has_config_texts(table):
        profile_toml, model_toml = table.texts["profile_toml"], table.texts["model_toml"]
        file_profile = parse_toml(profile_toml, Profile, f"profile in {file}")
        stated = options.apply_settings(None)  # a map may be proposed from what the file states
        _StatedSpecimen.from_map(stated).refuse_beside("the profile in the file")
        if file_profile.acquisition.rate_hz != rate_hz:
            profile_toml = _set_rate(profile_toml, rate_hz)
        return from_texts(file.stem, profile_toml, rig_toml, model_toml, f"config in {file}")
    if profile is None:
        return _build_placeholder(table, rig_toml, rate_hz, labels, specimen)
    specimen.refuse_beside("the profile")
    test_profile, text = load_profile(profile)
    model_toml = read_model(test_profile.model, profile)[1]
    source = f"{profile}, at the {rate_hz:g} Hz of {file}"
    if test_profile.acquisition.rate_hz != rate_hz:
        text = _set_rate(text, rate_hz)
    try:
        return from_texts(profile.stem, text, rig_toml, model_toml, source)
    except InputError as error:
        if error.key != "rate_hz":
            raise
        raise error.replace(remedy=OTHER_MODEL.format(model=test_profile.model)) from None


def _build_placeholder(
    table: ForeignTable,
    rig_toml: str,
    rate_hz: float,
    labels: DetectedSteps | None,
    specimen: _StatedSpecimen,
) -> RunConfig:
    """Build the run config of a log whose specimen is unknown, but for what is stated of it."""
    hz = min(MAX_PLACEHOLDER_HZ, rate_hz / SAMPLES_PER_CYCLE)
    if hz < MIN_PLACEHOLDER_HZ:
        raise InputError(
            f"{table.kind} with {rate_hz:g} samples per second, too few for a log",
            where=table.path,
            allowed=f"{SAMPLES_PER_CYCLE * MIN_PLACEHOLDER_HZ:g} Hz or more",
            remedy="resample the table; or if its times are not in s, state their unit",
        )
    mass = 1.0 if specimen.mass_kg is None else specimen.mass_kg
    omega = 2.0 * math.pi * hz
    cycles, measured = typical_cycles(labels) if labels is not None else (3, 3)
    profile_toml = PLAIN_PROFILE.format(
        title=json.dumps(f"Imported: {table.path.name}"),
        notes=json.dumps(NO_PROFILE_NOTE.format(**specimen.describe())),
        rig=json.dumps(parse_toml(rig_toml, RigConfig, "rig file").name),
        mass_kg=mass,
        gap_mm=math.inf if specimen.gap_mm is None else specimen.gap_mm,
        rate_hz=rate_hz,
        hz=hz,
        cycles=cycles,
        measured=measured,
    )
    model_toml = PLAIN_MODEL.format(
        hz=hz,
        stiffness=mass * omega**2,
        damping=2.0 * PLACEHOLDER_DAMPING * mass * omega,
    )
    source = f"{table.path} without a profile"
    return from_texts(table.path.stem, profile_toml, rig_toml, model_toml, source)


def _set_rate(profile_toml: str, rate_hz: float) -> str:
    """Return the text of a profile with `acquisition.rate_hz` replaced."""
    header = re.search(r"(?m)^[ \t]*\[acquisition\].*$", profile_toml)
    if header is None:
        return f"{profile_toml.rstrip()}\n\n[acquisition]\nrate_hz = {rate_hz!r}\n"
    before, after = profile_toml[: header.end()], profile_toml[header.end() :]
    table = re.split(r"(?m)^[ \t]*\[", after, maxsplit=1)[0]
    without = re.sub(r"(?m)^[ \t]*rate_hz[ \t]*=.*\n?", "", table)
    return f"{before}\nrate_hz = {rate_hz!r}{without}{after[len(table) :]}"


def _to_grid(imported: ImportedSamples) -> _SampleGrid:
    """Place the samples on the uniform time grid."""
    values = np.array([imported.to_grid(channel) for channel in imported.channels.values()])
    return _SampleGrid(tuple(imported.channels), values, find_holes(imported.index), imported.bad)


def _motion_signal(grid: _SampleGrid) -> tuple[Float1D, bool]:
    """Return (signal for step detection, (sample,), whether it is an acceleration)."""
    for name, values in zip(grid.channels, grid.values, strict=True):
        if name in MOTION_CHANNELS and np.isfinite(values).any():
            return values, name == "table_acc_m_s2"
    return np.full(grid.size, np.nan), False


def _describe_steps(labels: DetectedSteps) -> str:
    """Describe the detected steps, or the windows of a displacement history, in one line."""
    steps = labels.steps
    if not steps and (labels.step >= 0).any():
        return f"{int(labels.step.max()) + 1} windows of a displacement history"
    if not steps:
        return "no steps found: no PRC can be computed"
    frequencies = [step.frequency_hz for step in steps]
    directions = " and ".join(dict.fromkeys(step.direction for step in steps))
    span = f"{min(frequencies):.4g} to {max(frequencies):.4g} Hz"
    return f"found {len(steps)} steps, {directions}, {span}"


def _iter_items(
    file: Path, start: RunStart, grid: _SampleGrid, detected: DetectedSteps, notes: tuple[str, ...]
) -> Iterator[Item]:
    """Yield the items of the log: start, notes as events, blocks, gaps and stop."""
    yield start
    yield Event(0, "imported", file.name)
    for text in notes:
        _, is_warning, rest = text.rpartition("warning: ")
        yield Event(0, "warning" if is_warning else "imported", rest)
    for first, end in grid.segments:
        for begin in range(first, end, SIMULATED_BLOCK_SAMPLES):
            window = slice(begin, min(begin + SIMULATED_BLOCK_SAMPLES, end))
            labels = detected.step[window], detected.label[window], detected.cycle[window]
            values = np.ascontiguousarray(grid.values[:, window])
            yield Block("meas", begin, start.rate_hz, grid.channels, values, *labels)
        yield from (SampleGap(end, count, "", "lost") for hole, count in grid.holes if hole == end)
    yield from _iter_lost_samples(grid)
    yield RunStop(grid.size, "complete", f"the whole of {file.name}", ("idle", "at rest"))


def _iter_lost_samples(grid: _SampleGrid) -> Iterator[Item]:
    """Yield a SampleGap per stretch of lost or bad samples of a channel, an Event if too many."""
    is_hole = np.zeros(grid.size, dtype=bool)
    for first, count in grid.holes:
        is_hole[first : first + count] = True
    for name, values in zip(grid.channels, grid.values, strict=True):
        bad = [gap for gap in grid.bad if gap.channel == name]
        is_lost = np.isnan(values) & ~is_hole
        for gap in bad:
            is_lost[gap.index : gap.end] = False
        lost = (SampleGap(a, b - a, name, "lost") for a, b in find_stretches(is_lost))
        gaps = [*bad, *lost]
        if len(gaps) > MAX_GAPS:
            count = sum(gap.count for gap in gaps)
            yield Event(0, "warning", f"{name}: {count} of {grid.size} samples lost")
            continue
        yield from sorted(gaps, key=lambda gap: gap.index)


def read_labels(table: ForeignTable, samples: ImportedSamples) -> DetectedSteps:
    """Return the table's labels on the time grid; raise InputError that names an invalid row.

    Samples in a hole are at rest. Steps, or windows of a displacement history, are renumbered from
    0 in order.
    """
    columns = samples.labels
    step = _read_integers(table, columns, "step", -1, MAX_COUNT)
    label = _read_integers(table, columns, "label", min(Label), max(Label))
    cycle = _read_integers(table, columns, "cycle", -1, MAX_COUNT)
    sign = _read_integers(table, columns, "direction", -1, 1)
    numbers, firsts, place = np.unique(step, return_index=True, return_inverse=True)
    notes = ["steps, labels and cycles are taken from the file"]
    steps: list[Step] = []
    # Windows of a displacement history have neither direction nor frequency nor level.
    is_history = not sign.any() and not np.isfinite(columns["frequency_hz"]).any()
    for row in firsts[numbers >= 0].tolist() if not is_history else ():
        plan = {name: float(columns[name][row]) for name in ("frequency_hz", "level_m_s2")}
        if sign[row] == 0 or not plan["frequency_hz"] > 0 or not plan["level_m_s2"] >= 0:
            raise InputError(
                f"step {step[row]} lacks direction, frequency_hz or level_m_s2",
                where=table.describe_row(row),
                remedy="fill in all three for every step",
            )
        direction = {number: name for name, number in DIRECTION_SIGNS.items()}[int(sign[row])]
        steps.append(Step(len(steps), direction, plan["frequency_hz"], plan["level_m_s2"]))
    for name in ("direction", "frequency_hz", "level_m_s2") if not is_history else ():
        differs = (columns[name] != columns[name][firsts][place]) & (step >= 0)
        if differs.any():
            row = int(np.argmax(differs))
            raise InputError(
                f"{name} is {columns[name][row]:.9g} in step {step[row]}, "
                f"but {columns[name][firsts[place[row]]]:.9g} in an earlier row of it",
                where=table.describe_row(row),
                allowed="one value per step",
            )
    outside = int((numbers < 0).any())
    if numbers[outside:].tolist() != list(range(numbers.size - outside)):
        notes.append(f"steps {numbers[outside]} to {numbers[-1]} of the file are numbered from 0")
    size = int(samples.index[-1]) + 1

    def to_grid(values: Int1D, fill: int) -> Int1D:
        grid = np.full(size, fill)
        grid[samples.index] = values
        return grid

    return DetectedSteps(
        to_grid(place - outside, -1),
        to_grid(label, Label.REST),
        to_grid(cycle, -1),
        tuple(steps),
        tuple(notes),
    )


def typical_cycles(detected: DetectedSteps) -> tuple[int, int]:
    """Return (held, measured) cycles per step: the mode over the steps, for a profile.

    The mode ignores steps that were cut off or held longer.
    """
    measured = _typical_cycle_count(detected, detected.label == Label.MEASURE) or 3
    return max(_typical_cycle_count(detected, detected.cycle >= 0), measured, 2), measured


def _typical_cycle_count(detected: DetectedSteps, is_counted: NDArray[np.bool_]) -> int:
    """Return the mode of the number of counted cycles per step, 0 if there are none."""
    is_selected = is_counted & (detected.step >= 0) & (detected.cycle >= 0)
    pairs = np.unique(detected.step[is_selected] * (MAX_COUNT + 1) + detected.cycle[is_selected])
    counts = np.bincount(np.unique(pairs // (MAX_COUNT + 1), return_counts=True)[1], minlength=1)
    return (
        min(int(counts.size - 1 - np.argmax(counts[::-1])), MAX_CYCLES_PER_STEP)
        if pairs.size
        else 0
    )


def _read_integers(
    table: ForeignTable, columns: dict[str, Float1D], name: str, low: int, high: int
) -> Int1D:
    """Return a column as integers; raise InputError unless all are whole and in [low, high]."""
    values = columns[name]
    is_wrong = ~((values == np.rint(values)) & (values >= low) & (values <= high))
    if is_wrong.any():
        row = int(np.argmax(is_wrong))
        raise InputError(
            f"{name} is {values[row]:.9g}",
            where=table.describe_row(row),
            allowed=f"whole numbers from {low} to {high}",
        )
    return values.astype(np.int64)
