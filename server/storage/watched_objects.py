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


class StoreTally:
    """Holds the number of operations by name and outcome, and the seconds that they took by name."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
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

    @contextmanager
    def counting(self, operation: str) -> Iterator[None]:
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


class WatchedObjects:
    """Passes every call on to an object store, and counts it."""

    def __init__(self, objects: ObjectStore) -> None:
        self._objects, self.tally = objects, StoreTally()

    def put(self, key: str, path: Path, sha256: str) -> None:
        """Stores a file, as in ``ObjectStore``."""
        with self.tally.counting("put"):
            self._objects.put(key, path, sha256)

    def fetch(self, key: str, path: Path, sha256: str | None = None, admit: Admission = any_size) -> str:
        """Writes an object to a file, as in ``ObjectStore``."""
        with self.tally.counting("fetch"):
            return self._objects.fetch(key, path, sha256, admit)

    def entries(self, prefix: str) -> Iterator[StoredObject]:
        """Yields the objects below a key, as in ``ObjectStore``."""
        with self.tally.counting("list"):
            yield from self._objects.entries(prefix)

    def folders(self) -> Iterator[str]:
        """Yields the first parts of keys, as in ``ObjectStore``."""
        with self.tally.counting("list"):
            yield from self._objects.folders()

    def erase(self, prefix: str) -> int:
        """Removes all objects below a key, as in ``ObjectStore``."""
        with self.tally.counting("erase"):
            return self._objects.erase(prefix)

    def link(self, key: str, name: str, seconds: int) -> str | None:
        """Returns an address of an object, as in ``ObjectStore``."""
        with self.tally.counting("link"):
            return self._objects.link(key, name, seconds)
