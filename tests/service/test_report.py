"""The report of a run: what it shows is what was recorded, whatever is missing."""

import json
import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.image import imread

from table_io.block import Block, Label
from table_io.profile import BadInput
from table_io.records import Comparison, Event, Fault, Gap, RunStart, RunStop, Step, Timing
from twin.compare import COMPARED, PREDICTED
from twin.service.figures import draw_all
from twin.service.report import (
    chosen,
    gather,
    motion,
    render,
    significant,
    step_errors,
    write_report,
)
from twin.stream.mcap_log import read, write_items
from twin.stream.wire import Item

RATE, CYCLES, GRID = 500.0, 3, (1.0, 1.5, 2.0, 2.5)
MEASURED = (
    "table_disp_m", "table_acc_m_s2", "mass_disp_m", "mass_acc_m_s2",
    "force_r1_n", "force_r2_n", "force_l1_n", "force_l2_n",
)  # fmt: skip
PROFILE = """
title = "Quick <i>look</i>"
notes = "<script>alert('no')</script> & more"
[specimen]
mass_kg = 550.0
gap_mm = {gap}
"""
STEPS = tuple(
    Step(k, direction, hz, 0.49)
    for k, (direction, hz) in enumerate(
        [("forward", hz) for hz in GRID] + [("backward", hz) for hz in reversed(GRID)]
    )
)


def start_record(gap: str = "4.0") -> RunStart:
    return RunStart(
        index=0, run="20250101-000000-quick", name="quick", source="table",
        profile_toml=PROFILE.format(gap=gap), rig_toml='title = "Rig & table"',
        model_toml='title = "Model <1>"\n[base]\nstiffness_n_m = 36000.0', rate_hz=RATE,
        block_samples=50, channels=MEASURED, steps=STEPS, planned_samples=0,
        tare={"mass_disp_m": 1.25e-4}, versions={"shaketwin": "0.1.0"}, host="lab-host",
        started_at="2025-01-01T00:00:00", epoch_s=0.0,
    )  # fmt: skip


def amplitude(step: Step) -> float:
    """u in m: 2.5 Hz answers large forward, small backward."""
    return 4e-3 if step.direction == "forward" else 1e-3


def signals(step: Step, scale: float) -> dict[str, Any]:
    """A sine with contact above 2 mm, by channel."""
    n = round(CYCLES * RATE / step.frequency_hz)
    w = 2 * math.pi * step.frequency_hz
    u = scale * amplitude(step) * np.sin(w * np.arange(n) / RATE)
    right = 250e3 * np.maximum(u - 2e-3, 0)
    left = 250e3 * np.maximum(-u - 2e-3, 0)
    table = 1e-2 * np.cos(w * np.arange(n) / RATE)
    return {
        "table_disp_m": table, "table_acc_m_s2": -(w**2) * table, "mass_disp_m": u + table,
        "mass_acc_m_s2": -(w**2) * u, "rel_disp_m": u, "rel_vel_m_s": np.gradient(u, 1 / RATE),
        "force_r1_n": right, "force_r2_n": right, "force_l1_n": left, "force_l2_n": left,
    }  # fmt: skip


def blocks(channels: tuple[str, ...] = MEASURED) -> list[Item]:
    """Measured and predicted blocks of all steps, one a step, and their comparisons."""
    items: list[Item] = []
    index = 0
    for step in STEPS:
        rig, twin = signals(step, 1.0), signals(step, 1.1)
        n = rig["rel_disp_m"].size
        labels = np.full(n, step.index), np.full(n, int(Label.MEASURE)), np.arange(n) * CYCLES // n
        values = np.array([rig[name] for name in channels]).reshape(len(channels), n)
        items.append(Block("meas", index, RATE, channels, values, *labels))
        values = np.array([twin[name.split("/")[1]] for name in PREDICTED])
        items.append(Block("pred", index, RATE, PREDICTED, values, *labels))
        ss = tuple(float((rig[name] ** 2).sum()) for name in COMPARED)
        free, window = (tuple(part**2 * one for one in ss) for part in (0.1, 0.05))
        items.append(Comparison(index, n, COMPARED, ss, free, window))
        index += n
    return [*items, RunStop(index, "complete", "all steps driven")]


