"""Implements removal with undo: an object disappears from the pages at once and is removed a little later, unless a
user undoes the removal.

Removals that can be undone exist in this process only. If the service ends before a removal, the object appears again,
which is the safe outcome.
"""

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import structlog

from rig.messages.message import Message

UNDO_S = 10.0

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Removal:
    """Holds a removal that can still be undone. ``scope``: the scope that a caller needs to undo the removal; ``ids``:
    all objects that are removed."""

    title: Message
    scope: str
    timer: threading.Timer
    ids: frozenset[str]


@dataclass
class Removals:
    """Holds the removals that can still be undone, by id. ``identity in removals`` is true while an object is being
    removed. Thread-safe."""

    wait_s: float = UNDO_S
    _waiting: dict[str, Removal] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def __contains__(self, identity: object) -> bool:
        return any(identity in removal.ids for removal in [*self._waiting.values()])

    def add(
        self, identity: str, remove: Callable[[], None], title: Message, scope: str, also: Iterable[str] = ()
    ) -> None:
        """Adds a removal; ``remove`` is called after ``wait_s`` seconds unless the removal is undone. ``also``: ids of
        further objects that ``remove`` removes. Adds nothing if the object is already being removed."""
        timer = threading.Timer(self.wait_s, self._remove, (identity, remove))
        timer.daemon = True
        with self._lock:
            if identity not in self._waiting:
                self._waiting[identity] = Removal(title, scope, timer, frozenset([identity, *also]))
                timer.start()

    def undo(self, identity: str) -> bool:
        """Undoes a removal. Returns whether the removal could still be undone."""
        with self._lock:
            removal = self._waiting.pop(identity, None)
        if removal is not None:
            removal.timer.cancel()
        return removal is not None

    def waiting(self) -> dict[str, Removal]:
        """Returns the removals that can still be undone, by the id with which they were added."""
        with self._lock:
            return dict(self._waiting)

    def _remove(self, identity: str, remove: Callable[[], None]) -> None:
        with self._lock:
            if identity not in self._waiting:
                return
        try:
            remove()
        except Exception as error:  # it is shown again, with the reason in the log
            log.warning("not removed", id=identity, error=str(error))
        with self._lock:
            self._waiting.pop(identity, None)


removals = Removals()
