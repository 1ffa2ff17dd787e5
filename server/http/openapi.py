"""Completes the OpenAPI document of the service.

Operations get names that client generators use, the pipeline's settings get schemas of their own, files are marked as
bytes, and the schema of problem documents replaces the framework's error schemas.
"""

from collections.abc import Iterator
from typing import Any

from fastapi import FastAPI
from fastapi.routing import APIRoute
from pydantic import TypeAdapter

from pipeline.settings import SPACING_RANGE_MM, Settings
from pipeline.warnings import WARNING_CODES
from server.services.answer import SETTINGS
from server.storage.records import JsonObject
from server.wire import problems

REFERENCE = "#/components/schemas/{model}"
CHANGES = frozenset({"PUT", "PATCH", "DELETE"})  # methods that If-Match makes conditional
TEXTUAL = ("application/json", problems.MEDIA_TYPE, "text/")


def operation_name(route: APIRoute) -> str:
    """Returns the id of an operation: the name of its function, after which generated clients name their method."""
    return route.name


def describe(app: FastAPI, address: str | None) -> None:
    """Replaces ``app.openapi`` by a function that returns the completed document, which is made once. ``address``: the
    service's public address; None: the address of the request."""
    original = app.openapi

    def openapi() -> JsonObject:
        if app.openapi_schema is None:
            document = original()
            _name_problems(document)
            _name_settings(document)
            _mark_files(document)
            _name_conditions(document)
            document["servers"] = [{"url": address or "/"}]
        return app.openapi_schema or {}

    app.openapi = openapi


def _responses(document: JsonObject) -> Iterator[tuple[str, dict[str, Any]]]:
    for path in document["paths"].values():
        for call in path.values():
            yield from call.get("responses", {}).items()


def _name_problems(document: JsonObject) -> None:
    """Replaces the framework's error schemas by that of the problem document."""
    schemas = document.setdefault("components", {}).setdefault("schemas", {})
    schemas["Problem"] = problems.PROBLEM_SCHEMA
    for unused in ("HTTPValidationError", "ValidationError"):
        schemas.pop(unused, None)
    for status, answer in _responses(document):
        if status[0] in "45" and problems.MEDIA_TYPE in answer.get("content", {}):
            answer["content"] = {problems.MEDIA_TYPE: answer["content"][problems.MEDIA_TYPE]}


def _name_conditions(document: JsonObject) -> None:
    """Adds ``If-Match`` to operations that change or remove a readable resource, and ``ETag`` to those that read it."""
    text = {"schema": {"type": "string"}}
    tag = {"description": "of this state; If-Match takes it", **text}
    for path in document["paths"].values():
        changes = [call for method, call in path.items() if method.upper() in CHANGES]
        if not changes or "get" not in path:
            continue
        path["get"]["responses"]["200"]["headers"] = {"ETag": tag}
        for call in changes:
            meaning = "the ETag of the state that is meant to be changed: 412 if it is another by now"
            parameters = call.setdefault("parameters", [])
            parameters.append({"name": "If-Match", "in": "header", "required": False, "description": meaning, **text})
            call["responses"] |= {"412": {**call["responses"]["422"], "description": "Precondition Failed"}}


def _name_settings(document: JsonObject) -> None:
    """Adds the pipeline's settings as named schemas: every key is optional, unknown keys are refused."""
    described = TypeAdapter(Settings).json_schema(ref_template=REFERENCE)
    named = described.pop("$defs") | {"Settings": described}
    del described["properties"]["warnings"]  # of the reader
    for schema in named.values():
        schema["additionalProperties"] = False
    named["Settings"]["properties"]["fail_on"]["items"] = {"type": "string", "enum": list(WARNING_CODES)}
    least, most = SPACING_RANGE_MM
    named["BustSettings"]["properties"]["spacing_mm"] |= {"minimum": least, "maximum": most}
    _replace(document, SETTINGS, {"$ref": REFERENCE.format(model="Settings")})
    document["components"]["schemas"] |= named


def _replace(node: Any, old: JsonObject, new: JsonObject) -> None:
    for key, value in node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ():
        if isinstance(value, dict) and old.items() <= value.items():
            node[key] = {**{k: v for k, v in value.items() if k not in old}, **new}
        else:
            _replace(value, old, new)


def _mark_files(document: JsonObject) -> None:
    for _, answer in _responses(document):
        for media, content in answer.get("content", {}).items():
            if not media.startswith(TEXTUAL):
                content["schema"] = {"type": "string", "format": "binary"}
