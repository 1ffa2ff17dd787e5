"""Identifies the user of a page: anybody on this machine if there are no API keys, otherwise a key's owner.

The browser's session does not store the API key itself. The user storage of the browser's session (a file in the data
folder, named by a signed cookie) holds the API key's id, and every refresh of a page looks the key up in the database.
So the pages close when the API key is removed, and a sign-in survives a restart of the service.
"""

import secrets
from collections.abc import Mapping
from pathlib import Path

from nicegui import app as pages
from starlette.datastructures import Headers
from starlette.types import Scope

from rig.files import write_atomically
from rig.messages.message import compose
from server.address import is_loopback
from server.errors import Unauthenticated
from server.services.keys import LOCAL, SCOPES, Caller
from server.services.service import Service
from server.settings import ServiceSettings

KEY_ID = "key_id"


def service_of_pages() -> Service:
    """Returns the running service. The service exists as long as its pages do."""
    return pages.state.eigenhead.state.service


def caller_of(service: Service, stored: Mapping[str, object]) -> Caller | None:
    """Identifies the caller by ``stored``, the user storage of the browser's session. Returns None if an API key must
    be given first. Blocks."""
    keys = {key.id: key for key in service.keys.all()}
    if not keys and service.settings.is_private:
        return Caller(LOCAL, frozenset(SCOPES))
    key = keys.get(str(stored.get(KEY_ID, "")))
    return None if key is None else Caller(key.id, frozenset(key.scopes))


def permit(caller: Caller | None, scope: str) -> Caller:
    """Returns ``caller`` if the caller has the scope. Raises Unauthenticated if the caller is None, and Forbidden for a
    caller without the scope."""
    if caller is None:
        raise Unauthenticated("key-missing", compose("sign-in-again"))
    caller.check_may(scope)
    return caller


def cookie_secret(data: Path) -> str:
    """Returns the secret that signs session cookies. The secret is made once and stored in the data folder, so a
    restart of the service signs nobody out."""
    path = data / "console" / "secret"
    if not path.is_file() or not path.stat().st_size:  # an empty one is left where a full disk met the first start
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        write_atomically(path, secrets.token_hex(32).encode(), mode=0o600)
    return path.read_text()


def is_foreign(scope: Scope, settings: ServiceSettings) -> bool:
    """Returns whether a page of another site made a browser send this request: its Origin is neither the requested host
    nor the public address."""
    headers = Headers(scope=scope)
    origin, host = headers.get("origin"), headers.get("host", "")
    return origin is not None and origin not in (settings.public_url, f"http://{host}", f"https://{host}")


def is_rebound(scope: Scope, settings: ServiceSettings) -> bool:
    """Returns whether a request names a host that is neither loopback nor the public one, although the service listens
    on loopback only, as a browser does in an attack by DNS rebinding."""
    host = Headers(scope=scope).get("host", "")
    name = host.rpartition(":")
    return is_loopback(settings.host) and host != settings.public_host and not is_loopback(name[0] or name[2])
