"""Who may do what: API keys with scopes, or, on loopback and with no key made, the people at this machine.

A key is ``eh_<id>_<secret>``; the database holds the SHA-256 of the secret, which is 256 random bits, so that a slow
hash would add nothing. Without keys the service answers only to its own machine: it refuses to listen elsewhere, and
refuses requests that a web page elsewhere made a browser send (the Host and Origin headers tell).
"""

import hashlib
import hmac
import ipaddress
import secrets
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import sqlalchemy as sa
from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from rig.errors import EigenheadError
from server.database import api_keys, now_sql
from server.problems import Problem, not_found

SCOPES = ("read", "capture", "submit", "admin")  # admin holds all the others
LOCAL = "local"

bearer = HTTPBearer(auto_error=False, description="API key, eh_...; not needed on loopback while no key exists")


class KeylessAddress(EigenheadError):
    """Listening to the network without a key."""

    def __init__(self, host: str) -> None:
        super().__init__(
            f"refusing to listen on {host} without an API key: anybody there could fetch faces. "
            "Make one with `eigenhead keys add NAME`, or listen on 127.0.0.1"
        )


@dataclass(frozen=True, slots=True)
class Caller:
    """Who sent a request. ``key`` is the API key's id, or "local"."""

    key: str
    scopes: frozenset[str]

    def may(self, scope: str) -> bool:
        return scope in self.scopes or "admin" in self.scopes


class Keys:
    """The API keys in the database."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def add(self, name: str, scopes: tuple[str, ...]) -> str:
        """Makes a key and returns it; it cannot be shown again."""
        identity, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
        row = {"id": identity, "name": name, "digest": _digest(secret), "scopes": " ".join(scopes)}
        with self._engine.begin() as connection:
            connection.execute(sa.insert(api_keys).values(**row, created=now_sql(connection)))
        return f"eh_{identity}_{secret}"

    def all(self) -> list[dict[str, Any]]:
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(api_keys).order_by(api_keys.c.created))
            return [{"id": r.id, "name": r.name, "scopes": r.scopes.split(), "created": r.created} for r in rows]

    def remove(self, identity: str) -> None:
        """Raises a 404 problem."""
        with self._engine.begin() as connection:
            if not connection.execute(sa.delete(api_keys).where(api_keys.c.id == identity)).rowcount:
                raise not_found("key", identity)

    def any(self) -> bool:
        with self._engine.connect() as connection:
            return connection.scalar(sa.select(sa.exists(sa.select(api_keys.c.id)))) or False

    def caller(self, token: str) -> Caller | None:
        """Whose key ``token`` is; None if nobody's."""
        parts = token.split("_", 2)
        if len(parts) != 3 or parts[0] != "eh":
            return None
        with self._engine.connect() as connection:
            row = connection.execute(sa.select(api_keys).where(api_keys.c.id == parts[1][:32])).one_or_none()
        if row is None or not hmac.compare_digest(row.digest, _digest(parts[2])):
            return None
        return Caller(row.id, frozenset(row.scopes.split()))


def check_address(host: str, keys: Keys) -> None:
    """Raises KeylessAddress before the service listens where it must not."""
    if not is_loopback(host) and not keys.any():
        raise KeylessAddress(host)


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def require(scope: str) -> Callable[..., Caller]:
    """A dependency: the caller, if it may do ``scope``; else a 401 or 403 problem. Runs before a body is read."""

    def authenticate(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
    ) -> Caller:
        caller = _caller(request, credentials)
        if not caller.may(scope):
            raise Problem(403, "scope-missing", f"This key may not do that: it lacks the scope {scope!r}.")
        return caller

    return authenticate


def _caller(request: Request, credentials: HTTPAuthorizationCredentials | None) -> Caller:
    keys: Keys = request.app.state.service.keys
    if credentials is not None:
        caller = keys.caller(credentials.credentials)
        if caller is not None:
            return caller
    elif is_loopback(request.app.state.service.settings.host) and not keys.any():
        _check_origin(request)
        return Caller(LOCAL, frozenset(SCOPES))
    detail = "An API key is needed: send 'Authorization: Bearer eh_...'."
    raise Problem(401, "key-missing", detail, headers={"WWW-Authenticate": "Bearer"})


def _check_origin(request: Request) -> None:
    """Refuses what a foreign web page sends through a browser on this machine (CSRF, DNS rebinding)."""
    origin = request.headers.get("origin")
    names = [request.url.hostname or ""]
    if origin is not None:
        names.append(origin.partition("://")[2].rpartition(":")[0] or origin.partition("://")[2])
    if not all(is_loopback(name) for name in names):
        detail = "Without API keys the service answers only to its own machine; make a key with `eigenhead keys add`."
        raise Problem(403, "foreign-origin", detail)


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
