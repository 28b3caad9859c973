"""Controls that must fail: what discovery says where there is nothing to be right about.

reversed    the recording backwards in time: its losses become gains, no effect here does that
without     the truth is not in the library: another name with confidence would be wrong
shuffled    verdicts scored against the truth of other cases: no better than a fixed guess (beside)
"""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from twin.learn.discover import Log, discover
from twin.learn.readings import Readings
from twin.model.model import Model
from twin.service.learning.told import verdict_json
from twin.service.study.asking import opened
from twin.service.study.beside import WAYS
from twin.service.study.cells import case_of
from twin.service.study.making import make
from twin.service.study.scoring import name_of

Json = dict[str, Any]
Spectrum = npt.NDArray[np.complex128]
CELLS = "single/*/3/1%"
SURE = 0.5  # a name said with more confidence than this is a confident one


def control(root: Path, number: int) -> Json:
    """The row of a case under both controls; `sized` False where it has not the size asked for."""
    case = case_of(number)
    row: Json = {"number": number, "cell": case.cell.name}
    try:
        places = make(case, root)
        about = json.loads(places.about.read_text(encoding="utf-8"))
        row |= {"sized": about["sized"], "ended": about["ended"]}
        if not about["sized"]:
            return row
        row["truth"] = [one["name"] for one in about["effects"]]
        logs, _, model = opened(places.shown)
        ids = [one.hidden.kind.id for one in case.planted]
        found = (backwards(logs, model), without(logs, model, ids))
        told = {way: said(one) for way, one in zip(WAYS, found, strict=True)}
    except Exception as error:
        return row | {"failed": f"{type(error).__name__}: {error}"}
    return row | told | {"right": not any(one["fooled"] for one in told.values())}


def backwards(logs: Sequence[Log], model: Model) -> Json:
    """The verdict on recordings that run backwards."""
    return verdict_json(discover([reversed_in_time(one) for one in logs], model))


def without(logs: Sequence[Log], model: Model, effects: Sequence[str]) -> Json:
    """The verdict with these effects left out of the library."""
    return verdict_json(discover(logs, model, without=effects))


def said(verdict: Json) -> Json:
    """What a verdict comes down to; `fooled`: it gives a name and is confident of it."""
    effects = verdict["effects"] if verdict["verdict"] == "named" else []
    sure = max((float(one["confidence"]) for one in effects), default=None)
    return {
        "said": verdict["verdict"], "named": [name_of(one) for one in effects],
        "confidence": sure, "fooled": sure is not None and sure > SURE,
    }  # fmt: skip


def reversed_in_time(log: Log) -> Log:
    """The log backwards: displacements, accelerations and forces as they were, velocities turned.

    What is known of the sensors (noise, readings at rest) stays, as does what a step is called.
    """
    r = log.readings
    turned = replace(
        r,
        spectra={name: _turned(r, one) for name, one in r.spectra.items()},
        ones=_turned(r, r.ones),
        step=r.step[::-1], label=r.label[::-1], cycle=r.cycle[::-1], good=r.good[::-1],
    )  # fmt: skip
    return replace(log, readings=turned)


def _turned(r: Readings, spectrum: Spectrum) -> Spectrum:
    """Spectrum of x(T - t), T the last kept sample, so that samples fall on samples."""
    last_s = (r.time_s.size - 1) * r.grid.every / r.grid.rate_hz
    turned: Spectrum = np.conj(spectrum) * np.exp(-1j * r.w * last_s)
    return turned