def summary(who: tuple[str, ...] = ("measured", "twin")) -> dict[str, Any]:
    def quantities(step: Step, scale: float) -> dict[str, Any]:
        eta = scale * (0.1234 + 0.01 * step.index)
        return {
            "eta_d": eta, "eta_a": 0.5678, "eta_r": 0.0345, "eta_l": 0.0346, "r_r": 0.211,
            "r_l": 0.212, "impacts_right": [2, 3, 2], "impacts_left": [1, 1, 1],
            "drift": 0.0123, "spread": 0.01,
        }  # fmt: skip

    steps = [
        {
            "index": step.index, "direction": step.direction, "frequency_hz": step.frequency_hz,
            "measured": quantities(step, 1.0) if "measured" in who else None,
            "twin": quantities(step, 1.1) if "twin" in who else None,
            "table_acc_peak_m_s2": 0.4876, "thd": 0.0215,
        }
        for step in STEPS
    ]  # fmt: skip
    return {
        "run": {"name": "quick", "title": "Quick <i>look</i>", "source": "table",
                "normalisation": "model, continuous"},
        "verdict": "complete", "reason": "all steps driven", "gaps": 0,
        "u_star_m": 0.030537, "a_star_m_s2": 2.057, "steps": steps,
        "jumps": [{"direction": "forward", "from_hz": 2.0, "to_hz": 2.5, "kind": "down"}],
        "hysteresis": [{"kind": "right", "from_hz": 1.5, "to_hz": 2.0}],
        "timing": {"latency_ms": {"p50": 1.11, "p99": 2.22, "max": 3.33}, "missed_deadlines": 0},
        "comparison": {"rel_disp_m": {"nrmse": 0.0512, "free_nrmse": 0.1021}},
    }  # fmt: skip


Maker = Callable[..., Path]


@pytest.fixture
def run_folder(tmp_path: Path) -> Maker:
    """Writes run.mcap and summary.json; returns their folder."""

    def make(items: list[Item] | None = None, told: Any = None, gap: str = "4.0") -> Path:
        start = start_record(gap)
        write_items(tmp_path / "run.mcap", [start, *(blocks() if items is None else items)], start)
        (tmp_path / "summary.json").write_text(json.dumps(summary() if told is None else told))
        return tmp_path

    return make


def page(folder: Path) -> str:
    return write_report(folder).read_text(encoding="utf-8")


def bare(folder: Path) -> str:
    """The page without its pictures, which take their time."""
    told = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return render(gather(read(folder / "run.mcap"), told), [])


def words(html: str) -> str:
    """The page as a reader sees it, markup and pictures left out."""
    return " ".join(re.sub(r"<[^>]*>", " ", html).split())


def test_numbers_are_those_of_the_summary(run_folder: Maker) -> None:
    text = words(bare(run_folder()))
    for number in ("0.123", "0.136", "0.568", "0.0345", "0.212", "2 3 2", "1.23", "0.488", "2.15"):
        assert number in text
    for number in ("30.54", "2.057", "1.11", "2.22", "3.33", "0.0512", "0.102"):
        assert number in text


def test_jumps_and_hysteresis_are_told_and_the_verdict_stands_on_top(run_folder: Maker) -> None:
    text = words(bare(run_folder()))
    assert "hysteresis right both 1.5 2" in text
    assert "jump 1 down forward 2 2.5" in text
    assert text.index("8 of 8 steps; right hysteresis 1.5 to 2 Hz") < text.index("What was run")


def test_page_refers_to_nothing_outside_itself(run_folder: Maker) -> None:
    html = page(run_folder())
    assert not re.search(r"https?://|url\(|@import|<link|<script|<iframe", html)
    sources = re.findall(r'(?:src|href|srcset)="([^"]{0,22})', html)
    assert sources
    assert all(source.startswith("data:image/png;base64,") for source in sources)


