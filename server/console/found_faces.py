"""Finds the faces of a capture in a child process and caches them beside its silhouettes. A caller waits at most
``PATIENCE_S`` seconds."""

import threading
import time
from collections import defaultdict
from pathlib import Path
from queue import Empty

from rig.errors import Cancelled
from rig.messages.message import compose
from server.errors import Unavailable
from server.services.service import Service
from server.services.work import refuse_board
from server.storage.face_cache import FacesDocument, faces_once
from server.tasks.faces import find_capture_faces

PATIENCE_S = 50.0  # eleven pictures of 12 Mpx take 4 s, forty 15

_finding: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)


def found_faces(service: Service, identity: str) -> FacesDocument:
    """Returns the faces in a capture's pictures. The first call finds them; later ones read the cache. Blocks.

    Raises NotFound, Conflict for a shot of the board, InputError and WorkFailed if the pictures cannot be searched, and
    Unavailable after ``PATIENCE_S`` seconds.
    """
    deadline = time.monotonic() + PATIENCE_S
    record = service.store.capture(identity)
    refuse_board(record)
    images = {Path(name).stem: name for name in record.inputs if Path(name).parent.name == "images"}
    files = service.store.capture_files(identity)

    def find() -> FacesDocument:
        with service.children.one(max(0.0, deadline - time.monotonic())) as child:
            work = child.remote(find_capture_faces, cancelled=lambda: time.monotonic() > deadline)
            return work(capture=str(files), images=images)

    lock = _finding[identity]
    if not lock.acquire(timeout=PATIENCE_S):
        raise _slow()
    try:
        return faces_once(service.store.cache_of(identity) / "faces", record.inputs, find)
    except (Cancelled, Empty):
        raise _slow() from None
    finally:
        lock.release()


def _slow() -> Unavailable:
    return Unavailable("service-unavailable", compose("faces-slow", seconds=PATIENCE_S))
