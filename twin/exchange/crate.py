"""Description of exported files as an RO-Crate 1.1: what they are, of which recording, by what."""

import mimetypes
from collections.abc import Sequence
from pathlib import Path

from twin.recording.tabular import LogTable
from twin.results.contract import write_json
from twin.system.files import hash_file

CRATE_FILE = "ro-crate-metadata.json"
CRATE_VERSION = "https://w3id.org/ro/crate/1.1"
MEDIA_TYPES = {
    ".mcap": "application/octet-stream", ".parquet": "application/vnd.apache.parquet",
    ".h5": "application/x-hdf5", ".uff": "application/octet-stream",
    ".mat": "application/x-matlab-data", ".rrd": "application/octet-stream",
    ".fmu": "application/zip",
}  # fmt: skip


def write_crate(rows: LogTable, log: Path, files: Sequence[Path], path: Path) -> None:
    """Describe exported files and the log that they are from as an RO-Crate, in their folder."""
    start = rows.start
    used = [*files, *([log] if log.resolve().parent == path.resolve().parent else [])]
    root = {
        "@id": "./",
        "@type": "Dataset",
        "name": start.run,
        "description": f"Shaking-table test {start.name}, recorded by shaketwin on {start.host}, "
        f"{rows.size} samples at {start.rate_hz:g} Hz from {start.started_at} on",
        "datePublished": start.started_at,
        "license": "not stated",
        "hasPart": [{"@id": file.name} for file in used],
        "variableMeasured": [{"@id": f"#{name}"} for name in rows.units],
    }
    action = {
        "@id": "#export",
        "@type": "CreateAction",
        "name": "Export of a recording",
        "instrument": {"@id": "#shaketwin"},
        "object": {"@id": used[-1].name} if len(used) > len(files) else start.run,
        "result": [{"@id": file.name} for file in files],
    }
    version = start.versions.get("shaketwin", "unknown")
    graph = [
        {
            "@id": CRATE_FILE,
            "@type": "CreativeWork",
            "conformsTo": {"@id": CRATE_VERSION},
            "about": {"@id": "./"},
        },
        root,
        *(_describe_file(file) for file in used),
        *(
            {"@id": f"#{name}", "@type": "PropertyValue", "name": name, "unitText": unit or "1"}
            for name, unit in rows.units.items()
        ),
        {
            "@id": "#shaketwin",
            "@type": "SoftwareApplication",
            "name": "shaketwin",
            "softwareVersion": version,
        },
        action,
    ]
    write_json({"@context": f"{CRATE_VERSION}/context", "@graph": graph}, path)


def _describe_file(path: Path) -> dict[str, str]:
    guessed = mimetypes.guess_type(path.name)[0] or "application/octet-stream"
    return {
        "@id": path.name,
        "@type": "File",
        "name": path.name,
        "contentSize": str(path.stat().st_size),
        "encodingFormat": MEDIA_TYPES.get(path.suffix, guessed),
        "identifier": f"sha256:{hash_file(path)}",
    }
