"""`list`, `new`, `explain` and `schema`: names, templates, keys and schemas of the TOML files."""

import enum
import json
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.json_schema import models_json_schema
from rich.box import SIMPLE_HEAD
from rich.table import Table

from table_io.channels import CHANNELS
from table_io.config.base import PROFILES_DIR, ConfigModel
from table_io.config.excitation import Excitation
from table_io.config.folders import list_configs
from table_io.config.key_reference import KeyDescription, TableDescription, describe_tables
from table_io.config.plugins import list_entry_points
from table_io.config.profile import Profile
from table_io.config.rig import BACKEND_GROUP, RigConfig, load_backend
from table_io.errors import InputError, suggest
from twin.system.terminal import console, print_line, print_table


class FileKind(enum.StrEnum):
    """Kind of a TOML file."""

    test = "test"
    rig = "rig"
    model = "model"
    campaign = "campaign"
    map = "map"
    study = "study"
    features = "features"


class ListKind(enum.StrEnum):
    """Kind of names to list."""

    tests = "tests"
    rigs = "rigs"
    models = "models"
    campaigns = "campaigns"
    studies = "studies"
    features = "features"
    effects = "effects"
    channels = "channels"


KindArgument = Annotated[
    FileKind,
    typer.Argument(metavar="test|rig|model|campaign|map|study|features", help="Kind of file."),
]
TEMPLATES = {
    FileKind.rig: "rigs/simulated",
    FileKind.model: "models/snm",
    FileKind.campaign: "campaigns/paper",
    FileKind.study: "studies/bumper_design",
    FileKind.features: "features/paper",
}
EXAMPLE_KIND = 'kind = "stepped_sine"'  # of the excitation of a new test
WRITTEN_BY_CAMPAIGNS = ("[set_up]", "[resume]")


def print_names(
    kind: Annotated[ListKind, typer.Argument(metavar="|".join(ListKind), help="What to list.")],
) -> None:
    """List the names that commands take: yours first, then the shipped ones."""
    header: tuple[str, ...]
    rows: Iterator[tuple[str, ...]]
    if kind is ListKind.effects:
        from twin.laws.library import EFFECTS, load_plugins

        header = ("effect", "meaning", "law", "parameters")
        rows = (
            (effect.id, effect.summary, effect.term,
             ", ".join(f"{value.name} [{value.unit or '-'}]" for value in effect.parameters))
            for effect in (*EFFECTS, *load_plugins())
        )  # fmt: skip
    elif kind is ListKind.channels:
        header = ("channel", "unit", "positive", "meaning")
        rows = ((item.name, item.unit, item.positive, item.meaning) for item in CHANNELS)
    else:
        header = ("name", "title", "folder")
        rows = (
            (name, _read_title(path), _describe_folder(path))
            for name, path in list_configs(kind).items()
        )
    table = Table(box=SIMPLE_HEAD)
    for title in header:
        table.add_column(title)
    for row in rows:
        table.add_row(*row)
    print_table(console, table)


def _read_title(path: Path) -> str:
    try:
        return str(tomllib.loads(path.read_text(encoding="utf-8")).get("title", ""))
    except (OSError, ValueError) as error:
        return f"cannot be read: {error}"


def _describe_folder(path: Path) -> str:
    return "shipped" if path.is_relative_to(PROFILES_DIR) else str(path.parent)


def explain_key(
    name: Annotated[
        str,
        typer.Argument(metavar="KEY", help="Key of a file, with or without its table."),
    ],
) -> None:
    """Explain a key of a file: its meaning, unit, default and limits."""
    from twin.guide.reference import CONFIG_FILES  # it imports the kernels

    entries = {
        (title, table.name, key.key): key
        for title, _, model in CONFIG_FILES
        for table in describe_tables(model)
        for key in table.keys
    }
    matches = [place for place in entries if name in (place[2], _dotted_name(*place[1:]))]
    if not matches:
        known = dict.fromkeys(
            known for _, table, key in entries for known in (key, _dotted_name(table, key))
        )
        raise InputError("unknown key", where="explain", value=name, remedy=suggest(name, known))
    for title, table_name, key_name in matches:
        print_line(f"{title}, {table_name or 'top of the file'}: {key_name}")
        for line in _explain(entries[title, table_name, key_name]):
            print_line(f"  {line}")


def _dotted_name(table: str, key: str) -> str:
    """Return `table.key`, without the brackets and the kind of the table."""
    name = table.partition("]")[0].strip("[")
    return f"{name}.{key}" if name else key


