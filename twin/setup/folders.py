"""Result folders, whose content is never overwritten, and state files, replaced as a whole."""

from contextlib import suppress
from itertools import count
from pathlib import Path

from table_io.errors import InputError
from twin.setup.run_config import make_run_id
from twin.system.files import lock_folder

RUNS_FOLDER = Path("runs")
_made_folders: list[Path] = []  # by this process


def make_run_folder(out: Path | None, name: str) -> tuple[Path, str]:
    """Create a run's folder as `make_output_folder` does; return (folder, run id)."""
    run = make_run_id(name)
    folder = make_output_folder(out, run)
    return folder, run if out is not None else folder.name


def make_output_folder(out: Path | None, run_name: str) -> Path:
    """Create an empty folder for results: `out`, or runs/<run_name>, numbered if that exists.

    InputError if `out` has content or is not writable, or if another command writes there: a folder
    is locked until the process ends.
    """
    folder = RUNS_FOLDER / run_name if out is None else out
    try:
        if out is None:
            if not folder.parent.exists():
                _made_folders.append(folder.parent.absolute())
            folder = _make_free_folder(folder)
            _made_folders.append(folder.absolute())
            claim_folder(folder)
        elif out.exists() and not out.is_dir():
            raise _make_content_error(out)
        else:
            if not out.exists():
                _made_folders.append(out.absolute())
            folder.mkdir(parents=True, exist_ok=True)
            claim_folder(folder)
            if any(folder.iterdir()):
                raise _make_content_error(folder)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise InputError(
            f"cannot write here: {error.strerror}",
            key="--out",
            value=str(folder),
            remedy="give a folder on a disk that you may write to",
        ) from None
    return folder


def remove_empty_folders() -> None:
    """Remove the folders that this process made and wrote nothing to: of a refused command."""
    while _made_folders:
        with suppress(OSError):  # it has content, or is gone
            _made_folders.pop().rmdir()


def claim_folder(folder: Path) -> None:
    """Lock a folder until this process ends; InputError if another command writes there."""
    try:
        lock_folder(folder)
    except BlockingIOError:
        raise InputError(
            "another command is writing there",
            key="--out",
            value=str(folder),
            remedy="give another folder",
        ) from None


def find_sharing_problem(path: Path, text: str) -> str:
    """Return why this process does not see the file that holds `text`; "" if it does.

    It runs on a worker of a cluster, to tell whether a folder of results is shared with it.
    """
    try:
        content = path.read_text(encoding="utf-8")
    except OSError as error:
        return f"it does not see {path} ({error.strerror})"
    return "" if content == text else f"it sees another {path}"


def _make_content_error(folder: Path) -> InputError:
    return InputError(
        "exists and has content; nothing recorded is ever overwritten",
        key="--out",
        value=str(folder),
        remedy="give a new folder",
    )


def _make_free_folder(folder: Path) -> Path:
    """Create and return `folder`, or the first of <folder>-2, -3, ... that does not exist.

    Creating it at once prevents two processes from choosing the same name.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    for number in count(1):
        candidate = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            candidate.mkdir()
        except FileExistsError:
            continue
        return candidate
    raise AssertionError("there is always a next name")
