"""Swept sine on the specimen's twin: the level that its limits leave, before anything moves.

The controller of the test itself runs against a table that follows exactly, with the free-running
twin on it: what it decides there, notches included, is the prediction. The run takes it from its
profile, uses the predicted ratios ahead of its own measurements, and reports both.
"""

import math
import re
import tomllib
from collections.abc import Callable, Collection, Iterator
from typing import Protocol

import numpy as np

from table_io.block import Block
from table_io.config.excitation.swept_sine import (
    PREDICTION_COLUMNS,
    TABLE_ACCELERATION,
    PredictedSweep,
    SweptSine,
)
from table_io.config.profile import NOTCH, LoopCheckConfig, Profile
from table_io.config.rig import RigConfig
from table_io.control.sweep_control import JUMP_CHANGE, LIMIT_SHARE, MAX_SLOPE, MIN_RATIO
from table_io.records import RunStart, RunStop, SweepLevel
from table_io.sequencer.procedure import advance_test, make_test_plan, start_test
from twin.compare import PREDICTED_CHANNELS, pipeline
from twin.compare.extra_channels import predict_channel
from twin.transport.codec import Item

BLOCK_S = 0.05  # simulated at once: shorter than the horizon of a decision
POINTS_PER_OCTAVE = 96  # of a prediction: slower than 2 octaves a minute at 3 Hz it is thinned
MAX_PREDICTIONS = 4
MAX_LIMIT_RATIO = 1.015  # of a limit, from which a prediction is repeated
JUMP_SPAN = 0.06  # in ln f before an excess, within which the level is reduced for it
JUMP_POINTS = 4  # levels from a jump on, in which its largest response is measured
PREDICTION_FILE = "prediction.csv"
TWIN_PREFIX = "free/"


class TwinTest(Protocol):
    """Test with its rig and the twin of its specimen (`run_config.RunConfig`)."""

    @property
    def profile(self) -> Profile: ...

    @property
    def rig(self) -> RigConfig: ...

    @property
    def profile_toml(self) -> str: ...

    def prepare_twin(self, from_rest: bool = False) -> pipeline.PipelineSetup: ...

    def make_start_factory(
        self, run: str, source: str
    ) -> Callable[[dict[str, float], float], RunStart]: ...


def generate_swept_twin(
    config: TwinTest, run: str = "", profile: Profile | None = None
) -> Iterator[Item]:
    """Yield the items of an ideal table whose level is controlled by what the twin answers.

    Limits and control channels that the twin does not predict are left out. `profile` replaces
    that of the test.
    """
    profile = profile or config.profile
    setup, rate_hz = config.prepare_twin(from_rest=True), profile.acquisition.rate_hz
    start = config.make_start_factory(run, "model")({}, 0.0)
    yield start
    twin, begun = pipeline.start_pipeline(setup)
    yield from begun
    extra = setup.twin.extra_channels
    own = tuple(name for name in PREDICTED_CHANNELS if name not in start.channels)
    known = (*start.channels, *own, *(channel.name for channel in extra))
    state = start_test(make_test_plan(_keep_predicted(profile, known), config.rig))
    index, count = 0, round(BLOCK_S * rate_hz)
    rest = math.ceil(profile.acquisition.rest_s * rate_hz)
    while not state.is_finished or index < state.drive.rest_start + rest:
        drive = state.drive
        command = drive.command(index, count)
        values = np.array([command, command, drive.acceleration(index, count)])
        labels = drive.labels(index, count)
        block = Block("meas", index, rate_hz, start.channels, values, *labels)
        yield block
        twin, items = pipeline.step(setup, twin, block)
        yield from items
        answers = [item for item in items if isinstance(item, Block) and item.index == index]
        sources = dict(zip(start.channels, values, strict=True))
        sources |= {name: answers[0].channel(f"{TWIN_PREFIX}{name}") for name in own}
        rows = [*sources.values(), *(predict_channel(channel, sources) for channel in extra)]
        measured = Block("meas", index, rate_hz, known, np.array(rows), *labels)
        state, records = advance_test(state, measured)
        yield from records
        index += count
    yield RunStop(index, "complete", "the whole sweep was simulated", ("idle", "at rest"))


