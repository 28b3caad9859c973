"""A recording as the CSV that somebody else would have made of it."""

from pathlib import Path

import numpy as np

from twin.recording.reader import Recording


def write_csv(recording: Recording, path: Path, names: tuple[str, ...] = ()) -> np.ndarray:
    """Writes time_s and the channels (all, or those named); the rows, (row, column)."""
    pieces = recording.contiguous_blocks("meas")
    names = names or pieces[0].channels
    rows = np.concatenate(
        [np.array([piece.time_s, *(piece.channel(name) for name in names)]).T for piece in pieces]
    )
    with path.open("w") as file:
        file.write(",".join(["time_s", *names]) + "\n")
        np.savetxt(file, rows, fmt="%.9g", delimiter=",")
    return rows
