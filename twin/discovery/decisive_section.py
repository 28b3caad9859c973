"""Section on the proposed test of `discover --decide`: content of verdict.json, and its figure."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from table_io.block import Block, Label
from table_io.records import Step
from twin.discovery.decisive_test import TestProposal
from twin.discovery.experiment_design import TestPrediction
from twin.discovery.serialize import Json
from twin.drawing.plot_style import FIGURE_WIDTH_IN, CaptionedFigure, CaptionedFigures

MAX_OTHER_TESTS, MAX_DRAWN_RIVALS = 4, 4
RIVAL_STYLES = (("#1559b0", "o-"), ("#cf222e", "s--"), ("#1a7f37", "^:"), ("#9a6700", "v-."))


def proposal_to_json(proposals: Sequence[TestProposal], profile: str) -> Json | None:
    """Return the block `decide` of verdict.json; None without a proposal."""
    if not proposals:
        return None
    proposal, *others = proposals
    prediction, test = proposal.prediction, proposal.test
    return {
        "title": test.title,
        "purpose": proposal.purpose,
        "profile": profile,
        "set_up": test.set_up,
        "confirmation": prediction.is_confirmation,
        "minutes": test.minutes,
        "sigma": prediction.sigma,
        "probability": prediction.probability,
        "separation_per_min": prediction.separation_per_minute,
        "count": proposal.count,
        "rivals": [
            _rival_to_json(prediction, index, test.config.steps)
            for index in range(len(prediction.rivals))
        ],
        "others": [
            {
                "title": other.test.title,
                "minutes": other.test.minutes,
                "sigma": other.prediction.sigma,
                "probability": other.prediction.probability,
            }
            for other in others[:MAX_OTHER_TESTS]
        ],
    }


def describe_next_run(decide: Json) -> str:
    """Return the sentence on the proposed test that stands for the general suggestion."""
    set_up = f", {decide['set_up']}" if decide["set_up"] else ""
    return (
        f"{decide['title']}{set_up} ({decide['profile']}, {decide['minutes']:.2g} min): "
        f"{decide['purpose']}; {decide['sigma']:.2g} standard errors are expected, with a "
        f"probability of {100 * decide['probability']:.0f} %"
        f"{' for each' if decide['confirmation'] else ' for a decision'}"
    )


def _rival_to_json(prediction: TestPrediction, index: int, steps: Sequence[Step]) -> Json:
    """Return a rival with its expected separation and peaks."""
    as_true = [pair.sigma for pair in prediction.pairs if pair.truth == index]
    as_other = [pair.misfit for pair in prediction.pairs if pair.other == index]
    simulated = prediction.simulated.get(index)
    return {
        "id": prediction.rivals[index].name,
        "misfit": max(as_other, default=None),
        "sigma": min(as_true, default=None),
        "peaks": _list_peaks(simulated, steps) if simulated is not None else [],
    }


def _list_peaks(block: Block, steps: Sequence[Step]) -> list[Json]:
    """Return the largest displacement of the mass against the table in each step or window."""
    if "rel_disp_m" in block.channels:
        disp = block.channel("rel_disp_m")
    else:
        disp = block.channel("mass_disp_m") - block.channel("table_disp_m")
    measured = block.label == Label.MEASURE
    by_index = {step.index: step for step in steps}
    return [
        {
            "frequency_hz": by_index[number].frequency_hz if number in by_index else None,
            "direction": by_index[number].direction if number in by_index else f"window {number}",
            "peak_disp_m": float(np.abs(disp[measured & (block.step == number)]).max()),
        }
        for number in np.unique(block.step[measured]).tolist()
        if number >= 0
    ]


def draw_prediction(decide: Json | None) -> CaptionedFigures:
    """Draw the peaks that each rival predicts for the proposed test."""
    rivals = [rival for rival in (decide or {}).get("rivals", ()) if rival["peaks"]]
    if decide is None or not rivals:
        return
    figure = Figure(figsize=(FIGURE_WIDTH_IN, 3.2))
    ax = figure.subplots()
    for (colour, style), rival in zip(RIVAL_STYLES, rivals[:MAX_DRAWN_RIVALS], strict=False):
        peaks = [1e3 * peak["peak_disp_m"] for peak in rival["peaks"]]
        ax.plot(np.arange(len(peaks)), peaks, style, color=colour, label=rival["id"], ms=4)
    ticks = [
        f"{peak['frequency_hz']:g} Hz" if peak["frequency_hz"] else peak["direction"]
        for peak in rivals[0]["peaks"]
    ]
    ax.set_xticks(np.arange(len(ticks)), ticks, rotation=60)
    ax.set_xlabel("steps or windows, in the order in which they are played")
    ax.set_ylabel("largest |u|, mm")
    ax.set_ylim(bottom=0)
    ax.legend()
    caption = (
        "Displacement of the mass against the table if each explanation is true, with the "
        "parameters of its fit. The separation is not this difference, which other parameters may "
        "absorb, but what remains of it in the forces after each is fitted again."
    )
    yield CaptionedFigure("decide", f"Expected in: {decide['title']}", caption, figure)
