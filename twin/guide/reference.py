"""Reference pages as Markdown: keys of the TOML files, commands with their options, channels."""

import ast
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from typer.core import TyperGroup

from table_io.channels import CHANNELS
from table_io.config.base import ConfigModel
from table_io.config.key_reference import KeyDescription, describe_tables
from table_io.config.profile import Profile
from table_io.config.rig import RigConfig
from twin.campaign.config import CampaignConfig
from twin.discovery.features.config import FeatureSet
from twin.exchange.columns import ColumnMap
from twin.model.config import ModelConfig
from twin.studies.maps.config import StudyConfig

CONFIG_FILES: tuple[tuple[str, str, type[ConfigModel]], ...] = (
    ("Test profile", "One test: specimen, excitation, acquisition, control.", Profile),
    ("Rig file", "One table: limits, command output, sensors, wiring.", RigConfig),
    ("Model file", "Parameters of the model and the effects added to it.", ModelConfig),
    ("Campaign file", "A list of runs with set-up changes between them.", CampaignConfig),
    ("Column map", "Columns of a foreign file, for `import --columns`.", ColumnMap),
    ("Study file", "Outcomes of the model over its parameters, for `map`.", StudyConfig),
    ("Features file", "What was observed of a specimen, for `discover --features`.", FeatureSet),
)

PACKAGES_DIR = Path(__file__).resolve().parents[2]  # holds twin and table_io


def format_table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """Return a Markdown table."""
    lines = [list(header)]
    lines += [["---"] * len(lines[0]), *([*row] for row in rows)]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in row) + " |"
        for row in lines
    )


def write_key_reference(_: TyperGroup) -> str:
    """Return the page of all keys of all TOML files."""
    parts = [
        "# Configuration keys\n\nAll files are TOML. The ending of a key states its unit. An "
        "unknown key is an error that names the nearest known one; one message lists all faults "
        "of a file."
    ]
    for title, purpose, model in CONFIG_FILES:
        parts.append(f"## {title}\n\n{purpose}")
        for table in describe_tables(model):
            parts.append(f"### `{table.name}`" if table.name else "### Top of the file")
            parts.append(table.meaning)
            if table.keys:
                header = ("key", "unit", "default", "allowed", "meaning")
                parts.append(format_table(header, map(_format_key, table.keys)))
    return "\n\n".join(parts)


def _format_key(key: KeyDescription) -> tuple[str, ...]:
    default = "required" if key.is_required else f"`{key.default}`" if key.default else "–"
    return f"`{key.key}`", key.unit, default, key.allowed, key.meaning


def write_command_reference(program: TyperGroup) -> str:
    """Return the page of all commands with their arguments and options."""
    context = program.context_class(program)
    panels: dict[str, list[str]] = {}
    for name in program.commands:
        _, command, _ = program.resolve_command(context, [name])
        if command is not None and not command.hidden:
            panel = str(getattr(command, "rich_help_panel", None) or "Others")
            panels.setdefault(panel, []).extend(_describe_command(f"shaketwin {name}", command))
    parts = [
        "# Commands\n\n`shaketwin COMMAND --help` shows the same on the terminal. PROFILE, MODEL, "
        "TABLE and campaign files are paths, or bare names of shipped ones."
    ]
    for panel, sections in panels.items():
        parts += [f"## {panel}", *sections]
    return "\n\n".join(parts)


def _describe_command(name: str, command: Any) -> Iterator[str]:
    """Yield the parts of the section of a command, or of each command of a group."""
    inner_commands = getattr(command, "commands", {})
    for inner_name, inner in inner_commands.items():
        yield from _describe_command(f"{name} {inner_name}", inner)
    if inner_commands:
        return
    context = command.context_class(command, info_name=name)
    yield f"### {name}"
    yield command.help or ""
    yield f"```sh\n{command.get_usage(context).removeprefix('Usage: ')}\n```"
    examples = [line for line in (command.epilog or "").splitlines() if "shaketwin " in line]
    if examples:
        yield "```sh\n" + "\n".join(examples) + "\n```"
    records = [
        record
        for parameter in command.get_params(context)
        if "--help" not in parameter.opts and (record := parameter.get_help_record(context))
    ]
    if records:
        yield format_table(
            ("argument or option", "meaning"), ((f"`{key}`", text) for key, text in records)
        )


def write_channel_reference(_: TyperGroup) -> str:
    """Return the page of the canonical channels."""
    rows = (
        (f"`{channel.name}`", channel.unit, channel.positive, channel.meaning)
        for channel in CHANNELS
    )
    return (
        "# Channels\n\nCanonical names, also the columns of exports. Right is positive, values are "
        "SI. A rig file may declare more in `[[channels]]`.\n\n"
        + format_table(("channel", "unit", "positive", "meaning"), rows)
    )


def write_api_reference(_: TyperGroup) -> str:
    """Return the page of the Python interface, from the docstrings of its source.

    It is parsed, not imported: the import would compile kernels.
    """
    interface = _parse_module("twin.api")
    nodes = {getattr(node, "name", ""): node for node in interface.body}
    for statement in interface.body:
        if isinstance(statement, ast.ImportFrom) and str(statement.module).startswith(
            ("table_io.", "twin.")
        ):
            known = {getattr(n, "name", ""): n for n in _parse_module(str(statement.module)).body}
            nodes |= {alias.name: known[alias.name] for alias in statement.names}
    public = [nodes[name] for name in list_public_names(interface)]
    summary, example, notes = (ast.get_docstring(interface) or "").split("\n\n", 2)
    parts = [
        "# Python API",
        summary,
        f"```python\n{example.replace('>>> ', '')}\n```",
        notes,
    ]
    for node in public:
        if isinstance(node, ast.FunctionDef):
            parts += _describe_function(node)
    log_page = ast.get_docstring(_parse_module("twin.log")) or ""
    parts += ["## Log", log_page.split("\n\n", 2)[2]]
    for node in public:
        if isinstance(node, ast.ClassDef) and node.name != "Log":
            parts += [f"## {node.name}", ast.get_docstring(node) or ""]
    return "\n\n".join(parts)


def list_public_names(module: ast.Module) -> list[str]:
    """Return the names in `__all__` of a module."""
    for node in module.body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__":
            return [*ast.literal_eval(node.value)]
    return []


def _parse_module(name: str) -> ast.Module:
    path = PACKAGES_DIR / name.replace(".", "/")
    file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
    return ast.parse(file.read_text(encoding="utf-8"))


def _describe_function(node: Any) -> Iterator[str]:
    """Yield the parts of the section of a function."""
    arguments = ast.unparse(node.args).replace("PathLike", "str | Path")
    arguments = arguments.replace("=", " = ")
    lines = "".join(f"    {argument},\n" for argument in arguments.split(", "))
    yield f"## {node.name}"
    result = ast.unparse(node.returns).strip("'")
    yield f"```python\n{node.name}(\n{lines}) -> {result}\n```"
    yield ast.get_docstring(node) or ""
