"""Recent history of u and the contact force, measured and of both twins, for a plot over time."""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from table_io.block import Block, Float2D
from twin.viewer.motion import extract_motion, extract_track

TRACE_HZ = 200.0  # samples kept per second
MAX_TRACE_S = 40.0  # three cycles at the lowest frequency of most tests
MAX_TRACE_POINTS = 400  # of one history as returned
TWIN_TRACKS = ("free", "window")


@dataclass(slots=True)
class TraceBuffer:
    """Decimated samples by track: measured, free (free-running twin), window (restarted twin)."""

    parts: dict[str, deque[Float2D]] = field(default_factory=dict)

    def add(self, block: Block) -> None:
        """Add a block of the measurement or of the twins; older ones after newer ones clear."""
        tracks = (
            {"measured": block}
            if block.stream == "meas"
            else {name: extract_track(block, name) for name in TWIN_TRACKS}
        )
        stride = max(round(block.rate_hz / TRACE_HZ), 1)
        for name, track in tracks.items():
            motion = extract_motion(track)
            rows = np.stack([motion.index, motion.u, motion.force_r + motion.force_l])
            rows = rows[:, motion.index % stride == 0]
            if not rows.size:
                continue
            parts = self.parts.setdefault(name, deque())
            if parts and rows[0, 0] <= parts[-1][0, -1]:
                parts.clear()
            parts.append(rows)
            while parts[0][0, 0] < rows[0, -1] - MAX_TRACE_S * block.rate_hz:
                parts.popleft()

    def select_last(self, samples: float) -> dict[str, Float2D]:
        """Return (index, u in m, force in N) by track over the last `samples` of the measurement.

        Each is (3, point) with at most `MAX_TRACE_POINTS` points.
        """
        joined = {name: np.concatenate(parts, axis=1) for name, parts in self.parts.items()}
        if "measured" not in joined:
            return {}
        first = joined["measured"][0, -1] - samples
        selected = {name: rows[:, rows[0] >= first] for name, rows in joined.items()}
        stride = -(-selected["measured"].shape[1] // MAX_TRACE_POINTS)
        return {name: rows[:, ::stride] for name, rows in selected.items()}
