"""Turns errors into problem documents (RFC 9457, ``application/problem+json``) with a stable ``type`` and every fault
in ``errors``."""

from collections.abc import Iterable, Mapping, Sequence
from http import HTTPStatus
from typing import Any

import structlog
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from sqlalchemy.exc import DataError, DBAPIError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from rig.errors import DISK_FULL, EigenheadError, InputError
from rig.messages.message import Message, compose, documents_of, message_of
from rig.text import printable
from server.errors import (
    UNWRITABLE,
    Conflict,
    DataUnwritable,
    DiskFull,
    Forbidden,
    Gone,
    InvalidInput,
    NotFound,
    Refused,
    TooLarge,
    TooMany,
    Unauthenticated,
    Unavailable,
    unusable_input,
)
from server.problem_types import HTTP_TYPES, PROBLEM_TYPES, URN

MEDIA_TYPE = "application/problem+json"

log = structlog.get_logger()

MESSAGE_SCHEMA = {
    "type": "object",
    "required": ["code", "message", "parameters"],
    "properties": {
        "code": {"type": "string", "description": "stable; decides what parameters there are"},
        "message": {"type": "string", "description": "in English"},
        "parameters": {"type": "object", "description": "what stands in the message, by name"},
    },
}

PROBLEM_SCHEMA = {
    "type": "object",
    "description": "Describes why a request was refused or failed, after RFC 9457.",
    "required": ["type", "title", "status", "detail", "errors"],
    "properties": {
        "type": {"type": "string", "description": f"stable name, {URN}<kind>"},
        "title": {"type": "string"},
        "status": {"type": "integer"},
        "detail": {"type": "string", "description": "what is wrong and what to do"},
        "errors": {"type": "array", "items": {"type": "string"}, "description": "every fault found"},
        "detail_message": {**MESSAGE_SCHEMA, "description": "the detail as data"},
        "error_messages": {"type": "array", "items": MESSAGE_SCHEMA, "description": "the faults as data"},
    },
}
Responses = dict[int | str, dict[str, Any]]  # FastAPI's type of a route's ``responses``


STATUS_OF: dict[type[Refused], int] = {
    Refused: 400,
    Unauthenticated: 401,
    Forbidden: 403,
    NotFound: 404,
    Conflict: 409,
    Gone: 410,
    TooLarge: 413,
    InvalidInput: 422,
    TooMany: 429,
    Unavailable: 503,
    DiskFull: 507,
}
"""The HTTP status of each class of refusals; a class that is not named has its nearest ancestor's."""


def status_of(refusal: type[Refused]) -> int:
    """Returns the HTTP status of a class of refusals from ``STATUS_OF``, by the class or its nearest ancestor."""
    return next(STATUS_OF[kind] for kind in refusal.__mro__ if kind in STATUS_OF)


