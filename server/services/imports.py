"""Imports captures from object stores: an archive under one key, or the files below a prefix."""

import tarfile
import time
from collections.abc import Mapping
from pathlib import Path

from rig.messages.message import compose
from server.errors import InvalidInput, TooLarge
from server.services.uploads import too_large
from server.settings import ServiceSettings
from server.storage.object_places import locate, open_objects
from server.storage.objects import Admission, ObjectMissing, ObjectStore, StoredObject
from server.storage.store import Store


def fetch_stored_capture(url: str, folder: Path, store: Store, settings: ServiceSettings) -> Path:
    """Fetches the capture at an object store's ``url`` into ``folder`` and returns its archive: the object itself or,
    if the URL ends with a slash, an archive of all objects below it.

    Raises InvalidInput for a place that is not allowed ("url-refused"), for one without objects ("object-missing") and
    for a store that is slow ("import-failed"), TooLarge, DiskFull, and Unavailable if the store fails."""
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
    """Lists the objects below a prefix, by their names there."""
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
    """Packs objects as an archive. Their names are checked when it is unpacked, as in any upload."""
    ends, part = time.monotonic() + most_s, archive.with_suffix(".part")
    with tarfile.open(archive, "w") as packed:
        for name, entry in entries.items():
            objects.fetch(entry.key, part, admit=admit)
            packed.add(part, name)
            if time.monotonic() > ends:
                why = compose("import-too-slow", seconds=most_s)
                raise InvalidInput("import-failed", compose("import-failed", why=why), [why])
