"""Folders for results: new ones are made, and what is in one already is never touched."""

from itertools import count
from pathlib import Path

from table_io.card import BadInput
from twin.service.bundle import run_id

RUNS = Path("runs")


def new_run(out: Path | None, name: str) -> tuple[Path, str]:
    """(an empty folder for a run of this name, the run's id), as in `new_folder`."""
    run = run_id(name)
    folder = new_folder(out, run)
    return folder, run if out is not None else folder.name


def new_folder(out: Path | None, run: str) -> Path:
    """An empty folder for results: `out`, or runs/<run>, or the next name that is free there.

    BadInput where `out` has content or nothing can be written there.
    """
    folder = RUNS / run if out is None else out
    try:
        if out is None:
            folder = _free(folder)
        elif out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise BadInput(
                f"--out {out}: exists and has content; nothing recorded is ever overwritten. "
                "Give a new folder"
            )
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise BadInput(f"--out {folder}: cannot write here: {error.strerror}") from None
    return folder


def _free(folder: Path) -> Path:
    """This folder or the first of <folder>-2, -3 and so on that nobody has; made, so that it is
    ours."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        free = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            free.mkdir()
        except FileExistsError:
            continue
        return free
    raise AssertionError("there is always a next name")
