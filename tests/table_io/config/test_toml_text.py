"""Tables written as TOML text are read as they were."""

import math
import tomllib

from table_io.config.base import format_toml


def test_table_is_read_as_it_was_written() -> None:
    table = {
        "title": 'a "quote" \\ back\nline \x7f é',
        "gap_mm": math.inf,
        "least": -math.inf,
        "value": 0.1 + 0.2,
        "count": 3,
        "enabled": False,
        "band_hz": [0.3, math.inf],
        "excitation": {"kind": "record", "files": {"a b.csv": "1\n2\n", "plain_key": ""}},
        "sensors": [{"channel": "x", "range": 1e-12}, {"channel": "y", "deeper": {"a": 1}}],
    }
    assert tomllib.loads(format_toml(table)) == table
    assert math.isnan(tomllib.loads(format_toml({"none": math.nan}))["none"])
