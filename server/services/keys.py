"""Manages API keys and their scopes, which state the actions that a caller may do.

A key is ``eh_<id>_<secret>``. The database holds only the SHA-256 of an API key's secret. The secret has 256 random
bits, so a slow hash would not make the secret harder to guess. Without any key the service answers only its own machine
and refuses to listen to other machines.
"""

import hashlib
import hmac
import secrets
import shlex
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from rig.errors import EigenheadError
from rig.messages.message import compose
from server.errors import Forbidden, NotFound
from server.settings import ServiceSettings
from server.storage.database import api_keys, now_sql

SCOPES = ("read", "capture", "submit", "erase", "admin")  # admin holds all the others
LOCAL = "local"
HAS_KEYS = "has-keys"


class KeylessAddress(EigenheadError):
    """Reports that the service refuses to listen to the network without an API key."""

    def __init__(self, where: str, data: Path) -> None:
        super().__init__(compose("keyless-address", where=where, data=shlex.quote(str(data))))


class KeysLost(EigenheadError):
    """Reports a database without API keys beside a data folder whose service had some."""

    def __init__(self, data: Path, place: str) -> None:
        super().__init__(compose("keys-lost", data=shlex.quote(str(data)), place=place))


@dataclass(frozen=True, slots=True)
class Caller:
    """Holds the sender of a request: the id of the API key ("local" if the service has no keys), and its scopes."""

    key: str
    scopes: frozenset[str]

    def may(self, scope: str) -> bool:
        """Returns whether the caller has a scope. The scope "admin" includes all others."""
        return scope in self.scopes or "admin" in self.scopes

    def check_may(self, scope: str) -> None:
        """Raises Forbidden if the caller does not have a scope."""
        if not self.may(scope):
            raise Forbidden("scope-missing", compose("your-key-lacks-scope", scope=f"{scope!r}"))


@dataclass(frozen=True, slots=True)
class ApiKey:
    """Holds an API key without its secret. ``created`` is in seconds since 1970."""

    id: str
    name: str
    scopes: tuple[str, ...]
    created: float


class Keys:
    """Makes, lists, checks and removes the API keys in the database. Methods block."""

    def __init__(self, engine: sa.Engine) -> None:
        self._engine = engine

    def add_for(self, caller: Caller, name: str, scopes: tuple[str, ...]) -> str:
        """Makes an API key for a caller who already has one, as in ``add``. Raises Forbidden on a service without keys:
        any process of the machine could make the first key, which would lock out all other users."""
        if caller.key == LOCAL:
            raise Forbidden("first-key", compose("first-key-by-command"))
        return self.add(name, scopes)

    def add(self, name: str, scopes: tuple[str, ...]) -> str:
        """Makes an API key and returns its text, which cannot be shown again: only its hash is stored."""
        identity, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
        row = {"id": identity, "name": name, "digest": _digest(secret), "scopes": " ".join(scopes)}
        with self._engine.begin() as connection:
            connection.execute(sa.insert(api_keys).values(**row, created=now_sql(connection)))
        return f"eh_{identity}_{secret}"

    def all(self) -> list[ApiKey]:
        """Returns all API keys without their secrets, oldest first."""
        with self._engine.connect() as connection:
            rows = connection.execute(sa.select(api_keys).order_by(api_keys.c.created))
            return [ApiKey(r.id, r.name, tuple(r.scopes.split()), r.created) for r in rows]

    def remove(self, identity: str) -> None:
        """Removes an API key, which is refused from then on. Raises NotFound."""
        with self._engine.begin() as connection:
            if not connection.execute(sa.delete(api_keys).where(api_keys.c.id == identity)).rowcount:
                raise NotFound(compose("thing-key"), identity)

    def any(self) -> bool:
        """Returns whether there is any API key."""
        with self._engine.connect() as connection:
            return connection.scalar(sa.select(sa.exists(sa.select(api_keys.c.id)))) or False

    def caller(self, token: str) -> Caller | None:
        """Returns the caller whose API key is ``token``; None for an unknown or malformed key. Secrets are compared in
        constant time."""
        parts = token.split("_", 2)
        if len(parts) != 3 or parts[0] != "eh":
            return None
        with self._engine.connect() as connection:
            row = connection.execute(sa.select(api_keys).where(api_keys.c.id == parts[1][:32])).one_or_none()
        if row is None or not hmac.compare_digest(row.digest, _digest(parts[2])):
            return None
        return Caller(row.id, frozenset(row.scopes.split()))


def check_address(settings: ServiceSettings, keys: Keys) -> None:
    """Raises KeylessAddress if the service would listen to other machines without an API key, and KeysLost if the
    database lost the keys."""
    if keys.any():
        note_keys(settings.data, keys)
    elif not settings.is_private:
        raise KeylessAddress(settings.public_url or settings.host, settings.data)
    elif (settings.data / HAS_KEYS).exists():
        raise KeysLost(settings.data, settings.place)


def note_keys(data: Path, keys: Keys) -> None:
    """Records in the data folder whether the service has API keys, lest a lost database open the service to all."""
    if not keys.any():
        (data / HAS_KEYS).unlink(missing_ok=True)
    elif not (data / HAS_KEYS).exists():
        data.mkdir(parents=True, exist_ok=True)
        (data / HAS_KEYS).touch()


def _digest(secret: str) -> str:
    return hashlib.sha256(secret.encode()).hexdigest()