def _explain(key: KeyDescription) -> Iterator[str]:
    yield key.meaning
    if key.unit:
        yield f"unit: {key.unit}"
    yield f"allowed: {key.allowed}"
    yield "required" if key.is_required else f"default: {key.default or 'none'}"


def write_template(
    kind: Annotated[
        FileKind,
        typer.Argument(metavar="test|rig|model|campaign|study|features", help="Kind of file."),
    ],
    path: Annotated[Path, typer.Argument(metavar="FILE", help="New .toml file.")],
) -> None:
    """Write a commented file to edit; `check` accepts a new test as it is."""
    if kind is FileKind.test:
        text = _format_test_template()
    elif kind in TEMPLATES:
        text = (PROFILES_DIR / f"{TEMPLATES[kind]}.toml").read_text(encoding="utf-8")
    else:
        raise InputError(
            "no template", where=f"new {kind}",
            allowed="test, rig, model, campaign, study, features",
            remedy="for a map: shaketwin import FILE --save-map MAP",
        )  # fmt: skip
    _write_new(path, text)
    print_line(f"{path}: {'shaketwin check ' + str(path) if kind is FileKind.test else kind}")


def _write_new(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise InputError(
            f"cannot write: {error.strerror}", where=path, remedy="give a new file in a folder of "
            "yours",
        ) from None  # fmt: skip


def _format_test_template() -> str:
    """Return a test profile with every key: those of the quickstart, the others as comments."""
    values = tomllib.loads((PROFILES_DIR / "tests" / "quickstart.toml").read_text(encoding="utf-8"))
    values["excitation"] = values.pop("sweep")
    values |= {"title": "My test", "citation": ""}
    parts = [
        "# Test profile. What follows a # has its default: to change it, remove the # of its line "
        "and\n# of the [table] above it.\n"
        "# `shaketwin explain KEY` says more; `shaketwin check FILE` checks this file."
    ]
    for table in describe_tables(Profile):
        name, _, requirement = table.name.partition("] ")
        is_other_kind = bool(requirement) and requirement != EXAMPLE_KIND
        if not is_other_kind and table.name not in WRITTEN_BY_CAMPAIGNS:
            given = values.get(name.strip("[]"), {}) if table.name else values
            parts.append("\n".join(_format_table(table, given)))
    return "\n\n".join(parts) + "\n"


def _format_table(table: TableDescription, values: Mapping[str, Any]) -> Iterator[str]:
    """Yield the lines of a table of a template; without values it is a comment as a whole."""
    mark = "" if values else "# "
    name, _, requirement = table.name.partition("] ")
    yield f"# {table.meaning}"
    if name:
        yield f"{mark}{name.rstrip(']')}]"
    if requirement:
        yield f"{mark}{requirement}"
    for key in table.keys:
        details = (f"{key.meaning.rstrip('.')}", key.unit, key.allowed)
        comment = "; ".join(filter(None, details))
        if values.get(key.key):
            yield f"{key.key} = {json.dumps(values[key.key])}  # {comment}"
        else:
            yield f"# {key.key} = {key.default or '...'}  # {comment}"


def write_schema(
    kind: KindArgument,
    path: Annotated[
        Path | None, typer.Option("-o", "--out", metavar="FILE", help="New file; default: print.")
    ] = None,
) -> None:
    """Print the JSON schema of a kind of file, by which editors complete and check its keys."""
    text = json.dumps(build_file_schema(kind), indent=1)
    if path is None:
        print(text)
    else:
        _write_new(path, text + "\n")


def build_file_schema(kind: FileKind) -> dict[str, Any]:
    """Return the JSON schema of a kind of file, with the tables that plug-ins add to it."""
    from twin.guide.reference import CONFIG_FILES

    *_, model = CONFIG_FILES[list(FileKind).index(kind)]
    added: dict[str, tuple[type[ConfigModel], ...]] = {}
    if model is Profile:
        kinds = tuple(Excitation.list_variants().values())
        added = {"excitation": kinds, "sweep": kinds}
    elif model is RigConfig:
        backends = {name: load_backend(name) for name in list_entry_points(BACKEND_GROUP)}
        added = {name: (item.config,) for name, item in backends.items() if item is not None}
    models = [model, *dict.fromkeys(variant for group in added.values() for variant in group)]
    refs, schema = models_json_schema([(item, "validation") for item in models])
    file_schema: dict[str, Any] = schema["$defs"].pop(refs[model, "validation"]["$ref"][8:])
    for name, group in added.items():
        file_schema["properties"][name] = {
            "anyOf": [refs[variant, "validation"] for variant in group]
        }
    if model is Profile:  # either of the two names
        file_schema["required"].remove("excitation")
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **file_schema,
        "$defs": schema["$defs"],
    }
