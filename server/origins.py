"""Decides which other servers this service may call on behalf of a caller, and at which address.

A caller who names an address must not turn the service against its own network (server-side request forgery). The
service calls only origins that the operator listed; ``https://*`` stands for every public origin. The service looks up
a host name once, and checks each address of the host. The service connects to a checked address, so a later change of a
host name's address has no effect. Code that follows a redirection must check its address, too.
"""

import ipaddress
import re
import socket
from collections.abc import Collection
from dataclasses import dataclass

import httpx

from rig.messages.message import compose
from server.errors import UrlRefused

ANY_PUBLIC = "https://*"
PORTS = {"http": 80, "https": 443}
HOST = re.compile(r"[a-z0-9._-]+|[0-9a-f:.]+", re.IGNORECASE)  # a name, or an address of IPv6
NAT64 = ipaddress.ip_network("64:ff9b::/96")  # RFC 6052: IPv4 in its last 32 bits

Address = ipaddress.IPv4Address | ipaddress.IPv6Address


@dataclass(frozen=True, slots=True)
class Target:
    """Holds a checked address: the URL to connect to, and the headers and extensions that name the intended host in the
    request."""

    url: httpx.URL
    headers: dict[str, str]
    extensions: dict[str, str]  # the name that the certificate must have


def target(url: str, origins: Collection[str]) -> Target:
    """Checks ``url`` and returns where to connect. ``origins``: the origins that the operator allows. The function
    blocks while it looks up the host name.

    Raises InvalidInput ("url-refused") for an address that is malformed, not allowed, or not public.
    """
    wanted = parsed(url)
    if wanted.userinfo:
        raise UrlRefused(compose("url-with-user"))
    named = origin_of(wanted) in {origin_of(httpx.URL(origin)) for origin in origins if origin != ANY_PUBLIC}
    if not named and not (ANY_PUBLIC in origins and wanted.scheme == "https" and wanted.port in (None, 443)):
        raise UrlRefused(compose("url-not-allowed", origin=origin_of(wanted)))
    host = wanted.raw_host.decode("ascii")
    addresses = _addresses(host, wanted.port or PORTS[wanted.scheme])
    if not named and not all(is_public(address) for address in addresses):
        raise UrlRefused(compose("url-not-public", origin=origin_of(wanted)))
    return Target(
        wanted.copy_with(host=str(addresses[0]), fragment=None),
        {"Host": wanted.netloc.decode("ascii")},
        {"sni_hostname": host} if wanted.scheme == "https" else {},
    )


def parsed(url: str) -> httpx.URL:
    """Parses a web address, without looking up its host. Raises InvalidInput ("url-refused") if the text is not a URL,
    is not http(s), or names a host that cannot exist."""
    try:
        wanted = httpx.URL(url)
        shown, host = wanted.host, wanted.raw_host.decode("ascii")  # httpx decodes a host no sooner than it is asked
        host.encode("idna")  # as getaddrinfo will
    except (httpx.InvalidURL, ValueError, TypeError) as error:  # UnicodeError, of what IDNA refuses, is a ValueError
        raise UrlRefused(compose("url-none")) from error
    if wanted.scheme not in PORTS or not shown:
        raise UrlRefused(compose("url-not-web"))
    if not HOST.fullmatch(host):
        raise UrlRefused(compose("url-host-impossible", host=f"{host!r:.80}"))
    return wanted


def origin_of(url: httpx.URL) -> str:
    """Returns scheme://host of a URL, with the port if this is not the scheme's default."""
    port = "" if url.port in (None, PORTS.get(url.scheme)) else f":{url.port}"
    host = url.raw_host.decode("ascii").lower()
    return f"{url.scheme}://{f'[{host}]' if ':' in host else host}{port}"


def is_public(address: Address) -> bool:
    """Returns whether an IP address belongs to the public internet. An IPv6 address that contains an IPv4 address is
    classified by the latter."""
    if isinstance(address, ipaddress.IPv6Address):
        inner = [address.ipv4_mapped, address.sixtofour, *(address.teredo or ())]
        inner.append(ipaddress.IPv4Address(int(address) & 0xFFFFFFFF) if address in NAT64 else None)
        if not all(is_public(one) for one in inner if one is not None):
            return False
        if any(one is not None for one in inner):
            return True
    return address.is_global and not address.is_multicast and not address.is_reserved


def _addresses(host: str, port: int) -> list[Address]:
    try:
        addresses = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
    except OSError as error:
        raise UrlRefused(compose("url-host-unknown", host=host, reason=str(error.strerror))) from error
    return [ipaddress.ip_address(str(address[0]).partition("%")[0]) for *_, address in addresses]
