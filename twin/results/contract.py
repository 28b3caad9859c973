"""Base of the classes that are files: numbers with units, and the JSON text of a result.

A number that is not finite is null in a file, as JSON has no NaN.
"""

import json
import math
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer


def declare_unit(unit: str) -> Any:
    """Return the annotation that adds a unit to the schema of a number."""
    return Field(json_schema_extra={"unit": unit})


def _drop_nonfinite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _read_null(value: Any) -> Any:
    return math.nan if value is None else value


# A number that may be unknown: null in a file, and None in memory too.
Number = Annotated[float | None, BeforeValidator(_drop_nonfinite)]
# A number that is always computed: if it is not finite, it is null in a file, NaN as read again.
Real = Annotated[
    float,
    BeforeValidator(_read_null, json_schema_input_type=float | None),
    PlainSerializer(_drop_nonfinite, return_type=float | None),
]
Ratio = Annotated[Number, declare_unit("1")]
Metres = Annotated[Number, declare_unit("m")]
Acceleration = Annotated[Number, declare_unit("m/s2")]
Seconds = Annotated[float, declare_unit("s")]
Milliseconds = Annotated[Number, declare_unit("ms")]
Minutes = Annotated[float, declare_unit("min")]
Hertz = Annotated[float, declare_unit("Hz")]
Degrees = Annotated[Number, declare_unit("deg")]
Index = Annotated[int, declare_unit("sample")]
SI = Annotated[Number, declare_unit("SI unit of the quantity")]


class Contract(BaseModel):
    """Object with exactly these keys; those with a default may be absent."""

    model_config = ConfigDict(extra="forbid")

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the file: the keys that were set, in the order of the class."""
        return self.model_dump(exclude_unset=True, by_alias=True)

    def to_json(self) -> str:
        """Return the text of the file."""
        return json.dumps(self.to_plain(), indent=1, allow_nan=False)


def build_json_schema(contract: type[BaseModel]) -> dict[str, Any]:
    """Build the JSON Schema (draft 2020-12) of a contract."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **contract.model_json_schema(),
    }
