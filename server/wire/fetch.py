"""Fetches a capture from an address that a caller names: an archive from another server, or from an object store an
archive or all files below a prefix.

The address is checked (server.origins, server.storage.object_places), bytes and seconds are limited, and the data are
written straight to the data folder.
"""

import tarfile
import time
from collections.abc import Mapping
from pathlib import Path

import anyio
import httpx

from rig.messages.message import Message, compose
from server.errors import InvalidInput, TooLarge
from server.origins import target
from server.services.service import Service
from server.services.uploads import too_large
from server.settings import ServiceSettings
from server.storage.object_places import locate, open_objects
from server.storage.objects import Admission, ObjectMissing, ObjectStore, StoredObject
from server.storage.store import Store
from server.wire.multipart import BLOCK_BYTES
from server.wire.patience import IDLE_TIMEOUT_S

REDIRECTS_MOST = 5
CONNECT_S = 10.0


async def fetch_archive(service: Service, url: str, folder: Path) -> Path:
    """Downloads the archive at ``url`` into ``folder`` and returns its path. Redirections are followed, each checked
    like the first address.

    Raises InvalidInput for an address that is not allowed ("url-refused") and for a server that does not deliver the
    archive ("import-failed"); TooLarge; and DiskFull.
    """
    patience = httpx.Timeout(IDLE_TIMEOUT_S, connect=CONNECT_S)
    try:
        with anyio.fail_after(service.settings.import_s):
            # No proxy of the environment: it would connect in place of us, and not to the checked address.
            async with httpx.AsyncClient(trust_env=False, timeout=patience) as client:
                return await _follow(service, client, url, folder / "upload")
    except TimeoutError as error:
        raise _failed(compose("import-too-slow", seconds=service.settings.import_s)) from error
    except (httpx.HTTPError, UnicodeError) as error:  # UnicodeError: redirected to a host that IDNA refuses
        raise _failed(compose("import-broke-off", kind=type(error).__name__, reason=str(error))) from error


async def _follow(service: Service, client: httpx.AsyncClient, url: str, path: Path) -> Path:
    for _ in range(REDIRECTS_MOST + 1):
        aim = await service.threads.disk(target, url, service.settings.import_origins)
        headers = aim.headers | {"Accept-Encoding": "identity"}  # so that Content-Length counts the archive's own bytes
        async with client.stream("GET", aim.url, headers=headers, extensions=aim.extensions) as answer:
            if answer.has_redirect_location:
                url = str(httpx.URL(url).join(answer.headers["location"]))
                continue
            if answer.status_code != 200:
                raise _failed(compose("import-answered", status=answer.status_code, phrase=answer.reason_phrase))
            await _receive(service, answer, path)
            return path
    raise _failed(compose("import-redirected", count=REDIRECTS_MOST))


async def _receive(service: Service, answer: httpx.Response, path: Path) -> None:
    """Writes the body to ``path`` block by block. Raises TooLarge, and DiskFull before a block for which there is no
    space."""
    settings, store, disk = service.settings, service.store, service.threads.disk
    announced = answer.headers.get("content-length", "")
    length = int(announced) if announced.isascii() and announced.isdigit() else 0
    if length > settings.body_bytes:
        raise too_large(settings)
    await disk(store.reserve, 2 * length, settings.free_bytes)  # packed and unpacked
    received = 0
    stream = await disk(path.open, "xb")
    try:
        async for block in answer.aiter_raw(BLOCK_BYTES):
            received += len(block)
            if received > settings.body_bytes:
                raise too_large(settings)
            await disk(store.reserve, len(block), settings.free_bytes)
            await disk(stream.write, block)
    finally:
        await disk(stream.close)
    if length and received != length:
        raise _failed(compose("import-cut-off", received=received, length=length))


def _failed(why: Message) -> InvalidInput:
    return InvalidInput("import-failed", compose("import-failed", why=why), [why])


def fetch_stored_capture(url: str, folder: Path, store: Store, settings: ServiceSettings) -> Path:
    """Fetches the capture at an object store's ``url`` into ``folder`` and returns its archive: the object itself, or
    for a URL that ends with a slash one packed from all objects below it.

    Raises InvalidInput for a forbidden location ("url-refused"), a missing object ("object-missing") and a slow store
    ("import-failed"), TooLarge, DiskFull, and Unavailable if the store fails."""
    prefix, key = locate(url, settings.import_prefixes)
    objects, archive = open_objects(prefix, settings), folder / "upload"

    def admit(size: int) -> None:
        if size > settings.body_bytes:
            raise too_large(settings)
        store.reserve(2 * size, settings.free_bytes)  # packed and unpacked

    if key and not key.endswith("/"):
        objects.fetch(key, archive, admit=admit)
    else:
        _pack(objects, _listed(url, objects, key, settings), archive, admit, settings.import_s)
    return archive


def _listed(url: str, objects: ObjectStore, prefix: str, settings: ServiceSettings) -> dict[str, StoredObject]:
    """Lists the objects below a prefix, by their names relative to it."""
    found, total = dict[str, StoredObject](), 0
    for entry in objects.entries(prefix):
        found[entry.key.removeprefix(prefix)] = entry
        total += entry.bytes
        if total > settings.body_bytes:
            raise too_large(settings)
        if len(found) > settings.archive_members:
            raise TooLarge("upload-too-large", compose("objects-many", place=url, most=settings.archive_members))
    if not found:
        raise ObjectMissing(url)
    return found


def _pack(
    objects: ObjectStore, entries: Mapping[str, StoredObject], archive: Path, admit: Admission, most_s: float
) -> None:
    """Packs objects as an archive. Unpacking the archive checks their names, as for any upload."""
    ends, part = time.monotonic() + most_s, archive.with_suffix(".part")
    with tarfile.open(archive, "w") as packed:
        for name, entry in entries.items():
            objects.fetch(entry.key, part, admit=admit)
            packed.add(part, name)
            if time.monotonic() > ends:
                raise _failed(compose("import-too-slow", seconds=most_s))
