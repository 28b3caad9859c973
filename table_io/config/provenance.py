"""Provenance of a computed file: the rig, specimens and recordings that it was made for and from.

The twin of a table, a drive and an identified model carry it as a table [provenance]; whoever uses
one compares it with the test at hand. Keys carry their unit in the name. Texts that end with their
own hash (`seal_text`) let whoever reads one notice what was altered.
"""

import hashlib
import json
import math
import re
from collections.abc import Sequence

from pydantic import Field

from table_io.config.base import ConfigModel, NonNegative, Number, Positive
from table_io.config.rig import RigConfig
from table_io.errors import InputError

HASH_PATTERN = "^[0-9a-f]{64}$"
MAX_MASS_DIFFERENCE = 0.01  # of the mass of the specimen: what a weighing leaves uncertain
MAX_GAP_DIFFERENCE_MM = 0.05  # of the total gap: what setting the bumpers leaves uncertain


class HashedFile(ConfigModel):
    """A rig or a source by its name, and the SHA-256 of its content."""

    name: str = Field(description="Name of the rig, the run or the file.")
    sha256: str = Field(pattern=HASH_PATTERN, description="SHA-256 of its content.")

    @classmethod
    def of_rig(cls, rig: RigConfig) -> "HashedFile":
        """Return name and hash of what a rig file means.

        Comments, order, title, calibration records and tare do not count; nor do keys at their
        default, so that a new key of a later version changes no hash.
        """
        meaning = rig.model_dump(exclude={"title", "calibrations", "tare"}, exclude_defaults=True)
        text = json.dumps(meaning, sort_keys=True, default=str)
        return cls(name=rig.name, sha256=hashlib.sha256(text.encode()).hexdigest())


class Provenance(ConfigModel):
    """What a computed file was made for and from: rigs, specimens, levels, sources, version."""

    rigs: tuple[HashedFile, ...] = Field((), description="Rigs; the hash is that of their meaning.")
    masses_kg: tuple[Positive, ...] = Field((), description="Moving masses of the specimens.")
    gaps_mm: tuple[Number, ...] = Field((), description="Total gaps; inf = no bumpers.")
    levels_m_s2: tuple[NonNegative, ...] = Field((), description="Peak table accelerations.")
    sources: tuple[HashedFile, ...] = Field((), description="Recordings and files used.")
    code: str = Field("", description="Version of shaketwin that computed it.")

    def find_rig(self, name: str) -> HashedFile | None:
        """Return the rig of this name that it was made for; None if it was made for others."""
        return next((rig for rig in self.rigs if rig.name == name), None)

    def list_rig_changes(self, rig: RigConfig, what: str) -> list[str]:
        """List how the file of a rig that `what` was made for has changed since."""
        made_for = self.find_rig(rig.name)
        if made_for is None or made_for == HashedFile.of_rig(rig):
            return []
        return [
            f"the file of rig {rig.name} has changed since {what} was computed for it; compute it "
            "again if the table is another one"
        ]

    def list_mass_changes(self, mass_kg: float, what: str) -> list[str]:
        """List how the mass of a specimen differs from all that `what` was made for."""
        if not self.masses_kg:
            return []
        nearest = min(self.masses_kg, key=lambda mass: abs(mass - mass_kg))
        change = mass_kg / nearest - 1.0
        if abs(change) <= MAX_MASS_DIFFERENCE:
            return []
        return [
            f"{what} is of a specimen of {_join(self.masses_kg)} kg, the test has {mass_kg:g} kg "
            f"({100 * change:+.3g} %)"
        ]

    def list_gap_changes(self, gap_mm: float, what: str) -> list[str]:
        """List how a total gap differs from all that `what` was made for."""
        if not self.gaps_mm or any(
            gap == gap_mm or abs(gap - gap_mm) <= MAX_GAP_DIFFERENCE_MM for gap in self.gaps_mm
        ):
            return []
        here = "no bumpers" if math.isinf(gap_mm) else f"{gap_mm:g} mm"
        return [f"{what} is of a total gap of {_join(self.gaps_mm)} mm, the test has {here}"]

    def list_bumper_changes(self, gap_mm: float, what: str) -> list[str]:
        """List that a specimen has bumpers, but none that `what` was made for had any."""
        if not self.gaps_mm or math.isinf(gap_mm) or not all(map(math.isinf, self.gaps_mm)):
            return []
        return [
            f"{what} is of a specimen without bumpers, the test has some at a total gap of "
            f"{gap_mm:g} mm: its bumpers are those of the model that the identification began with"
        ]


def _join(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


NOTE = "# The last line is the SHA-256 of the lines above."
SEAL = re.compile(r"# sha256 ([0-9a-f]{64})")


def seal_text(text: str) -> str:
    """Return a text, of which lines with # are comments, with a note and the hash of its lines."""
    lines = [*text.splitlines(), NOTE]
    return "\n".join([*lines, f"# sha256 {_hash_lines(lines)}", ""])


def require_seal(text: str, name: str, remedy: str) -> None:
    """Raise InputError where a sealed text is not what was written.

    One without note and hash is of an earlier version or written by hand, and is accepted.
    """
    lines = text.splitlines()
    while lines and not lines[-1]:
        lines.pop()
    seal = SEAL.fullmatch(lines[-1]) if lines else None
    if seal is None and NOTE not in text:
        return
    if seal is None or seal[1] != _hash_lines(lines[:-1]):
        raise InputError(f"{name} was altered after it was written", remedy=remedy)


def _hash_lines(lines: list[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()
