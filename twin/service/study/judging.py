"""One case from its number to its row: made, judged blind, scored against the sealed truth."""

import contextlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from table_io.clock import cpu_seconds
from twin.service.study.asking import discovered, true_structure
from twin.service.study.cells import case_of
from twin.service.study.making import Places, make
from twin.service.study.rivals import installed
from twin.service.study.scoring import score
from twin.service.summary import dumps

Json = dict[str, Any]
Method = Callable[[Path], Json]  # folder of a case -> verdict as in verdict.json
# Other methods on the same files: each gives a verdict, scored the same, beside ours in the row.
RIVALS: dict[str, Method] = installed()


def judge(root: Path, number: int, method: Method = discovered) -> Json:
    """The row of a case; one whose verdict fails says why under `failed`, and is a miss.

    One that has not the size of its cell, or was stopped on the table, is not judged.
    """
    case = case_of(number)
    began = cpu_seconds()  # of this process: what else the machine does is not counted
    try:
        places = make(case, root)
    except Exception as error:
        return {"number": number, "cell": case.cell.name, "failed": _said(error)}
    about = json.loads(places.about.read_text(encoding="utf-8"))
    made = cpu_seconds()
    if not about["sized"]:
        keys = ("number", "cell", "kind", "noise", "size", "reached", "ended", "sized")
        return {key: about[key] for key in keys} | {"label": case.label, "made_in": made - began}
    verdict, why = _asked(method, places.shown)
    judged = cpu_seconds()
    places.verdict.write_text(dumps(verdict), encoding="utf-8")
    truth = [one["name"] for one in about["effects"]]
    oracle = None if about["kind"] == "unknown" else _fitted(places, truth)
    row = _scored(verdict, about, oracle)
    if oracle and about["kind"] == "pair":
        row["mark"] = _mark(places, truth, oracle)
    told = {name: _asked(rival, places.shown) for name, rival in RIVALS.items()}
    rivals = {
        name: _scored(found, about) | ({"failed": why_not} if why_not else {})
        for name, (found, why_not) in told.items()
    }
    row |= {"label": case.label, "seconds": judged - made, "made_in": made - began}
    return row | ({"failed": why} if why else {}) | ({"rivals": rivals} if rivals else {})


def _scored(verdict: Json, about: Json, oracle: float | None = None) -> Json:
    """The score, and the held-out error itself, rms over the noise, to lay beside a rival's."""
    gap = verdict.get("gap") or {}
    return score(verdict, about, oracle) | {"held_out": gap.get("held_out_after")}


def _asked(method: Method, shown: Path) -> tuple[Json, str]:
    """(verdict, why there is none): a method that fails ends one case, not the study."""
    try:
        return method(shown), ""
    except Exception as error:
        return {"verdict": "failed", "reason": _said(error)}, _said(error)


def _fitted(places: Places, effects: Sequence[str]) -> float | None:
    """Held-out error with exactly these effects; None where no model of the library has them."""
    with contextlib.suppress(Exception):  # whatever it is, the verdict stands without
        return true_structure(places.shown, effects)
    return None


def _mark(places: Places, truth: Sequence[str], oracle: float) -> float | None:
    """By what factor the held-out error grows without one of two effects, of the lesser one."""
    alone = [_fitted(places, [name]) for name in truth]
    known = [one / oracle for one in alone if one is not None]
    return min(known) if len(known) == len(truth) else None


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}"
