"""The confusion matrix as a picture."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from twin.service.figures import STYLE


def draw(truths: Sequence[str], said: Sequence[str], counts: Any, path: Path) -> None:
    """Counts (truth, said) as a PNG; shades are shares of each line."""
    shares = counts / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(max(2.5 + 0.26 * len(said), 5.0), 2.2 + 0.2 * len(truths)))
        axes = figure.subplots()
        axes.imshow(shares, cmap="Blues", vmin=0.0, vmax=1.0, aspect="auto")
        axes.set_xticks(range(len(said)), said, rotation=60, ha="right", rotation_mode="anchor")
        axes.set_yticks(range(len(truths)), truths)
        axes.tick_params(labelsize=7)
        axes.set(xlabel="said", ylabel="hidden", title="Hidden and said: cases")
        axes.grid(False)
        for (line, column), count in np.ndenumerate(counts):
            if count:
                shade = "white" if shares[line, column] > 0.6 else "black"
                axes.text(column, line, str(count), ha="center", va="center", color=shade, size=6)
        figure.savefig(path)
