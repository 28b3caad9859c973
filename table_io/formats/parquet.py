"""Reader and writer of Parquet files; only this file imports pyarrow."""

from collections.abc import Iterable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from table_io.formats.table import (
    TOML_TEXTS,
    ColumnKey,
    ForeignColumn,
    ForeignTable,
    TableColumns,
)

TIME_TYPES = (pa.types.is_timestamp, pa.types.is_duration)


def scan_columns(path: Path) -> ForeignTable:
    """Scan the columns in the schema of a file; values are not read."""
    table = ForeignTable(path, "", loader="parquet")
    with pq.ParquetFile(path) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows
    for column in schema:
        numbers = (
            pa.types.is_floating,
            pa.types.is_integer,
            pa.types.is_boolean,
            pa.types.is_decimal,
            *TIME_TYPES,
        )
        if not any(is_kind(column.type) for is_kind in numbers):
            table.dropped[column.name] = str(column.type)
            continue
        unit = (column.metadata or {}).get(b"unit", b"").decode(errors="replace")
        unit = "s" if any(is_kind(column.type) for is_kind in TIME_TYPES) else unit
        table.columns[column.name] = ForeignColumn(rows, (column.name,), unit)
    for key in TOML_TEXTS:
        if key.encode() in (schema.metadata or {}):
            table.texts[key] = schema.metadata[key.encode()].decode()
    return table


def load_column(path: Path, key: ColumnKey) -> Any:
    """Read the values of a column, (row,); a null is NaN."""
    with pq.ParquetFile(path) as file:
        column = file.read([*key], use_threads=False).column(0)
    is_exact = pa.types.is_decimal(column.type)
    return (column.cast(pa.float64()) if is_exact else column).to_numpy()


def write_parquet(
    units: Mapping[str, str],
    windows: Iterable[TableColumns],
    facts: Mapping[str, str],
    file: BinaryIO,
) -> None:
    """Write columns as Parquet, with units as field metadata and facts as file metadata."""
    windows = iter(windows)
    first = next(windows)
    fields = [
        pa.field(name, pa.from_numpy_dtype(first[name].dtype), metadata={"unit": unit})
        for name, unit in units.items()
    ]
    schema = pa.schema(fields, metadata=dict(facts))
    with pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=False) as writer:
        for window in chain([first], windows):
            writer.write_table(pa.table([*window.values()], schema=schema))
