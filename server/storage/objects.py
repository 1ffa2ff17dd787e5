"""Stores objects, which are complete files under keys, in a folder or in an S3-compatible bucket.

An object is visible only when it is complete, and each read is compared with its checksum. A key is a relative path
with slashes. ``ObjectStore`` has two implementations: ``FolderObjects`` here, ``S3Objects`` in
``server.storage.object_places``.
"""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from rig.files import sha256_of
from rig.messages.message import Message, compose
from server.errors import InvalidInput, Unavailable
from server.storage.folders import sync_folder

AGAIN_S = 10  # until a client asks again for what a store did not do
BLOCK_BYTES = 1 << 20


class StoreUnavailable(Unavailable):
    """Reports a store that does not answer, or returns damaged bytes; it may recover without intervention."""

    def __init__(self, place: str, reason: Message | str) -> None:
        detail = compose("store-unavailable", place=place, reason=_short(reason))
        super().__init__("store-unavailable", detail, retry_after_s=AGAIN_S)


class StoreDenied(InvalidInput):
    """Reports a store that refuses a request until its operator changes something."""

    def __init__(self, place: str, reason: Message | str) -> None:
        super().__init__("store-denied", compose("store-denied", place=place, reason=_short(reason)))


class ObjectMissing(InvalidInput):
    """Reports that there is no object under a key."""

    def __init__(self, place: str) -> None:
        super().__init__("object-missing", compose("object-missing", place=place))


Admission = Callable[[int], None]  # is called with the size of an object before its bytes are written; may raise


def any_size(size: int) -> None:
    """Admits every object."""


@dataclass(frozen=True, slots=True)
class StoredObject:
    """Holds the key of an object, its size, and when it was written (s since 1970)."""

    key: str
    bytes: int
    written: float


class ObjectStore(Protocol):
    """Stores objects below one location. Methods block, and may be called by several threads and processes at once.

    Each method raises StoreUnavailable if the store fails, and StoreDenied if it refuses.
    """

    def put(self, key: str, path: Path, sha256: str) -> None:
        """Stores a file whose content has this SHA-256, replacing an object of the same key. Returns once the stored
        object, read back, has this SHA-256; an equal object is left as it is."""
        ...

    def fetch(self, key: str, path: Path, sha256: str | None = None, admit: Admission = any_size) -> str:
        """Writes an object to the file ``path`` and returns its SHA-256, which must be ``sha256`` if that is given.
        Raises ObjectMissing, and what ``admit`` raises."""
        ...

    def entries(self, prefix: str) -> Iterator[StoredObject]:
        """Yields the objects whose keys begin with ``prefix``, which ends with a slash or is empty."""
        ...

    def folders(self) -> Iterator[str]:
        """Yields the parts before the first slash of all keys that have one, each once."""
        ...

    def link(self, key: str, name: str, seconds: int) -> str | None:
        """Returns an address where anybody can get the object for ``seconds``, as a file with this name. Returns None
        if the store has no such addresses. Raises ObjectMissing."""
        ...

    def erase(self, prefix: str) -> int:
        """Removes all objects whose keys begin with ``prefix``, with all versions and the parts of unfinished uploads.
        Returns how many objects were removed."""
        ...


def _short(reason: Message | str) -> Message | str:
    return reason if isinstance(reason, Message) else reason[:300]


class FolderObjects:
    """Stores objects in a folder, possibly on another machine. The folder must exist: if it is not mounted, it is not
    created in its mount point."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def put(self, key: str, path: Path, sha256: str) -> None:
        """Stores a file, as in ``ObjectStore``."""
        with self._asking(key) as target:
            if target.is_file() and sha256_of(target) == sha256:
                return
            target.parent.mkdir(parents=True, exist_ok=True)
            handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
            part = Path(name)
            try:
                with os.fdopen(handle, "wb") as stream, path.open("rb") as source:
                    shutil.copyfileobj(source, stream, BLOCK_BYTES)
                    stream.flush()
                    os.fsync(stream.fileno())
                if sha256_of(part) != sha256:
                    raise StoreUnavailable(self._place(key), compose("store-checksum"))
                part.chmod(0o644)
                part.replace(target)
            finally:
                part.unlink(missing_ok=True)
            sync_folder(target.parent)

    def fetch(self, key: str, path: Path, sha256: str | None = None, admit: Admission = any_size) -> str:
        """Writes an object to a file, as in ``ObjectStore``."""
        with self._asking(key) as source:
            if not source.is_file():
                raise ObjectMissing(self._place(key))
            admit(source.stat().st_size)
            shutil.copyfile(source, path)
        digest = sha256_of(path)
        if sha256 not in (None, digest):
            path.unlink()
            raise StoreUnavailable(self._place(key), compose("store-checksum"))
        return digest

    def entries(self, prefix: str) -> Iterator[StoredObject]:
        """Yields the objects below a key, as in ``ObjectStore``."""
        with self._asking(prefix) as folder:
            for path in sorted(folder.rglob("*")):
                if path.is_file() and not path.is_symlink() and not path.name.endswith(".part"):
                    yield StoredObject(
                        path.relative_to(self._root).as_posix(), path.stat().st_size, path.stat().st_mtime
                    )

    def folders(self) -> Iterator[str]:
        """Yields the names of folders, as in ``ObjectStore``."""
        with self._asking("") as root:
            yield from sorted(path.name for path in root.iterdir() if path.is_dir() and not path.is_symlink())

    def link(self, key: str, name: str, seconds: int) -> str | None:
        """Returns None, since the service itself sends files of a folder."""
        return None

    def erase(self, prefix: str) -> int:
        """Removes all objects below a key and returns how many, as in ``ObjectStore``."""
        with self._asking(prefix) as folder:
            if folder == self._root:
                raise StoreDenied(self._place(prefix), compose("store-whole"))
            removed = 0
            while folder.exists():
                with suppress(FileNotFoundError):  # somebody else removes it, too
                    removed = sum(path.is_file() for path in folder.rglob("*"))
                    shutil.rmtree(folder)
        return removed

    def _place(self, key: str) -> str:
        return f"file://{self._root}/{key}"

    @contextmanager
    def _asking(self, key: str) -> Iterator[Path]:
        """Yields the path of a key; links inside the folder do not lead out of it."""
        path = self._root / key
        try:
            if not self._root.is_dir():
                raise StoreUnavailable(self._place(key), compose("store-not-mounted"))
            if not path.resolve().is_relative_to(self._root.resolve()):
                raise StoreDenied(self._place(key), compose("store-link"))
            yield path
        except PermissionError as error:
            raise StoreDenied(self._place(key), str(error.strerror)) from error
        except OSError as error:
            raise StoreUnavailable(self._place(key), str(error.strerror or error)) from error