def test_markup_in_texts_and_events_is_escaped(run_folder: Maker) -> None:
    html = bare(run_folder([*blocks(), Event(3, "note", "<img src=x onerror=y>")]))
    assert "<script>" not in html
    assert "<img src=x" not in html
    assert "&lt;script&gt;alert" in html
    assert "&lt;img src=x onerror=y&gt;" in html
    assert "<h1>Quick &lt;i&gt;look&lt;/i&gt;</h1>" in html


def test_what_happened_is_listed(run_folder: Maker) -> None:
    items: list[Item] = [
        *blocks(), Gap(100, 7, "force_l2_n", "clipped"), Fault(500, "twin", 500, 750, "killed"),
        Timing(900, "recorder", 1.5, 4.25, 9.75, 3, 10, 0.1, "SCHED_FIFO"),
    ]  # fmt: skip
    text = words(bare(run_folder(items)))
    assert "0.200 100 7 force_l2_n clipped" in text
    assert "twin 1.000 1.500 killed" in text
    assert "recorder 1.50 4.25 9.75 3 10 10.0 SCHED_FIFO" in text
    assert "lab-host" in text
    assert "mass_disp_m 0.0001250" in text


def test_figures_are_written_and_not_blank(run_folder: Maker) -> None:
    folder = run_folder()
    pictures = draw_all(read(folder / "run.mcap"), summary(), folder / "figures")
    names = [picture.path.stem for picture in pictures]
    for name in ("prc", "impacts", "portraits", "loops", "bumpers", "comparison", "overview"):
        assert name in names
    for picture in pictures:
        pixels = imread(picture.path)[..., :3]
        inked = (pixels < 0.9).any(axis=2)
        assert inked.mean() > 0.01, picture.path.name
        assert inked.any(axis=0).mean() > 0.6, picture.path.name
        assert picture.caption


def test_steps_looked_at_are_hysteresis_peak_and_most_impacts(run_folder: Maker) -> None:
    told = summary()
    told["steps"][0]["measured"]["impacts_left"] = [4, 4, 4]
    folder = run_folder(told=told)
    reasons = chosen(gather(read(folder / "run.mcap"), told))
    assert reasons == {
        1.0: "largest excursion, most impacts per cycle",  # backward ends at 1 Hz, eta_d rises
        1.5: "inside the right hysteresis",
    }


def test_pictures_show_measured_samples_and_leave_gaps_empty(run_folder: Maker) -> None:
    items = blocks()
    whole = next(item for item in items if isinstance(item, Block) and item.step[0] == 1)
    parts = [whole.cut(whole.index, whole.index + 400), whole.cut(whole.index + 450, whole.end)]
    folder = run_folder([*(item for item in items if item is not whole), *parts])
    found = motion(gather(read(folder / "run.mcap"), summary()), "meas", 1)
    assert found is not None
    assert found.u.size == len(whole)
    assert np.isnan(found.u[400:450]).all()
    truth = signals(STEPS[1], 1.0)
    np.testing.assert_allclose(found.u[:400], truth["rel_disp_m"][:400], atol=1e-12)
    known = np.isfinite(found.v)
    peak = np.abs(truth["rel_vel_m_s"]).max()
    np.testing.assert_allclose(found.v[known], truth["rel_vel_m_s"][known], atol=0.01 * peak)


def test_errors_per_step_are_those_of_the_comparisons(run_folder: Maker) -> None:
    errors = step_errors(gather(read(run_folder() / "run.mcap"), summary()))
    assert errors["u"][0] == pytest.approx((0.1, 0.05))
    assert errors["F_R"][0] == pytest.approx((0.1, 0.05))
    assert np.isnan(errors["F_R"][7]).all()  # backward never touches


def test_model_alone(run_folder: Maker) -> None:
    told = {**summary(("twin",)), "comparison": {}}
    items = [one for one in blocks() if not isinstance(one, Comparison) and one.index >= 0]
    folder = run_folder(
        [i for i in items if not (isinstance(i, Block) and i.stream == "meas")], told
    )
    text = words(page(folder))
    assert "Model alone, nothing measured" in text
    assert "0.136" in text
    assert not (folder / "figures" / "comparison.png").exists()
    assert (folder / "figures" / "prc.png").exists()


