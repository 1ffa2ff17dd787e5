"""Stores files of captures in an object store: each content once, under ``<its SHA-256>-<16 hex digits>/content``.

The database maps captures to blobs; workers without the service's data folder read both database and store. A blob
without references is marked dead in the same transaction and is never used again: equal content that comes later gets a
new blob. Any number of processes may remove dead blobs at any time, and never remove a blob in use.
"""

import os
import re
import secrets
import tempfile
import time
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa
import structlog

from rig.files import sha256_of
from rig.messages.message import compose
from server.errors import Conflict
from server.settings import ServiceSettings
from server.storage.database import blobs, capture_files, capture_index, portions
from server.storage.object_places import open_objects
from server.storage.objects import Admission, ObjectMissing, StoreDenied, StoreUnavailable
from server.storage.watched_objects import WatchedObjects

NAME = re.compile(r"[0-9a-f]{64}-[0-9a-f]{16}")
SMALL_BYTES = 1 << 16  # files up to this size stay in the data folder, and are compared before they are used
ARRIVING_S = 3600.0  # a capture whose files are older than that and that is not there was given up

log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Blob:
    """Holds the name of a blob, and the SHA-256 and size of its content. ``stored``: whether the store has it."""

    id: str
    sha256: str
    bytes: int
    stored: bool = False

    @property
    def key(self) -> str:
        """Returns the blob's object key."""
        return f"{self.id}/content"


