"""docs/schemas/report.schema.json from the type of report.json: `.venv/bin/python -m tests.support.report_schema`."""

import json
import types
import typing
from pathlib import Path
from typing import Any

from pipeline.results.report_types import FORMAT, Report

FILE = Path(__file__).resolve().parents[2] / "docs" / "schemas" / "report.schema.json"
PLAIN = {str: "string", bool: "boolean", int: "integer", float: "number", type(None): "null", object: None, Any: None}


def report_schema() -> dict[str, Any]:
    schema = schema_of(Report)
    schema["properties"]["format"] = {"const": FORMAT}
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": "report.json"} | schema


def schema_of(hint: Any) -> dict[str, Any]:
    """The JSON Schema of typed dictionaries, lists, dictionaries, unions and plain types."""
    if hint in PLAIN:
        return {} if PLAIN[hint] is None else {"type": PLAIN[hint]}
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is list:
        return {"type": "array", "items": schema_of(arguments[0])}
    if origin is dict:
        return {"type": "object", "additionalProperties": schema_of(arguments[1])}
    if origin is types.UnionType:
        return {"anyOf": [schema_of(option) for option in arguments]}
    assert typing.is_typeddict(hint), hint
    fields = {name: schema_of(field) for name, field in typing.get_type_hints(hint).items()}
    described = {"description": " ".join(hint.__doc__.split())} if hint.__doc__ else {}
    return described | {"type": "object", "required": sorted(hint.__required_keys__), "properties": fields}


if __name__ == "__main__":
    FILE.write_text(json.dumps(report_schema(), indent=1) + "\n", encoding="utf-8")