def test_no_bumpers_no_force_pictures(run_folder: Maker) -> None:
    folder = run_folder(blocks(MEASURED[:4]), gap="inf")
    text = words(page(folder))
    assert "no bumpers, free flight" in text
    assert "Impacts per forcing cycle" not in text
    assert not (folder / "figures" / "bumpers.png").exists()


@pytest.mark.parametrize("lost", ["mass_disp_m", "mass_acc_m_s2", "table_acc_m_s2", "force_l1_n"])
def test_a_lost_channel_never_stops_the_report(run_folder: Maker, lost: str) -> None:
    assert "Complete" in page(run_folder(blocks(tuple(c for c in MEASURED if c != lost)))).title()


def test_stopped_before_the_first_step(run_folder: Maker) -> None:
    told = {**summary(), "steps": [], "jumps": [], "hysteresis": [], "verdict": "stopped"}
    text = words(page(run_folder([RunStop(0, "stopped", "operator")], told)))
    assert "0 of 8 steps" in text
    assert "No step was finished." in text


def test_stopped_after_one_step(run_folder: Maker) -> None:
    told = {**summary(), "verdict": "stopped", "hysteresis": [], "jumps": [], "timing": {}}
    told["steps"] = told["steps"][:1]
    assert "1 of 8 steps" in words(page(run_folder(blocks()[:3], told)))


def test_missing_numbers_are_dashes(run_folder: Maker) -> None:
    told = summary()
    told["steps"][2]["measured"] = None
    told["steps"][3]["twin"]["eta_d"] = None
    told["steps"][4]["measured"]["eta_a"] = math.nan
    told["steps"][5].update(thd=None, table_acc_peak_m_s2=None)
    told.update(u_star_m=None, comparison={"rel_disp_m": {"nrmse": None}})
    told["timing"]["latency_ms"] = {"p50": None, "p99": None, "max": None}
    text = words(page(run_folder(told=told)))
    assert not re.search(r"\bnan\b", text)
    assert "None" not in text.replace("None.", "")
    assert "u* = – mm" in text


def test_nothing_recorded_is_touched(run_folder: Maker) -> None:
    folder = run_folder()
    before = [(folder / name).read_bytes() for name in ("run.mcap", "summary.json")]
    assert page(folder) == page(folder)
    assert [(folder / name).read_bytes() for name in ("run.mcap", "summary.json")] == before


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"run": {}, "verdict": "x", "steps": [1]}'])
def test_damaged_summary_is_one_message(run_folder: Maker, text: str) -> None:
    folder = run_folder()
    (folder / "summary.json").write_text(text)
    with pytest.raises(BadInput, match=r"summary\.json.*give the folder"):
        write_report(folder)


@pytest.mark.parametrize("name", ["summary.json", "run.mcap"])
def test_missing_file_is_named(run_folder: Maker, name: str) -> None:
    folder = run_folder()
    (folder / name).unlink()
    with pytest.raises(BadInput, match=name.replace(".", r"\.")):
        write_report(folder)


def test_import_without_profile(run_folder: Maker, tmp_path: Path) -> None:
    start = replace(start_record(), profile_toml="", rig_toml="", model_toml="not = [toml")
    run_folder()
    (tmp_path / "run.mcap").unlink()
    write_items(tmp_path / "run.mcap", [start, *blocks()], start)
    assert "not known: the recording brought no profile" in words(bare(tmp_path))


@pytest.mark.parametrize(
    "value, text",
    [(0.12345, "0.123"), (12.345, "12.3"), (1234.5, "1234"), (0.0, "0"), (-0.5, "−0.500"),
     (None, "–"), (math.nan, "–"), (1.5e-12, "1.50·10^−12")],
)  # fmt: skip
def test_significant_digits(value: float | None, text: str) -> None:
    assert significant(value) == text
