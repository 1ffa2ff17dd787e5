"""Fetches the pinned uv with Python's standard library alone: ``python3 deploy/fetch_uv.py FOLDER`` -> FOLDER/uv.

For machines without pip and curl. The wheel's SHA-256 is pinned here, so whatever mirror serves it cannot change it.
The index is PyPI's, or the one that UV_DEFAULT_INDEX, UV_INDEX_URL or PIP_INDEX_URL names; its page is the simple HTML
of https://packaging.python.org/en/latest/specifications/simple-repository-api/.
"""

import hashlib
import io
import os
import platform
import ssl
import sys
import urllib.error
import urllib.parse
import urllib.request
import zipfile
from html.parser import HTMLParser
from pathlib import Path

VERSION = "0.13.9"
WHEELS = {
    "x86_64": (
        f"uv-{VERSION}-py3-none-manylinux_2_17_x86_64.manylinux2014_x86_64.whl",
        "d7f459fe4fd247d830351c75686d3996ace3c6f3f728eb0e85a30b7ada0cef19",
    ),
    "aarch64": (
        f"uv-{VERSION}-py3-none-manylinux_2_28_aarch64.whl",
        "ecb6028d79dc96fbeafffe5c8af62a7099487ebc05a701e76714eebcffd06375",
    ),
}
TRIES = 3
TIMEOUT_S = 120


class Links(HTMLParser):
    """Collects the targets of all links of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Notes the target of a link; other tags are ignored."""
        self.targets += [value for key, value in attrs if tag == "a" and key == "href" and value]


def index_url() -> str:
    """Returns the package index to use: that of the first set variable of uv and pip, else PyPI."""
    names = ("UV_DEFAULT_INDEX", "UV_INDEX_URL", "PIP_INDEX_URL")
    return next((os.environ[name] for name in names if os.environ.get(name)), "https://pypi.org/simple")


def fetch(url: str) -> bytes:
    """Returns the body of ``url``. Raises OSError after the last try."""
    for attempt in range(TRIES):
        try:
            with urllib.request.urlopen(url, timeout=TIMEOUT_S) as reply:
                return reply.read()
        except urllib.error.HTTPError:
            raise
        except OSError:
            if attempt + 1 == TRIES:
                raise
    raise AssertionError("unreachable")


def wheel_url(filename: str) -> str:
    """Returns the address of uv's wheel of this name in the package index. Exits with a message if the index does not
    list it."""
    page = f"{index_url().rstrip('/')}/uv/"
    links = Links()
    links.feed(fetch(page).decode())
    for target in links.targets:
        url = urllib.parse.urljoin(page, target).partition("#")[0]
        if urllib.parse.unquote(url).endswith("/" + filename):
            return url
    raise SystemExit(f"{page} lists no {filename}; install uv by hand: https://docs.astral.sh/uv/")


def unpack(wheel: bytes, target: Path) -> None:
    """Writes the wheel's ``uv`` under a temporary name and renames it, so that no half of one is ever found."""
    with zipfile.ZipFile(io.BytesIO(wheel)) as archive:
        member = next(name for name in archive.namelist() if name.endswith(".data/scripts/uv"))
        program = archive.read(member)
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f".uv.{os.getpid()}.part")
    part.write_bytes(program)
    part.chmod(0o755)
    part.replace(target)


def main(folder: Path) -> None:
    """Puts the pinned uv for this machine into ``folder``. Exits with a message if it cannot be fetched or is not the
    pinned file."""
    machine = platform.machine()
    if sys.platform != "linux" or machine not in WHEELS:
        raise SystemExit(f"no uv is pinned for {sys.platform} on {machine}; install uv: https://docs.astral.sh/uv/")
    filename, digest = WHEELS[machine]
    try:
        wheel = fetch(wheel_url(filename))
    except OSError as error:
        reason = getattr(error, "reason", error)
        if isinstance(reason, ssl.SSLCertVerificationError):
            raise SystemExit(f"uv cannot be fetched: {reason}. Install Debian's ca-certificates") from None
        raise SystemExit(f"uv cannot be fetched from {index_url()}: {error}. Is there a network?") from None
    if hashlib.sha256(wheel).hexdigest() != digest:
        raise SystemExit(f"{filename} is not the file that was pinned: its SHA-256 differs")
    unpack(wheel, folder / "uv")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
