"""One HTML file that tells a run.

What the summary states is shown as it stands there; the file refers to nothing outside itself.
"""

import json
from hashlib import sha256
from pathlib import Path

import numpy as np

from table_io.card import BadInput
from table_io.records import (
    Agreement,
    Check,
    Event,
    Fault,
    Gap,
    Level,
    Params,
    Response,
    Timing,
    Trip,
)
from twin.compare.watch import KINDS as WATCHED
from twin.service.evidence import Run, Summary, cards, gather, quantity
from twin.service.figures import Picture, draw_all
from twin.service.page import HERE, inside, page, significant
from twin.service.sensor_rows import sensor_rows
from twin.stream.recording import Recording, read

MOST_ROWS = 200


def write_report(folder: Path, recording: Recording | None = None) -> Path:
    """Path of folder/report.html, written anew with its figures from run.mcap and summary.json.

    A recording already at hand is not read again.
    """
    summary = _summary(folder / "summary.json")
    run = gather(recording or read(folder / "run.mcap"), summary)
    path = folder / "report.html"
    path.write_text(render(run, draw_all(run, folder / "figures")), encoding="utf-8")
    return path


def _summary(path: Path) -> Summary:
    """The summary of a run; BadInput where it is missing, damaged or something else."""
    remedy = "give the folder that run, replay or simulate wrote"
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        for step in summary["steps"]:
            _ = step["index"], step["frequency_hz"], step["direction"]
        _ = summary["run"].get("name"), summary["verdict"]
    except FileNotFoundError:
        raise BadInput(f"{path}: no such summary; {remedy}") from None
    except (OSError, ValueError) as error:
        raise BadInput(f"{path}: cannot read this summary: {error}; {remedy}") from None
    except (KeyError, TypeError, AttributeError) as error:
        raise BadInput(f"{path}: not the summary of a run (missing: {error}); {remedy}") from None
    return dict(summary)


def render(run: Run, pictures: list[Picture]) -> str:
    """The page, with every picture inside it."""
    start, recording = run.recording.start, run.recording
    texts = {name: getattr(start, f"{name}_toml") for name in ("profile", "rig", "model")}
    return page(
        HERE / "report.html",
        run=run,
        summary=run.summary,
        start=start,
        headline=headline(run),
        cards={name: cards(text) for name, text in texts.items()},
        images=inside(pictures),
        demand={step.index: step.acceleration_m_s2 for step in start.steps},
        texts=[(name, sha256(text.encode()).hexdigest(), text) for name, text in texts.items()],
        timings={one.component: one for one in recording.of(Timing)},
        gaps=recording.of(Gap),
        faults=recording.of(Fault),
        events=[one for one in recording.of(Event) if one.kind not in ("state", *WATCHED)],
        watched=[one for one in recording.of(Event) if one.kind in WATCHED],
        compared=any(np.isfinite(one.error).any() for one in recording.of(Agreement)),
        sensors=sensor_rows(start),
        states=recording.stop.states if recording.stop else (),
        checks=recording.of(Check),
        trips=recording.of(Trip),
        response=next(iter(recording.of(Response)), None),
        level=worst_level(run),
        parameters=recording.of(Params),
        most_rows=MOST_ROWS,
        quantity=quantity,
    )


def worst_level(run: Run) -> dict[str, float] | None:
    """Largest errors of the level over all steps, with and without control, and most updates."""
    found = [step["level"] for step in run.steps if step.get("level")]
    if not found:
        return None
    return {
        "controlled": max(abs(one["error"]) for one in found),
        "uncontrolled": max(abs(one["error_uncorrected"]) for one in found),
        "updates": max(one.update for one in run.recording.of(Level)),
        "steps": len(found),
    }


def headline(run: Run) -> str:
    """One sentence: how far it came, what it found."""
    done = sum(1 for step in run.steps if step.get("measured") or step.get("twin"))
    said = [f"{done} of {len(run.recording.start.steps) or len(run.steps)} steps"]
    said += [
        f"{one['kind']} hysteresis {one['from_hz']:g} to {one['to_hz']:g} Hz"
        for one in run.summary.get("hysteresis") or []
    ] or ["no hysteresis"]
    said += run.summary.get("found") or []
    sizes = np.nan_to_num([quantity(step, run.who, "eta_d") for step in run.steps])
    if sizes.any():
        best = run.steps[int(np.argmax(sizes))]
        where = f"{best['frequency_hz']:g} Hz {best['direction']}"
        said.append(f"largest normalised excursion {significant(sizes.max())} at {where}")
    return "; ".join(said) + "."
