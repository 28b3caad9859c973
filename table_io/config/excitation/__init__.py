"""Kinds of the profile's [excitation]: what the table plays.

A kind is an `Excitation` whose fields are the keys of its table and whose `plan(rate_hz)` says what
is played. To add one: a file here with a class under `@register_excitation`, and its module in the
imports of `table_io/config/profile.py`. Other packages add kinds through entry points of the group
`shaketwin.excitations`: the name is the kind, the value the class.
"""

import re
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import EntryPoint
from typing import Any, ClassVar, TypeVar

import numpy as np
from pydantic import Field

from table_io.block import Float1D
from table_io.config.base import ConfigModel, Count
from table_io.config.excitation.drive_file import (
    DriveHeader,
    ExpectedResponse,
    parse_drive,
    parse_drive_header,
)
from table_io.config.plugins import list_entry_points, load_entry, make_plugin_error
from table_io.errors import InputError, suggest
from table_io.records import Step

ENTRY_POINT_GROUP = "shaketwin.excitations"
DEFAULT_KIND = "stepped_sine"
MIN_BLEND_CYCLES = 1.5  # between two steady sine motions
BAND_ENERGY_SHARES = 0.05, 0.95  # of the acceleration, below the ends of the band of a history
MAX_REST_RATIO = 1e-3  # of the peaks of a history: largest motion at its ends
DRIVE_MARGIN_S = 1.0  # of rest around a target that has a drive, which begins before it


@dataclass(frozen=True, slots=True, eq=False)
class ExcitationPlan:
    """What an excitation plays: held sine steps, or a displacement history.

    `steps` are approached, tuned and measured one by one. Without steps `history_m`, (sample,), is
    played as it is, from rest to rest, open loop and without a phase, in `windows` equal parts;
    `target_m`, (sample,), is then the displacement that the table should have. A swept sine has
    neither, but the largest displacement of the table, `swept_disp_m`. The loop check takes its
    motions from the peak table acceleration and the frequency band; `response` is what it is to
    measure, where the twin of the table says so.
    """

    level_m_s2: float
    low_hz: float
    high_hz: float
    steps: tuple[Step, ...] = ()
    history_m: Float1D = field(default_factory=lambda: np.empty(0))
    target_m: Float1D = field(default_factory=lambda: np.empty(0))
    windows: int = 0
    response: ExpectedResponse | None = None
    blend_cycles: float = MIN_BLEND_CYCLES
    swept_disp_m: float = 0.0

    @property
    def peak_disp_m(self) -> float:
        """Largest displacement in m that the table should have."""
        steps = (s.acceleration_m_s2 / (2 * np.pi * s.frequency_hz) ** 2 for s in self.steps)
        return float(np.abs(self.target_m).max(initial=max(steps, default=self.swept_disp_m)))


