"""Contracts of summary.json and verdict.json: only their keys are written, each is described."""

import copy
import json
import math
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel, ValidationError

from table_io.records import Check, Fault, NormalizedResponse, Timing, Trip
from tests.input_errors import raises_input_error
from twin.compare.curves import Hysteresis, PrcJump
from twin.discovery.result import FeatureVerdict, IdentificationReport, Verdict
from twin.results import contracts
from twin.results.contract import build_json_schema
from twin.results.contracts import RunSummary

NAN = float("nan")
INTERVAL = {"value": 60.0, "low": 58.0, "high": NAN, "unit": "N"}
VERDICT: dict[str, Any] = {
    "verdict": "named", "why": "the residual is noise",
    "effects": [
        {"id": "coulomb_friction", "confidence": 0.9, "parameters": {"fc": INTERVAL},
         "slip_speed": INTERVAL},
    ],
    "ambiguous": [], "candidates": [{"id": "gap_drift", "held_out_error": 2.0, "converged": True}],
    "where": {"frequency_hz": [2.8, 4.4], "direction": "both", "phase": "all",
              "channels": ["damper"], "harmonics": [1, 3]},
    "gap": {"metric": "rms", "before": 9.0, "after": 1.0, "noise_floor": 1.0,
            "held_out_before": 9.0, "held_out_after": 1.0, "closed_fraction": 1.0},
    "remainder": {"unexplained": False},
    "base": {"stiffness": INTERVAL}, "fell_away": {}, "notes": [], "next_run": "none",
    "seconds": 1.0, "held_out_logs": [],
}  # fmt: skip


def properties(schema: dict[str, Any]) -> list[tuple[str, dict[str, Any]]]:
    """(object, its properties) of a schema and all objects in it."""
    return [
        (name, part["properties"])
        for name, part in {**schema["$defs"], "file": schema}.items()
        if "properties" in part
    ]


def test_verdict_is_written_with_the_keys_that_were_set_and_null_for_nan() -> None:
    written = Verdict.model_validate(VERDICT).to_json()
    assert "NaN" not in written
    assert written == json.dumps(replace_nan(VERDICT), indent=1)
    assert Verdict.model_validate_json(written).to_json() == written


def replace_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: replace_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [replace_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("extra",), 1),
        (("gap", "extra"), 1.0),
        (("effects", 0, "parameters", "fc", "extra"), 1.0),
        (("verdict",), "perhaps"),
        (("where", "frequency_hz"), [2.8]),
        (("candidates", 0, "converged"), "perhaps"),
    ],
)
def test_what_is_unknown_or_of_another_type_is_not_written(
    path: tuple[Any, ...], value: Any
) -> None:
    content = copy.deepcopy(VERDICT)
    target: Any = content
    for key in path[:-1]:
        target = target[key]
    target[path[-1]] = value
    with pytest.raises(ValidationError) as error:
        Verdict.model_validate(content)
    assert error.value.errors()[0]["loc"][: len(path)] == path


@pytest.mark.parametrize("key", VERDICT)
def test_without_one_of_its_keys_it_is_not_written(key: str) -> None:
    with pytest.raises(ValidationError) as error:
        Verdict.model_validate({name: value for name, value in VERDICT.items() if name != key})
    assert [(e["loc"], e["type"]) for e in error.value.errors()] == [((key,), "missing")]


def test_a_summary_of_another_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "summary.json"
    step = {"index": 0, "direction": "forward", "frequency_hz": 2.0, "later": 1}
    content: dict[str, Any] = {"run": {"x": 1}, "verdict": "complete", "steps": [step], "y": 2}
    path.write_text(json.dumps(content))
    summary = RunSummary.read(path, "")
    assert summary.steps[0].measured is None
    assert math.isnan(summary.steps[0].thd)
    assert (summary.jumps, summary.twin_verdict, summary.run.title) == ([], None, "")
    del step["later"], content["y"], content["run"]["x"]
    assert json.loads(summary.to_json()) == content
    path.write_text(json.dumps(content | {"steps": [{"index": 0}]}))
    with raises_input_error(where=path, key="steps.0.direction"):
        RunSummary.read(path, "")


@pytest.mark.parametrize("contract", [RunSummary, Verdict, IdentificationReport, FeatureVerdict])
def test_a_schema_describes_every_key_and_gives_a_unit_to_every_number(
    contract: type[BaseModel],
) -> None:
    schema = build_json_schema(contract)
    assert schema["$schema"].startswith("https://json-schema.org/")
    assert schema["additionalProperties"] is False
    for name, keys in properties(schema):
        for key, part in keys.items():
            assert part["description"], (name, key)
            types = {part.get("type"), *(kind.get("type") for kind in part.get("anyOf", ()))}
            assert "number" not in types or "unit" in part or "unit" in keys, (name, key)


@pytest.mark.parametrize(
    ("contract", "record", "without"),
    [
        (contracts.Response, NormalizedResponse, set()),
        (contracts.FaultEntry, Fault, set()),
        (contracts.CheckEntry, Check, set()),
        (contracts.TripEntry, Trip, set()),
        (contracts.Jump, PrcJump, set()),
        (contracts.HysteresisInterval, Hysteresis, set()),
        (contracts.ComponentTiming, Timing, {"component"}),
    ],
)
def test_what_is_written_from_a_record_has_its_fields(
    contract: type[BaseModel], record: Any, without: set[str]
) -> None:
    assert contract.model_fields.keys() == {field.name for field in fields(record)} - without
