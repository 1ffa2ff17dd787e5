"""Places in object stores: which a caller may name, and the store behind each."""

import unicodedata
from collections.abc import Collection
from pathlib import Path

from rig.messages.message import Message, compose
from server.errors import InvalidInput
from server.settings import OBJECT_PREFIX, ServiceSettings
from server.storage.objects import FolderObjects, ObjectStore
from server.storage.s3_objects import open_bucket

KEY_BYTES_MOST = 900  # S3 takes 1024, with the prefix


def key_faults(key: str) -> list[Message]:
    """Returns what is wrong with a key, or with a prefix that ends with a slash."""
    if any(unicodedata.category(c) in ("Cc", "Cs") for c in key) or "\\" in key:
        return [compose("key-characters")]
    if len(key.encode()) > KEY_BYTES_MOST:
        return [compose("key-long", most=KEY_BYTES_MOST)]
    if any(part in ("", ".", "..") for part in key.removesuffix("/").split("/")):
        return [compose("key-parts")]
    return []


def locate(url: str, prefixes: Collection[str]) -> tuple[str, str]:
    """Returns the allowed prefix that ``url`` lies below, and its key there. Raises InvalidInput ("url-refused")."""
    if not OBJECT_PREFIX.match(f"{url}/"):
        raise _refused(compose("object-url-none"))
    for prefix in sorted(prefixes, key=len, reverse=True):
        if url.startswith(prefix):
            key = url.removeprefix(prefix)
            if key and (faults := key_faults(key)):
                raise _refused(faults[0])
            return prefix, key
    raise _refused(compose("object-url-not-allowed", prefixes=sorted(prefixes)))


def is_object_url(url: str) -> bool:
    """Tells whether a URL names something in a store, not on the web."""
    return url.startswith(("s3://", "file://"))


def open_objects(prefix: str, settings: ServiceSettings) -> ObjectStore:
    """Opens the store at ``s3://bucket/prefix/`` or ``file:///folder/``, without asking it anything. Raises StoreDenied
    where the extra for S3 is not installed."""
    if prefix.startswith("file://"):
        return FolderObjects(Path(prefix.removeprefix("file://")))
    return open_bucket(prefix, settings)


def _refused(why: Message) -> InvalidInput:
    return InvalidInput("url-refused", compose("url-refused", why=why), [compose("field-url-refused", why=why)])
