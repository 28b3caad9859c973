"""Figure of the confusion matrix."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from twin.drawing.plot_style import RC_PARAMS


def draw_confusion_matrix(
    truths: Sequence[str], verdicts: Sequence[str], counts: Any, path: Path
) -> None:
    """Save counts (truth, verdict) as a PNG; shades are shares of each row."""
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    with mpl.rc_context(RC_PARAMS):
        figure = Figure(figsize=(max(2.5 + 0.26 * len(verdicts), 5.0), 2.2 + 0.2 * len(truths)))
        axes = figure.subplots()
        axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
        axes.set_xticks(
            range(len(verdicts)), verdicts, rotation=60, ha="right", rotation_mode="anchor"
        )
        axes.set_yticks(range(len(truths)), truths)
        axes.tick_params(labelsize=7)
        axes.set(xlabel="verdict", ylabel="hidden", title="Confusion matrix: number of cases")
        axes.grid(False)
        for (line, column), count in np.ndenumerate(counts):
            if count:
                shade = "white" if shares[line, column] > 0.6 else "black"
                axes.text(column, line, str(count), ha="center", va="center", color=shade, size=6)
        figure.savefig(path)
