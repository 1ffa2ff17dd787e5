"""Counts the requests to an object store, their outcomes, and their seconds."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from server.storage.objects import (
    Admission,
    ObjectMissing,
    ObjectStore,
    StoreDenied,
    StoredObject,
    StoreUnavailable,
    any_size,
)

OUTCOMES = {ObjectMissing: "missing", StoreUnavailable: "unavailable", StoreDenied: "denied"}


class WatchedObjects:
    """Forwards all calls to an object store, and counts operations by name and outcome, and their seconds by name."""

    def __init__(self, objects: ObjectStore) -> None:
        self._objects, self._lock = objects, threading.Lock()
        self._operations, self._seconds = Counter[tuple[str, str]](), Counter[str]()

    def operations(self) -> dict[tuple[str, str], int]:
        """Returns the number of operations by name and outcome. An outcome is done, missing, unavailable, denied or
        refused (for example by a full disk)."""
        with self._lock:
            return dict(self._operations)

    def seconds(self) -> dict[str, float]:
        """Returns the seconds that operations took, by name."""
        with self._lock:
            return dict(self._seconds)

    def probe(self) -> None:
        """Requests an empty list from the store. Raises StoreUnavailable and StoreDenied."""
        next(self.entries("none/"), None)

    def put(self, key: str, path: Path, sha256: str) -> None:
        """Stores a file, as in ``ObjectStore``."""
        with self._counting("put"):
            self._objects.put(key, path, sha256)

    def fetch(self, key: str, path: Path, sha256: str | None = None, admit: Admission = any_size) -> str:
        """Writes an object to a file, as in ``ObjectStore``."""
        with self._counting("fetch"):
            return self._objects.fetch(key, path, sha256, admit)

    def entries(self, prefix: str) -> Iterator[StoredObject]:
        """Yields the objects below a key, as in ``ObjectStore``."""
        with self._counting("list"):
            yield from self._objects.entries(prefix)

    def folders(self) -> Iterator[str]:
        """Yields the first parts of keys, as in ``ObjectStore``."""
        with self._counting("list"):
            yield from self._objects.folders()

    def erase(self, prefix: str) -> int:
        """Removes all objects below a key, as in ``ObjectStore``."""
        with self._counting("erase"):
            return self._objects.erase(prefix)

    def link(self, key: str, name: str, seconds: int) -> str | None:
        """Returns an address of an object, as in ``ObjectStore``."""
        with self._counting("link"):
            return self._objects.link(key, name, seconds)

    @contextmanager
    def _counting(self, operation: str) -> Iterator[None]:
        """Counts the block as one operation."""
        began, outcome = time.monotonic(), "refused"
        try:
            yield
            outcome = "done"
        except GeneratorExit:  # whoever listed has seen enough
            outcome = "done"
            raise
        except (ObjectMissing, StoreUnavailable, StoreDenied) as error:
            outcome = next(word for kind, word in OUTCOMES.items() if isinstance(error, kind))
            raise
        finally:
            with self._lock:
                self._operations[operation, outcome] += 1
                self._seconds[operation] += time.monotonic() - began  # pyright: ignore[reportArgumentType]
