"""Identifies the caller of a request by the API key in its Authorization header.

On a loopback address, as long as no key exists, everybody on this machine is a caller with all scopes. Requests that a
foreign web page makes a browser send are then refused by their Host and Origin headers.
"""

from collections.abc import Callable
from typing import Annotated

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from rig.messages.message import compose
from server.address import is_loopback
from server.services.keys import LOCAL, SCOPES, Caller
from server.services.service import Service
from server.wire.problems import Problem

bearer = HTTPBearer(auto_error=False, description="API key, eh_...; not needed on loopback while no key exists")


def service_of(request: Request) -> Service:
    """Returns the service to whose app a request was sent."""
    return request.app.state.service


ServiceOf = Annotated[Service, Depends(service_of)]


def require(scope: str) -> Callable[..., Caller]:
    """Returns a FastAPI dependency that yields the caller, or raises a 401 problem for an unknown caller and a 403
    problem for one without ``scope``.

    It runs before an upload is read. FastAPI reads JSON bodies before dependencies, so routes with such a body are
    guarded by ``check_caller`` (server.http.json_bodies).
    """

    def authenticate(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
    ) -> Caller:
        caller = _caller(request, credentials)
        caller.check_may(scope)
        return caller

    return authenticate


async def check_caller(request: Request) -> None:
    """Raises a 401 or 403 problem if the caller cannot be identified. Scopes are not checked."""
    await run_in_threadpool(_caller, request, await bearer(request))


def _caller(request: Request, credentials: HTTPAuthorizationCredentials | None) -> Caller:
    service = service_of(request)
    if credentials is not None:
        caller = service.keys.caller(credentials.credentials)
        if caller is not None:
            return caller
        detail = compose("key-unknown")
        raise Problem(401, "key-invalid", detail, headers={"WWW-Authenticate": 'Bearer error="invalid_token"'})
    if service.settings.is_private and not service.keys.any():
        _check_origin(request)
        return Caller(LOCAL, frozenset(SCOPES))
    detail = compose("key-wanted")
    raise Problem(401, "key-missing", detail, headers={"WWW-Authenticate": "Bearer"})


def _check_origin(request: Request) -> None:
    """Raises a 403 problem for a request that a foreign web page sends through a local browser (CSRF, DNS
    rebinding)."""
    origin = request.headers.get("origin")
    names = [request.url.hostname or ""]
    if origin is not None:
        names.append(origin.partition("://")[2].rpartition(":")[0] or origin.partition("://")[2])
    if not all(is_loopback(name) for name in names):
        detail = compose("foreign-origin")
        raise Problem(403, "foreign-origin", detail)
