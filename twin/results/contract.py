"""Base of the classes that are files: numbers with units, and the JSON text of a result.

A number that is not finite is null in a file, as JSON has no NaN.
"""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
)

from table_io.errors import InputError


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
RealRatio = Annotated[Real, declare_unit("1")]
Metres = Annotated[Number, declare_unit("m")]
RealMetres = Annotated[Real, declare_unit("m")]
Acceleration = Annotated[Number, declare_unit("m/s2")]
RealAcceleration = Annotated[Real, declare_unit("m/s2")]
Seconds = Annotated[float, declare_unit("s")]
RealSeconds = Annotated[Real, declare_unit("s")]
Milliseconds = Annotated[Number, declare_unit("ms")]
Minutes = Annotated[float, declare_unit("min")]
Hertz = Annotated[float, declare_unit("Hz")]
RealHertz = Annotated[Real, declare_unit("Hz")]
RealDegrees = Annotated[Real, declare_unit("deg")]
Index = Annotated[int, declare_unit("sample")]
SI = Annotated[Number, declare_unit("SI unit of the quantity")]
RealSI = Annotated[Real, declare_unit("SI unit of the quantity")]


class Contract(BaseModel):
    """Object with exactly these keys; those with a default may be absent."""

    model_config = ConfigDict(extra="forbid")

    def to_plain(self) -> dict[str, Any]:
        """Return the content of the file: the keys that were set, in the order of the class."""
        return self.model_dump(exclude_unset=True, by_alias=True)

    def to_json(self) -> str:
        """Return the text of the file."""
        return format_json(self.to_plain())

    def write(self, path: Path) -> None:
        """Write the file."""
        path.write_text(self.to_json() + "\n", encoding="utf-8")

    @classmethod
    def read(cls, path: Path, remedy: str) -> Self:
        """Return the content of a file, of another version too: unknown keys are ignored.

        InputError if the file is missing or breaks the contract.
        """
        try:
            return cls.model_validate(json.loads(path.read_text(encoding="utf-8")), extra="ignore")
        except FileNotFoundError:
            raise InputError("file not found", where=path, remedy=remedy) from None
        except ValidationError as error:
            first = error.errors()[0]
            key = ".".join(map(str, first["loc"]))
            raise InputError(first["msg"], where=path, key=key, remedy=remedy) from None
        except (OSError, ValueError) as error:
            raise InputError(
                f"cannot read the summary: {error}", where=path, remedy=remedy
            ) from None


def format_json(content: Mapping[str, Any]) -> str:
    """Return strict JSON text; non-finite numbers become null."""
    return json.dumps(_replace_nonfinite(content), indent=1, allow_nan=False)


def write_json(content: Mapping[str, Any], path: Path) -> None:
    """Write strict JSON; non-finite numbers become null."""
    path.write_text(format_json(content) + "\n", encoding="utf-8")


def _replace_nonfinite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nonfinite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nonfinite(item) for item in value]
    return _drop_nonfinite(value)


def build_json_schema(contract: type[BaseModel]) -> dict[str, Any]:
    """Build the JSON Schema (draft 2020-12) of a contract."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **contract.model_json_schema(),
    }
