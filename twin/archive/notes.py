"""Notes and tags of a run, in notes.toml next to its recording, which stays as it is."""

import tomllib
from dataclasses import dataclass, replace
from pathlib import Path

from table_io.config.base import format_toml
from table_io.errors import InputError
from twin.recording.run_paths import PARTS_FOLDER
from twin.system.files import replace_text

NOTES_FILE = "notes.toml"
REMEDY = "correct the file, or remove it and note again by `shaketwin note`"


@dataclass(frozen=True, slots=True)
class RunNotes:
    """What an operator noted on a run after it."""

    note: str = ""
    tags: tuple[str, ...] = ()


def read_notes(folder: Path) -> RunNotes:
    """Return the notes on the run in a folder, empty without; InputError for a faulty file."""
    path = folder / NOTES_FILE
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return RunNotes()
    except (OSError, ValueError) as error:
        raise InputError(f"cannot be read: {error}", where=path, remedy=REMEDY) from None
    note, tags = table.get("note", ""), table.get("tags", [])
    if not isinstance(note, str):
        raise InputError("not a text", where=path, key="note", remedy=REMEDY)
    if not isinstance(tags, list) or not all(isinstance(tag, str) for tag in tags):
        raise InputError("not a list of texts", where=path, key="tags", remedy=REMEDY)
    return RunNotes(note, tuple(tags))


def note_run(
    folder: Path, text: str | None = None, tags: tuple[str, ...] = (), untag: tuple[str, ...] = ()
) -> RunNotes:
    """Change the note and the tags of a run, and return them; without a change, what they are.

    `text` replaces the note, an empty one removes it. InputError for a folder without a run, or if
    a tag to remove is not there.
    """
    if not ((folder / "run.mcap").exists() or (folder / PARTS_FOLDER).is_dir()):
        raise InputError("no run in this folder", where=folder, remedy="give the folder of a run")
    if not all(tag.strip() for tag in tags):
        raise InputError("an empty tag", where=folder, key="--tag", remedy="give it a text")
    before = read_notes(folder)
    for tag in untag:
        if tag not in before.tags:
            raise InputError(
                f"the run has no tag {tag!r}",
                where=folder,
                key="--untag",
                allowed=", ".join(before.tags) or "none: it has no tags",
            )
    kept = [tag for tag in before.tags if tag not in untag]
    after = replace(before, tags=tuple(dict.fromkeys([*kept, *tags])))
    if text is not None:
        after = replace(after, note=text)
    if after != before:
        table = {"note": after.note, "tags": [*after.tags]}
        replace_text(folder / NOTES_FILE, format_toml(table))
    return after
