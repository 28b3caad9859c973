"""Parquet, in and out. The only file that knows pyarrow."""

from pathlib import Path
from typing import Any, BinaryIO

import pyarrow as pa
import pyarrow.parquet as pq

from twin.stream.rows import Rows
from twin.stream.tables import TEXTS, Held, Key, Table


def read(path: Path) -> Table:
    """The columns of a file, as its schema says; no number is read yet."""
    table = Table(path)
    with pq.ParquetFile(path) as file:
        schema, rows = file.schema_arrow, file.metadata.num_rows
    for column in schema:
        numbers = (pa.types.is_floating, pa.types.is_integer, pa.types.is_boolean)
        if not any(is_kind(column.type) for is_kind in numbers):
            table.others[column.name] = str(column.type)
            continue
        unit = (column.metadata or {}).get(b"unit", b"").decode(errors="replace")
        table.columns[column.name] = Held(rows, (column.name,), unit)
    for key in TEXTS:
        if key.encode() in (schema.metadata or {}):
            table.texts[key] = schema.metadata[key.encode()].decode()
    return table


def load(path: Path, key: Key) -> Any:
    """A column's numbers, (row,); a null is NaN."""
    with pq.ParquetFile(path) as file:
        return file.read([*key], use_threads=False).column(0).to_numpy()


def write(rows: Rows, file: BinaryIO) -> None:
    """The rows as Parquet: units beside the columns, profile, machine card and model beside all."""
    first = rows.window(slice(0, 1))
    fields = [
        pa.field(name, pa.from_numpy_dtype(first[name].dtype), metadata={"unit": unit})
        for name, unit in rows.units.items()
    ]
    about = {"run": rows.start.run, "rate_hz": repr(rows.start.rate_hz), **rows.texts}
    schema = pa.schema(fields, metadata=about)
    with pq.ParquetWriter(file, schema, compression="zstd", use_dictionary=False) as writer:
        for window in rows.windows():
            writer.write_table(pa.table([*window.values()], schema=schema))
