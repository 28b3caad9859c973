"""A case as files: what is shown in cases/<label>, what is hidden in sealed/<label>.

    cases/<label>   log.mcap  profile.toml  model.toml
    sealed/<label>  truth.toml  about.json

The recording is that of the real session on the simulated table, unpaced; it holds the nominal
values and a hash of the sealed file, which has salt in it.
"""

import hashlib
import json
import math
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from table_io.backends import open_backend
from table_io.clock import ManualClock
from table_io.records import RunStop
from table_io.session import play
from twin.service.bundle import from_texts
from twin.service.study.bench import (
    MODEL_TOML,
    NOMINAL_RIG,
    PROFILE,
    PROFILE_TOML,
    Signals,
    noise_rms,
    played,
    rig_toml,
    toml,
)
from twin.service.study.cells import Case, Planted
from twin.service.study.sizing import Residual, departed, read, residual, sized
from twin.stream.mcap_log import write_items

DIGITS = 6  # of a number in the truth


@dataclass(frozen=True, slots=True)
class Places:
    """The folders and files of a case."""

    root: Path
    label: str

    @property
    def shown(self) -> Path:
        return self.root / "cases" / self.label

    @property
    def sealed(self) -> Path:
        return self.root / "sealed" / self.label

    @property
    def log(self) -> Path:
        return self.shown / "log.mcap"

    @property
    def verdict(self) -> Path:
        return self.shown / "verdict.json"

    @property
    def about(self) -> Path:
        return self.sealed / "about.json"


def make(case: Case, root: Path) -> Places:
    """The files of a case; nothing where they are there. `about.json` comes last: with it a case
    is whole, without it it is made anew."""
    places = Places(root, case.label)
    if places.about.is_file():
        return places
    for folder in (places.shown, places.sealed):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    shares, left = _shares(case)
    sealed = places.sealed / "truth.toml"
    text = f"# {case.salt}\n" + toml(truth(case, case.planted, shares))
    sealed.write_text(text, encoding="utf-8")
    ended = f"not played: the effect reaches size {left.size:.3g}"
    if case.cell.takes(left.size):
        stop = _record(case, places, sealed.resolve(), _sha256(text))
        ended = stop.verdict if stop.verdict == "complete" else f"{stop.verdict}: {stop.reason}"
    (places.shown / "profile.toml").write_text(PROFILE_TOML, encoding="utf-8")
    (places.shown / "model.toml").write_text(MODEL_TOML, encoding="utf-8")
    about = {
        "number": case.number,
        "cell": case.cell.name,
        "kind": case.cell.kind,
        "noise": case.cell.noise,
        "size": case.cell.size,
        "reached": left.size,
        "ended": ended,
        "sized": ended == "complete",
        "region": left.region if case.planted else None,
        "effects": [_told(one, share) for one, share in zip(case.planted, shares, strict=True)],
    }
    places.about.write_text(json.dumps(about, indent=1), encoding="utf-8")
    return places


def _told(one: Planted, share: float) -> dict[str, Any]:
    """An effect as the scoring wants it."""
    return {
        "name": one.hidden.name,
        "form": one.hidden.kind.form,
        "parameters": _rounded(departed(one, share)),
        "vanishing": {each.name: each.vanishing for each in one.hidden.amplitudes},
    }


def truth(case: Case, planted: Sequence[Planted], shares: Sequence[float]) -> dict[str, Any]:
    """What the sealed file says: the scattered base, and effects so far from vanishing."""
    table, off = NOMINAL_RIG["simulated"], case.base
    names = ("damper_stiffness", "damper_damping", "bumper_stiffness", "bumper_damping")
    units = ("n_m", "n_s_m", "n_m", "n_s_m")
    keys = [f"{name}_{unit}" for name, unit in zip(names, units, strict=True)]
    base = {key: off[name] * table[key] for key, name in zip(keys, names, strict=True)}
    right, left = PROFILE.specimen.gaps_m
    base |= {"gap_right_m": off["gap"] * right, "gap_left_m": off["gap"] * left}
    effects = [
        {"id": one.hidden.kind.id, "form": one.hidden.kind.form}
        | ({"channel": one.hidden.channel} if one.hidden.channel else {})
        | {"parameters": _rounded(departed(one, share))}
        for one, share in zip(planted, shares, strict=True)
    ]
    return {"base": _rounded(base)} | ({"effects": effects} if effects else {})


def _shares(case: Case) -> tuple[list[float], Residual]:
    """How far each effect goes to leave the cell's size alone, and what all of them leave."""
    noise = noise_rms(case.cell.noise)

    @cache
    def unmoved() -> Signals:
        """Played once: sensors are read off signals that they do not change."""
        return _true(case, [], [])

    def left(planted: Sequence[Planted], shares: Sequence[float]) -> Residual:
        sensors = [one.hidden.kind.sensor for one in planted]
        seen = signals = unmoved() if all(sensors) else _true(case, planted, shares)
        for one, share in zip(planted, shares, strict=True):
            seen = read(one, share, seen)
        return residual(seen, signals, noise)

    def alone(one: Planted) -> tuple[float, Residual]:
        return sized(one, case.cell.size, lambda share: left([one], [share]))

    found = [alone(one) for one in case.planted]
    shares = [share for share, _ in found]
    return shares, found[0][1] if len(found) == 1 else left(case.planted, shares)


def _true(case: Case, planted: Sequence[Planted], shares: Sequence[float]) -> Signals:
    text = toml(truth(case, planted, shares))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "truth.toml"
        path.write_text(text, encoding="utf-8")
        return played(rig_toml(0.0, truth=str(path), sha256=_sha256(text)))


def _record(case: Case, places: Places, sealed: Path, sha256: str) -> RunStop:
    """The session's recording, and how it ended."""
    rig = rig_toml(case.cell.noise, case.noise_seed, str(sealed), sha256)
    bundle = from_texts("case", PROFILE_TOML, rig, MODEL_TOML, f"case {case.label}")
    clock = ManualClock()
    backend = open_backend(bundle.rig, bundle.profile, clock)
    describe = bundle.describe(case.label, "table")
    start, *rest = play(bundle.session, backend, clock, describe, lambda: None)
    assert not isinstance(start, RunStop)
    write_items(places.log, [start, *rest], start)  # type: ignore[arg-type]
    ended = rest[-1]
    assert isinstance(ended, RunStop)
    return ended


def _rounded(values: dict[str, float]) -> dict[str, float]:
    return {name: float(f"{one:.{DIGITS}g}") for name, one in values.items() if math.isfinite(one)}


def _sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