class CaptureBlobs:
    """Stores and fetches the files of captures. Methods block, and may be called by several processes at once. Each
    method raises StoreUnavailable if the store fails, and StoreDenied if it refuses."""

    def __init__(self, objects: WatchedObjects, engine: sa.Engine) -> None:
        self.objects, self._engine = objects, engine

    def keep(self, capture: str, folder: Path, inputs: Mapping[str, str]) -> None:
        """Stores the files of a capture that lie in ``folder``; ``inputs`` is their SHA-256 by name. Other processes
        can fetch the files once all of them are stored. Contents that the store already has are not sent again."""
        claimed = self._claim(capture, inputs, lambda name: (folder / name).stat().st_size)
        used = {blob.id: (name, blob) for name, blob in claimed.items()}
        sent = list[str]()
        try:
            for name, blob in used.values():
                if not blob.stored:
                    sent.append(blob.id)
                    self.objects.put(blob.key, folder / name, blob.sha256)
        finally:
            self._take_back(sent)
        mine = sa.and_(capture_files.c.capture_id == capture, capture_files.c.blob_id.in_(used))
        with self._engine.begin() as connection:
            connection.execute(sa.update(blobs).where(blobs.c.id.in_(used), ~blobs.c.dead).values(stored=True))
            connection.execute(sa.update(capture_files).where(mine).values(arrived=True))

    def offer(self, capture: str, folder: Path, inputs: Mapping[str, str]) -> bool:
        """Stores the files of a capture, as ``keep`` does. Returns False if the store does not accept them, or the
        capture is gone; the files then wait for the next sweep."""
        try:
            self.keep(capture, folder, inputs)
        except (StoreUnavailable, StoreDenied) as error:
            log.warning("a capture waits for the store", capture=capture, reason=error.detail.text)
            return False
        except FileNotFoundError:
            return False
        return True

    def files(self, capture: str) -> dict[str, Blob]:
        """Returns the blobs of a capture by the names of its files; empty until all of them are in the store."""
        query = sa.select(capture_files.c.name, capture_files.c.arrived, blobs).join(
            blobs, blobs.c.id == capture_files.c.blob_id
        )
        with self._engine.connect() as connection:
            rows = connection.execute(query.where(capture_files.c.capture_id == capture)).all()
        if not all(row.arrived for row in rows):
            return {}
        return {row.name: Blob(row.id, row.sha256, row.bytes, row.stored) for row in rows}

    def is_known(self, capture: str) -> bool:
        """Returns whether the service has a capture, even if its files are not in the store yet."""
        with self._engine.connect() as connection:
            return connection.scalar(sa.select(sa.literal(1)).where(capture_index.c.id == capture)) is not None

    def restore(self, capture: str, folder: Path, inputs: Mapping[str, str] | None, admit: Admission) -> None:
        """Fetches the files of a capture that ``folder`` lacks. ``inputs``: SHA-256 by name; None: from the database.
        Raises Conflict ("capture-missing") for files that exist nowhere, and what ``admit`` raises."""
        there = inputs is not None and all(_is_there(folder / name, sha256) for name, sha256 in inputs.items())
        known = {} if there else self.files(capture)
        wanted = {name: blob.sha256 for name, blob in known.items()} if inputs is None else inputs
        if inputs is None and not known:
            raise Conflict("capture-missing", compose("capture-missing"))
        for name, sha256 in wanted.items():
            if not _is_there(folder / name, sha256):
                blob = known.get(name)
                if blob is None or blob.sha256 != sha256:
                    raise Conflict("capture-missing", compose("capture-missing"))
                self._fetch(blob, folder / name, admit)

    def compare(self, capture: str, folder: Path) -> dict[str, Path]:
        """Returns the large files of a capture in ``folder`` that are in the store, each compared with its object."""
        same = {}
        for name, blob in self.files(capture).items():
            path = folder / name
            if blob.bytes > SMALL_BYTES and path.is_file():
                self.objects.put(blob.key, path, blob.sha256)
                same[name] = path
        return same

    def release(self, capture: str, *, later: bool = False) -> None:
        """Removes blobs that only this capture uses from the store, with every version; with ``later`` the next sweep
        removes them. A removal that fails is completed by a second call."""
        self._claim(capture, {}, lambda _: 0)
        if not later:
            self.bury()

    def bury(self) -> int:
        """Removes all dead blobs. Returns their number."""
        with self._engine.connect() as connection:
            dead = connection.scalars(sa.select(blobs.c.id).where(blobs.c.dead)).all()
        for blob in dead:
            self.objects.erase(f"{blob}/")
            with self._engine.begin() as connection:
                connection.execute(sa.delete(blobs).where(blobs.c.id == blob))
        return len(dead)

    def waiting(self, limit: int) -> list[str]:
        """Returns captures of the service whose files are not all in the store, the oldest first."""
        arrived = sa.select(capture_files.c.capture_id).where(capture_files.c.arrived)
        query = sa.select(capture_index.c.id).where(capture_index.c.id.not_in(arrived)).order_by(capture_index.c.id)
        with self._engine.connect() as connection:
            return [*connection.scalars(query.limit(limit))]

    def bytes_of_all(self) -> int:
        """Returns the size of the files of all captures of the service, wherever they are."""
        with self._engine.connect() as connection:
            return int(connection.scalar(sa.select(sa.func.sum(capture_index.c.bytes))) or 0)

    def release_abandoned(self) -> None:
        """Releases the files of captures that were being received when their service was killed."""
        known = sa.select(capture_index.c.id)
        query = sa.select(capture_files.c.capture_id).distinct()
        query = query.where(~capture_files.c.arrived, capture_files.c.capture_id.not_in(known))
        with self._engine.connect() as connection:
            found = [c for c in connection.scalars(query) if time.time() - int(c[:12], 16) / 1e3 > ARRIVING_S]
        for capture in found:
            self.release(capture)

    def known(self, ids: Collection[str]) -> set[str]:
        """Returns the ids that are blobs of this database."""
        with self._engine.connect() as connection:
            return {*connection.scalars(sa.select(blobs.c.id).where(blobs.c.id.in_(ids)))}

    def holders(self, captures: Collection[str]) -> set[str]:
        """Returns the captures that have files in the store, or will have them soon."""
        query, found = sa.select(capture_files.c.capture_id).distinct(), set[str]()
        with self._engine.connect() as connection:
            for some in portions(captures):
                found |= {*connection.scalars(query.where(capture_files.c.capture_id.in_(some)))}
        return found

    def _claim(self, capture: str, inputs: Mapping[str, str], size: Callable[[str], int]) -> dict[str, Blob]:
        """Registers the files of a capture, and marks as dead the blobs that only this capture had. Locks rows in the
        order of their names, so that two services do not deadlock."""
        mine = sa.select(capture_files.c.blob_id).where(capture_files.c.capture_id == capture)
        alike = sa.and_(blobs.c.sha256.in_(set(inputs.values())), ~blobs.c.dead)
        query = sa.select(blobs).where(sa.or_(blobs.c.id.in_(mine), alike)).order_by(blobs.c.id).with_for_update()
        with self._engine.begin() as connection:
            if connection.dialect.name == "sqlite":  # where a transaction begins, and locks, with the first change
                connection.execute(sa.update(blobs).where(sa.false()).values(dead=True))
            rows = connection.execute(query).all()
            usable = {row.sha256: Blob(row.id, row.sha256, row.bytes, row.stored) for row in rows if not row.dead}
            for name, sha256 in inputs.items():
                if sha256 not in usable:
                    usable[sha256] = Blob(f"{sha256}-{secrets.token_hex(8)}", sha256, size(name))
                    blob = usable[sha256]
                    connection.execute(
                        sa.insert(blobs).values(id=blob.id, sha256=sha256, bytes=blob.bytes, stored=False, dead=False)
                    )
            connection.execute(sa.delete(capture_files).where(capture_files.c.capture_id == capture))
            for name, sha256 in inputs.items():
                row = {"capture_id": capture, "name": name, "blob_id": usable[sha256].id, "arrived": False}
                connection.execute(sa.insert(capture_files).values(row))
            used = sa.exists().where(capture_files.c.blob_id == blobs.c.id)
            ids = [row.id for row in rows]
            connection.execute(sa.update(blobs).where(blobs.c.id.in_(ids), ~used).values(dead=True))
        return {name: usable[sha256] for name, sha256 in inputs.items()}

    def _take_back(self, sent: Collection[str]) -> None:
        """Removes the sent files of a capture that was removed meanwhile."""
        with self._engine.connect() as connection:
            alive = {*connection.scalars(sa.select(blobs.c.id).where(blobs.c.id.in_(sent), ~blobs.c.dead))}
        for blob in sent:
            if blob not in alive:
                self.objects.erase(f"{blob}/")

    def _fetch(self, blob: Blob, path: Path, admit: Admission) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
        part = Path(name)
        try:
            os.close(handle)
            self.objects.fetch(blob.key, part, blob.sha256, admit)
            part.chmod(0o644)
            part.replace(path)
        except ObjectMissing as error:
            raise Conflict("capture-missing", compose("capture-missing")) from error
        finally:
            part.unlink(missing_ok=True)


def open_capture_blobs(settings: ServiceSettings, engine: sa.Engine) -> CaptureBlobs | None:
    """Opens the store of captures that the settings name; returns None if there is none."""
    place = settings.captures_store
    return None if place is None else CaptureBlobs(WatchedObjects(open_objects(place, settings)), engine)


def _is_there(path: Path, sha256: str) -> bool:
    """Returns whether a file exists. Small files are also compared by content, because they may be replaced."""
    with suppress(FileNotFoundError, NotADirectoryError):
        return path.stat().st_size > SMALL_BYTES or sha256_of(path) == sha256
    return False
