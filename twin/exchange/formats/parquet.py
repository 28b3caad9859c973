"""Reader and writer of Parquet files; only this file imports pyarrow."""

from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from twin.exchange.formats import TOML_TEXTS, ColumnInfo, ColumnKey, SampleTable
from twin.recording.tabular import LogTable


def scan_columns(path: Path) -> SampleTable:
    """Scan the columns in the schema of a file; values are not read."""
    table = SampleTable(path)
    with pq.ParquetFile(path) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows
    for column in schema:
        numbers = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
        if not any(is_kind(column.type) for is_kind in numbers):
            table.skipped[column.name] = str(column.type)
            continue
        unit = (column.metadata or {}).get(b"unit", b"").decode(errors="replace")
        table.columns[column.name] = ColumnInfo(rows, (column.name,), unit)
    for key in TOML_TEXTS:
        if key.encode() in (schema.metadata or {}):
            table.texts[key] = schema.metadata[key.encode()].decode()
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,); a null is NaN."""
    with pq.ParquetFile(path) as file:
        return file.read([*key], use_threads=False).column(0).to_numpy()


def write_parquet(rows: LogTable, file: BinaryIO) -> None:
    """Write the rows as Parquet, with units as field metadata and configs as file metadata."""
    first = rows.read_columns(slice(0, 1))
    fields = [
        pa.field(name, pa.from_numpy_dtype(first[name].dtype), metadata={"unit": unit})
        for name, unit in rows.units.items()
    ]
    metadata = {"run": rows.start.run, "rate_hz": repr(rows.start.rate_hz), **rows.toml_texts}
    schema = pa.schema(fields, metadata=metadata)
    with pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=False) as writer:
        for window in rows.iter_windows():
            writer.write_table(pa.table([*window.values()], schema=schema))