class Problem(EigenheadError):
    """Reports a refusal together with its HTTP status. ``kind`` is the end of the document's ``type``."""

    def __init__(
        self,
        status: int,
        kind: str,
        detail: Message | str,
        errors: Iterable[Message | str] = (),
        headers: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(detail)
        self.status, self.kind, self.detail = status, kind, self.message
        self.errors, self.headers = tuple(message_of(error) for error in errors), dict(headers or {})

    def document(self) -> dict[str, Any]:
        """Returns the problem as a JSON document of RFC 9457, with the faults as texts and as messages."""
        return {
            "type": URN + self.kind,
            "title": PROBLEM_TYPES.get(self.kind, self.kind),
            "status": self.status,
            "detail": printable(self.detail.text),
            "errors": [printable(error.text) for error in self.errors],
            "detail_message": self.detail.document(),
            "error_messages": documents_of(self.errors),
        }

    def response(self) -> JSONResponse:
        """Returns the HTTP response that carries the problem document."""
        return JSONResponse(self.document(), self.status, headers=self.headers, media_type=MEDIA_TYPE)


def problem_from(error: Exception) -> Problem:
    """Converts an error to a problem. An unexpected error is logged and becomes a 500 problem without details."""
    if isinstance(error, Problem):
        return error
    if isinstance(error, ClientDisconnect):
        error = Conflict("client-gone", compose("client-gone"))
    if isinstance(error, InputError):
        error = unusable_input(error)
    if isinstance(error, Refused):
        again = {} if error.retry_after_s is None else {"Retry-After": str(error.retry_after_s)}
        return Problem(status_of(type(error)), error.kind, error.detail, error.errors, again)
    if isinstance(error, RequestValidationError):
        faults = [_fault_of(e) for e in error.errors()]
        return Problem(422, "invalid-request", compose("request-unfit"), faults)
    if isinstance(error, HTTPException):
        phrase = HTTPStatus(error.status_code).phrase
        detail = str(error.detail) if error.detail != phrase else compose("http-refused", phrase=phrase)
        kind = HTTP_TYPES.get(error.status_code, "http-error")
        return Problem(error.status_code, kind, detail, headers=error.headers)
    if (isinstance(error, OSError) and error.errno in DISK_FULL) or "database or disk is full" in str(error):
        return problem_from(DiskFull())
    if isinstance(error, OSError) and error.errno in UNWRITABLE:
        log.error("data folder cannot be written", error=str(error))
        return problem_from(DataUnwritable())
    if isinstance(error, DataError):
        return Problem(422, "invalid-request", compose("database-value-refused"))
    if isinstance(error, DBAPIError):
        log.error("database failed", error=str(error)[:500])
        return Problem(503, "database-unavailable", compose("database-silent"))
    log.error("unforeseen error", exc_info=error)
    return Problem(500, "internal-error", compose("service-failed"))


def _fault_of(error: Mapping[str, Any]) -> Message:
    """Words a fault found by pydantic. For a body that is not JSON, pydantic's text is unhelpful, so this function
    writes its own."""
    where, fault = ".".join(map(str, error["loc"])), error["msg"]
    if error["loc"] == ("body",) and error["type"] == "model_attributes_type":
        fault = compose("no-json-object")
    if error["type"] == "extra_forbidden":
        where, fault = ".".join(map(str, error["loc"][:-1])), compose("setting-unknown", key=error["loc"][-1])
    if error["type"] == "json_invalid":
        where, at = map(str, error["loc"])
        fault = compose("no-json-because", reason=f"{error['ctx']['error']}, character {at}")
    return compose("located", where=where, fault=fault)


def install(app: FastAPI, routes: Sequence[APIRoute]) -> None:
    """Makes the app answer every error with a problem document. ``routes`` are all of the app's routes; a 405 names the
    methods that they allow."""

    async def answer(request: Request, error: Exception) -> JSONResponse:
        problem = problem_from(error)
        if problem.status == 405:
            allowed = _methods_of(routes, request.url.path)
            problem.headers["Allow"] = ", ".join(allowed)
            problem.detail = compose(
                "method-not-allowed", path=request.url.path, allowed=allowed, method=request.method
            )
        return problem.response()

    for kind in (
        Exception,
        EigenheadError,
        ClientDisconnect,
        HTTPException,
        RequestValidationError,
        OSError,
        DBAPIError,
    ):
        app.add_exception_handler(kind, answer)


def _methods_of(routes: Sequence[APIRoute], path: str) -> list[str]:
    """Lists all methods of a path, for the Allow header; the router itself names only those of the first matching
    route."""
    fitting = [route for route in routes if route.path_regex.match(path)]
    return sorted({method for route in fitting if route.path == fitting[0].path for method in route.methods or ()})


def sent_file(*media_types: str) -> Responses:
    """Returns the OpenAPI ``responses`` of a route that sends a whole file, a part of it, or 304."""
    content = {media_type: {} for media_type in media_types}
    partial = {"description": "Partial Content", "content": content}
    return {200: {"content": content}, 206: partial, 304: {"description": "Not Modified"}}


def documented(*statuses: int) -> Responses:
    """Returns the OpenAPI ``responses`` of a route that may refuse with these statuses, and with those that every route
    may refuse with."""
    body = {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}}
    every = {401, 403, 422, 429, 500, 503, *statuses}
    return {status: {"description": HTTPStatus(status).phrase, "content": body} for status in sorted(every)}
