"""Two examples under the help of each command, and the names that a command knows."""

from collections.abc import Callable

import typer

from table_io.config.shipped import list_shipped_names

EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": ("run quickstart --speed max", "run quickstart --model runs/found/model.toml --view"),
    "demo": ("demo", "demo --seed 3 --keep my_rig --no-open"),
    "campaign": ("campaign records --speed max --yes --out records_runs",
                 "campaign paper --out paper_runs --resume"),
    "table": ("table", "table --rig ni_simulated"),
    "drive": ("drive quickstart -o drive.csv", "drive g4_ss3 -o drive.rpc --table machine"),
    "simulate": ("simulate quickstart", "simulate quickstart --gap 0:16:4"),
    "branches": ("branches quickstart", "branches quickstart --over gap --from 0 --to 10"),
    "map": ("map bumper_design --out bumpers", "map bumper_design --out bumpers --resume"),
    "replay": ("replay last", "replay runs/first --model snm --steps 0:5"),
    "prc": ("prc last", "prc runs/first --json"),
    "paper": ("paper", "paper --campaign paper_runs --out comparison"),
    "report": ("report last", "report runs/first"),
    "view": ("view last", "view runs/first --save view.rrd"),
    "runs": ("runs", "runs paper_runs"),
    "compare": ("compare runs/first runs/second", "compare runs/first last"),
    "guide": ("guide", "guide --out guide_pages"),
    "check": ("check quickstart", "check --table machine --unattended"),
    "calibrate": ("calibrate mass_acc_m_s2 --table my_table.toml --points 0,1",
                  "calibrate force_r1_n --table my_table.toml --shunt"),
    "devices": ("devices", "devices --ni localhost:31763 --json"),
    "monitor": ("monitor", "monitor --connect tls/rig:7447 --keys my_keys --wait"),
    "join": ("join recorder --connect tls/rig:7447 --keys my_keys",
             "join twin --connect tls/rig:7447 --keys my_keys"),
    "control": ("control stop", "control hold --why 'look at the bumper'"),
    "verify": ("verify last", "verify runs/first --repair whole.mcap"),
    "import": ("import data.csv", "import data.csv -o data.mcap --accept --profile quickstart"),
    "export": ("export last --csv", "export runs/first --parquet --steps 0:5"),
    "discover": ("discover runs/first --held-out runs/second --decide next.toml",
                 "discover --features paper --out features"),
    "identify": ("identify last", "identify runs/first runs/second --out specimen.toml"),
    "table-twin": ("table-twin last", "table-twin runs/rehearsal --out table.toml"),
    "table-drive": ("table-drive el_centro --table-twin table.toml --iterate 3",
                    "table-drive el_centro --table-twin table.toml --after runs/first --out next"),
    "list": ("list tests", "list effects"),
    "new": ("new test mine.toml", "new rig my_table.toml"),
    "explain": ("explain gap_mm", "explain control.tolerance"),
    "schema": ("schema test -o test.schema.json", "schema rig"),
}  # fmt: skip


def describe_names(text: str, kind: str) -> str:
    """Return the help of an argument that takes a file or a name, with the shipped names."""
    return f"{text}: a .toml file or a name: {', '.join(list_shipped_names(kind))}."


def complete_names(kind: str) -> Callable[[str], list[str]]:
    """Return the completion of the names of a kind for the shell, the user's own included."""

    def complete(incomplete: str) -> list[str]:
        from table_io.config.folders import list_configs

        return [name for name in list_configs(kind) if name.startswith(incomplete)]

    return complete


def add_examples(app: typer.Typer) -> None:
    """Show its examples at the end of the help of each command."""
    for group in app.registered_groups:
        if group.typer_instance is not None:
            add_examples(group.typer_instance)
    for command in app.registered_commands:
        if command.name in EXAMPLES:
            lines = [f"shaketwin {example}" for example in EXAMPLES[command.name]]
            command.epilog = "\n\n".join(["Examples:", *lines])
