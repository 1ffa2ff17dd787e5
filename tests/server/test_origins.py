"""Which servers elsewhere may be called: the operator's, or any public one; the judged address is the one used."""

import ipaddress
import socket

import pytest

from server.errors import InvalidInput
from server.origins import ANY_PUBLIC, is_public, target


def resolve_to(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> list[str]:
    hosts = []

    def getaddrinfo(host: str, port: int, **_: object) -> list[tuple]:
        hosts.append(host)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (address, port)) for address in addresses]

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)
    return hosts


@pytest.mark.parametrize(
    "address",
    [
        *("127.0.0.1", "10.1.1.1", "172.16.0.1", "192.168.1.1", "169.254.169.254", "0.0.0.0", "100.64.0.1"),
        *("224.0.0.1", "240.0.0.1", "255.255.255.255", "::", "::1", "fe80::1", "fc00::1", "ff0e::1"),
        *("::ffff:10.0.0.1", "64:ff9b::a00:1", "2002:a00:1::", "2001:0:a00:1::"),
    ],
)
def test_an_address_of_no_public_machine_is_refused(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not is_public(ipaddress.ip_address(address))
    resolve_to(monkeypatch, "93.184.216.34", address)  # one of several is enough
    with pytest.raises(InvalidInput, match="no public address"):
        target("https://store.example/a.zip", [ANY_PUBLIC])


def test_public_addresses_are_public() -> None:
    assert all(is_public(ipaddress.ip_address(a)) for a in ("8.8.8.8", "2606:4700::1111", "64:ff9b::808:808"))


def test_the_connection_goes_to_the_judged_address_under_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    hosts = resolve_to(monkeypatch, "93.184.216.34")
    aim = target("https://Store.example/a.zip?v=1#x", [ANY_PUBLIC])
    assert str(aim.url) == "https://93.184.216.34/a.zip?v=1"
    assert (aim.headers, aim.extensions) == ({"Host": "store.example"}, {"sni_hostname": "store.example"})
    assert hosts == ["store.example"]


def test_a_named_origin_may_be_private_and_no_other_port_or_scheme_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    resolve_to(monkeypatch, "10.0.0.5")
    allowed = ["http://nas.lab:9000", "https://store.lab"]
    aim = target("http://nas.lab:9000/a.zip", allowed)
    assert (str(aim.url), aim.headers, aim.extensions) == ("http://10.0.0.5:9000/a.zip", {"Host": "nas.lab:9000"}, {})
    assert str(target("https://store.lab:443/a", allowed).url) == "https://10.0.0.5/a"
    for wrong in ("http://nas.lab/a", "https://nas.lab:9000/a", "http://store.lab/a", "http://nas.lab.evil:9000/a"):
        with pytest.raises(InvalidInput, match="did not allow"):
            target(wrong, allowed)


@pytest.mark.parametrize(
    ("url", "why"),
    [
        ("ftp://store.example/a", "no https"),
        ("file:///etc/passwd", "no https"),
        ("https:///a", "no https"),
        ("store.example/a", "no https"),
        ("https://store.example/\x00", "not a URL"),
        *[
            (f"https://{host}/a", "not a URL")
            for host in ("a..b", ".", "xn--", f"{'a' * 80}.example", "☃☃.example", "[::1")
        ],
        *[(f"https://{host}/a", "an impossible host") for host in ("[", "a b", "a%00b")],
        ("https://user:word@store.example/a", "user name"),
        ("http://store.example/a", "did not allow"),  # any public one: by TLS, on its port
        ("https://store.example:22/a", "did not allow"),
    ],
)
def test_what_is_no_address_for_this_is_refused(url: str, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    resolve_to(monkeypatch, "93.184.216.34")
    with pytest.raises(InvalidInput, match=why):
        target(url, [ANY_PUBLIC])


def test_a_name_that_nobody_knows_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(-2, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    with pytest.raises(InvalidInput, match="nobody knows"):
        target("https://store.example/a", [ANY_PUBLIC])