def _keep_predicted(profile: Profile, names: Collection[str]) -> Profile:
    """Return the profile without loop check, with what the twin predicts of its channels."""
    swept = profile.swept_sine
    assert swept is not None
    control = tuple(name for name in swept.control_channels if name in names)
    excitation = swept.model_copy(update={"control_channels": control or (TABLE_ACCELERATION,)})
    return profile.model_copy(
        update={
            "excitation": excitation,
            "limits": tuple(entry for entry in profile.limits if entry.channel in names),
            "loop_check": LoopCheckConfig(enabled=False),
        }
    )


def predict_notch(config: TwinTest, swept: SweptSine) -> PredictedSweep:
    """Return the level that keeps the twin within the limits of the test, and its responses.

    Where the first simulation goes beyond a limit, at a jump, say, it is repeated with less there.
    """
    profile, levels = config.profile, PredictedSweep((), np.empty((0, 3)))
    for attempt in range(MAX_PREDICTIONS):
        items = generate_swept_twin(config, profile=profile)
        measured = [item for item in items if isinstance(item, SweepLevel)]
        levels = PredictedSweep.from_levels(swept, measured, POINTS_PER_OCTAVE)
        # Not thinned: the largest response to a jump lasts for a cycle or two.
        reduced = reduce_before_excess(PredictedSweep.from_levels(swept, measured), profile)
        if attempt == MAX_PREDICTIONS - 1 or reduced is None:
            break
        excitation = swept.model_copy(
            update={"prediction": PREDICTION_FILE, "files": {PREDICTION_FILE: reduced.to_csv()}}
        )
        profile = config.profile.model_copy(update={"excitation": excitation})
    return levels


def reduce_before_excess(levels: PredictedSweep, profile: Profile) -> PredictedSweep | None:
    """Return a prediction with lower levels where a channel goes beyond its limit; None if none do.

    There, and within JUMP_SPAN before it, the level is at most what would have left LIMIT_SHARE of
    the limit: a jump of the specimen is met with the level that it needs afterwards. A jump also
    shakes the table: there the limit is to hold even at a level higher by `protection.alarm`.
    """
    table, ln_f = levels.table.copy(), np.log(levels.table[:, 1])
    # What a resonance may change from a level to the next; far apart are the ends of two passes.
    steady = np.maximum(JUMP_CHANGE, MAX_SLOPE * np.abs(np.diff(ln_f, prepend=math.nan)))
    excess = np.zeros(len(table))
    for entry in profile.limits:
        if entry.action == NOTCH and entry.channel in levels.channels:
            response = table[:, len(PREDICTION_COLUMNS) + levels.channels.index(entry.channel)]
            ratio = np.maximum(response / table[:, 2], MIN_RATIO)
            change = np.abs(np.diff(np.log(ratio), prepend=math.nan))
            jumps = np.convolve(change > steady, np.ones(JUMP_POINTS))[: len(table)]
            margin = np.where(jumps > 0, 1.0 + profile.protection.alarm, 1.0)
            excess = np.maximum(excess, margin * response / entry.limit_si)
    beyond = np.flatnonzero(excess > MAX_LIMIT_RATIO).tolist()
    for row in beyond:
        before = (np.arange(len(table)) <= row) & (table[:, 0] == table[row, 0])
        before &= np.abs(ln_f - ln_f[row]) <= JUMP_SPAN
        highest = LIMIT_SHARE * levels.table[row, 2] / excess[row]
        table[before, 2] = np.minimum(table[before, 2], highest)
    return PredictedSweep(levels.channels, table) if beyond else None


def attach_prediction(config: TwinTest) -> str:
    """Return the text of a swept sine's profile with the prediction of its twin attached.

    Unchanged without a notch, with a prediction already, or if [excitation] is no table of lines.
    """
    swept, text = config.profile.swept_sine, config.profile_toml
    has_notch = any(entry.action == NOTCH for entry in config.profile.limits)
    if swept is None or not has_notch or swept.prediction is not None:
        return text
    content = predict_notch(config, swept).to_csv()
    named = re.sub(
        r"^[ \t]*\[excitation\].*$",
        rf'\g<0>\nprediction = "{PREDICTION_FILE}"',
        text,
        count=1,
        flags=re.M,
    )
    attached = f"{named}\n[excitation.files]\n\"{PREDICTION_FILE}\" = '''\n{content}'''\n"
    try:
        is_attached = tomllib.loads(attached)["excitation"]["prediction"] == PREDICTION_FILE
    except (tomllib.TOMLDecodeError, KeyError):
        is_attached = False
    return attached if is_attached else text