class Excitation(ConfigModel):
    """Base class of every kind.

    FILE_KEYS are its keys that name a file next to the profile. Loading reads them: a kind that has
    some also has the field `files`, which then holds their texts by name.
    """

    kind: str = Field(DEFAULT_KIND, description="What is played; it decides the other keys.")
    FILE_KEYS: ClassVar[tuple[str, ...]] = ()
    LEVEL_KEY: ClassVar[str] = ""  # key that a too large motion is reduced with, in proportion
    MIN_SAMPLES_PER_CYCLE: ClassVar[float] = 0.0  # to play it, at the highest frequency

    @classmethod
    def convert_file(cls, data: bytes, name: str, table: Mapping[str, Any]) -> dict[str, str]:
        """Return the texts by name that stand for a file; `table` is [excitation], unchecked.

        UnicodeDecodeError or InputError if the file has no text.
        """
        return {name: "\n".join(re.split("\r\n?|\n", data.decode("utf-8")))}

    @classmethod
    def select_class(cls, table: Mapping[str, Any]) -> "type[Excitation]":
        """Return the class of the table's kind; ValueError lists the known kinds."""
        return find_excitation(table.get("kind", DEFAULT_KIND))

    @classmethod
    def list_variants(cls) -> dict[str, type[ConfigModel]]:
        """Return every kind, built in or of a plug-in."""
        kinds = dict.fromkeys([*EXCITATIONS, *list_entry_points(ENTRY_POINT_GROUP)])
        return {f'kind = "{kind}"': find_excitation(kind) for kind in kinds}

    @abstractmethod
    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return what is played at a sampling rate."""
        raise NotImplementedError


class History(Excitation):
    """Base class of the kinds that play a displacement history: they return it in m.

    With a drive the command of that file is played, so that the table follows the displacement.
    """

    FILE_KEYS: ClassVar[tuple[str, ...]] = ("drive",)

    files: dict[str, str] = Field({}, description="Texts of files by name; loading attaches them.")
    drive: str | None = Field(
        None,
        description="CSV file of `shaketwin table-drive` next to the profile: the command by which "
        "this table follows. Omitted: the displacement is commanded.",
    )
    windows: Count = Field(8, ge=1, le=1000, description="Equal parts in time, for the results.")

    @abstractmethod
    def displacement(self, rate_hz: float) -> Float1D:
        """Return the displacement in m, right positive, at rest at both ends, (sample,)."""
        raise NotImplementedError

    def target(self, rate_hz: float) -> Float1D:
        """Return the displacement that the table should have in m, (sample,).

        It is `displacement`, with the rest around it in which a drive, if there is one, begins.
        """
        return self._add_margin(self._compute_history(rate_hz), rate_hz)

    @property
    def drive_header(self) -> DriveHeader | None:
        """What the drive was computed for; None without a drive, or if it does not say."""
        if self.drive is None:
            return None
        return parse_drive_header(self.files.get(self.drive, ""), self.drive)

    def _compute_history(self, rate_hz: float) -> Float1D:
        return np.ascontiguousarray(self.displacement(rate_hz), dtype=np.float64)

    def _add_margin(self, history_m: Float1D, rate_hz: float) -> Float1D:
        return history_m if self.drive is None else add_drive_margin(history_m, rate_hz)

    def plan(self, rate_hz: float) -> ExcitationPlan:
        """Return what is played, with the target's peak acceleration and band.

        InputError if the target is not at rest at its ends, or the drive is not one of it.
        """
        history = self._compute_history(rate_hz)
        target = self._add_margin(history, rate_hz)
        where = f"excitation {self.kind!r}"
        if history.size <= self.windows or not np.isfinite(history).all() or not history.any():
            raise InputError("its history is empty, at rest throughout, or not finite", where=where)
        steps = np.abs(np.diff(history))
        ends = max(abs(history[0]), abs(history[-1])), max(steps[0], steps[-1])
        if ends[0] > MAX_REST_RATIO * np.abs(history).max() or ends[1] > 0.1 * steps.max():
            raise InputError(
                "its history does not begin and end at rest",
                where=where,
                remedy="blend it in and out",
            )
        acceleration = history_acceleration(history, rate_hz)
        # Of the shape: the squares of a tiny motion are 0 in double precision.
        low_hz, high_hz = find_energy_band(acceleration / np.abs(acceleration).max(), rate_hz)
        level = float(np.abs(acceleration).max())
        command = target
        if self.drive is not None:
            command = parse_drive(self.files.get(self.drive, ""), self.drive, target)
        header = self.drive_header
        return ExcitationPlan(
            level,
            low_hz,
            high_hz,
            history_m=command,
            target_m=target,
            windows=self.windows,
            response=None if header is None else header.response,
        )


def add_drive_margin(history_m: Float1D, rate_hz: float) -> Float1D:
    """Return a history in m with the rest around it in which its drive begins, (sample,)."""
    return np.pad(history_m, round(DRIVE_MARGIN_S * rate_hz))


def history_acceleration(history_m: Float1D, rate_hz: float) -> Float1D:
    """Return the acceleration in m/s2 of a displacement history with rest around it, (sample,)."""
    return np.diff(history_m, 2, prepend=history_m[:1], append=history_m[-1:]) * rate_hz**2


def find_energy_band(acceleration: Float1D, rate_hz: float) -> tuple[float, float]:
    """Return the frequencies in Hz below which 5 % and 95 % of the energy of (sample,) lie.

    ValueError if it is at rest throughout.
    """
    energy = np.cumsum(np.abs(np.fft.rfft(acceleration)) ** 2)
    if not energy[-1] > 0.0:
        raise ValueError("the motion is at rest throughout")
    low, high = np.searchsorted(energy, np.multiply(BAND_ENERGY_SHARES, energy[-1])) + 0.5
    resolution_hz = rate_hz / acceleration.size
    return float(low * resolution_hz), float(high * resolution_hz)


EXCITATIONS: dict[str, type[Excitation]] = {}
ExcitationT = TypeVar("ExcitationT", bound=type[Excitation])


def register_excitation(kind: str) -> Callable[[ExcitationT], ExcitationT]:
    """Return a class decorator that registers an excitation under its kind."""

    def register(excitation: ExcitationT) -> ExcitationT:
        EXCITATIONS[kind] = excitation
        return excitation

    return register


def find_excitation(kind: object) -> type[Excitation]:
    """Return the class of a kind, built-in before plug-in; ValueError lists the known kinds."""
    is_text = isinstance(kind, str)  # a list is not even a key
    if is_text and kind in EXCITATIONS:
        return EXCITATIONS[str(kind)]
    plugins = list_entry_points(ENTRY_POINT_GROUP)
    if is_text and kind in plugins:
        return _load_plugin(plugins[str(kind)][0])
    raise InputError(
        f"kind {kind!r} is unknown", remedy=suggest(str(kind), [*EXCITATIONS, *plugins])
    )


def _load_plugin(entry: EntryPoint) -> type[Excitation]:
    """Load the kind of an installed package; InputError if it is not an excitation."""
    excitation = load_entry(entry, ENTRY_POINT_GROUP)
    if not (isinstance(excitation, type) and issubclass(excitation, Excitation)):
        problem = f"expected a subclass of Excitation, got {excitation!r}"
        raise make_plugin_error(entry, ENTRY_POINT_GROUP, problem)
    return excitation
