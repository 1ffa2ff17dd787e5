"""Manages the output folder of a batch: results by name, each complete or absent, and records of unfinished work.

``NAME/``         a result as ``eigenhead reconstruct`` writes it, and batch.json: what it was made from
heads.csv heads.parquet sheet.html sheet.pdf
.batch/           K-of-N.lock (a share at work), attempts/K-of-N.* (a result in the making), failures/: gone when
                  nothing is at work and none failed
"""

import fcntl
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any

from rig.errors import EigenheadError
from rig.files import write_atomically
from rig.messages.message import Message, compose, documents_of, read_message
from server.batch.captures import Shard
from server.storage.result_folder import RESULT_FILE

RECORD = "batch.json"
RECORD_FORMAT, FAILURE_FORMAT = "eigenhead-batch-result/1", "eigenhead-batch-failure/1"
REPORT = "report.json"
FOUND_FILES = ("cameras.json", "calibration.json", "calibration.html", "masks")  # kept for captures without cameras


class ForeignFiles(EigenheadError):
    """Reports that the folder of a result holds files of no result, so the folder must not be replaced."""

    def __init__(self, folder: Path, names: list[str]) -> None:
        super().__init__(compose("batch-foreign-files", folder=str(folder), names=names[:5]))


class ShareTaken(EigenheadError):
    """Reports that another process works on this part of the batch already."""

    def __init__(self, share: str) -> None:
        super().__init__(compose("batch-share-taken", share=share))


@dataclass(frozen=True, slots=True)
class Origin:
    """Holds the origin of a result: the SHA-256 of the capture's files, of the settings and of the model, and the
    program's version. A result is not made again if only ``version`` differs."""

    input_sha256: str
    settings_sha256: str
    model_sha256: str
    version: str

    def is_of(self, other: "Origin") -> bool:
        """Returns whether two results were made from the same input, settings and model, whatever the version."""
        return replace(self, version=other.version) == other


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """Holds the reason for which the latest attempt at a capture failed."""

    kind: str
    message: Message
    faults: tuple[Message, ...]
    origin: Origin | None
    trace: str = ""  # stack trace of a bug in this program


class BatchFolder:
    """Manages the paths and records of the folder ``out`` that a batch fills. One process works on a part of the batch
    at a time."""

    def __init__(self, out: Path) -> None:
        self.out = out
        self.work = out / ".batch"
        self.attempts = self.work / "attempts"

    @contextmanager
    def share(self, shard: Shard) -> Iterator[None]:
        """Locks a part of the batch during the block, and removes the attempts and empty folders of processes that have
        ended. Raises ShareTaken if another process has the lock."""
        try:
            with self._lock(_lock_name(shard), wait=False) as held:
                if not held:
                    raise ShareTaken(str(shard))
                for path in self.attempts.glob(f"{_lock_name(shard)}.*"):
                    shutil.rmtree(path, ignore_errors=True)
                yield
        finally:
            self._tidy()

    def _tidy(self) -> None:
        """Removes the temporary folders of attempts that no running process owns, and empty folders."""
        alive = set[str]()
        for lock in self.work.glob("*.lock"):
            with self._lock(lock.stem, wait=False) as free:
                alive |= set() if free else {lock.stem}
        for path in self.attempts.glob("*"):
            if path.name.partition(".")[0] not in alive:
                shutil.rmtree(path, ignore_errors=True)
        for folder in (self.attempts, self.work / "failures", self.work):
            with suppress(OSError):
                folder.rmdir()

    @contextmanager
    def table(self) -> Iterator[None]:
        """Locks the table for writing during the block. Waits until no other process holds the lock."""
        with self._lock("table", wait=True):
            yield

    @contextmanager
    def _lock(self, name: str, *, wait: bool) -> Iterator[bool]:
        """Locks a file in ``.batch`` during the block and then removes it; the kernel releases the lock if the process
        dies, on NFS too. Yields whether this process has the lock."""
        path = self.work / f"{name}.lock"
        file = _locked(path, wait=wait)
        try:
            yield file is not None
        finally:
            if file is not None:
                path.unlink(missing_ok=True)
                file.close()

    def result(self, name: str) -> Path:
        """Returns the folder of a capture's result."""
        return self.out / name

    def origin(self, name: str) -> Origin | None:
        """Reads what a result was made from. Returns None if there is no complete result."""
        folder = self.result(name)
        with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
            record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
            files: Mapping[str, int] = record["files"]
            whole = record["format"] == RECORD_FORMAT and (folder / REPORT).is_file()
            if whole and all((folder / file).stat().st_size == size for file, size in files.items()):
                return Origin(**{key: record[key] for key in Origin.__dataclass_fields__})
        return None

    def report(self, name: str) -> dict[str, Any]:
        """Reads the report.json of a result. Raises OSError and ValueError."""
        return json.loads((self.result(name) / REPORT).read_text(encoding="utf-8"))

    def new_attempt(self, shard: Shard) -> Path:
        """Makes a temporary folder for one attempt at a result, with the empty folders ``result`` and ``scratch`` in
        it."""
        attempt = self.attempts / f"{_lock_name(shard)}.{secrets.token_hex(4)}"
        for part in ("result", "scratch"):
            (attempt / part).mkdir(parents=True)
        return attempt

    def publish(self, name: str, attempt: Path, origin: Origin) -> None:
        """Renames the finished result of an attempt to its final place, replacing an earlier result of that name, and
        removes the failure record.

        Raises ForeignFiles, and OSError if a process that divides the batch otherwise has just published that result.
        """
        complete, target = attempt / "result", self.result(name)
        self.check_replaceable(name)
        sizes = {path.relative_to(complete).as_posix(): path.stat().st_size for path in _files(complete)}
        sizes.pop(REPORT, None)  # it contains durations, so its size varies
        document = {"format": RECORD_FORMAT, "capture": name, **asdict(origin), "files": dict(sorted(sizes.items()))}
        write_atomically(complete / RECORD, json.dumps(document, indent=1).encode())
        target.parent.mkdir(parents=True, exist_ok=True)
        if target.exists():
            target.rename(attempt / "replaced")
        complete.rename(target)  # fails if a folder with files exists there
        self.failure_file(name).unlink(missing_ok=True)

    def check_replaceable(self, name: str) -> None:
        """Raises ForeignFiles if the folder of a result holds files that are no part of a result."""
        try:
            entries = sorted(path.name for path in self.result(name).iterdir())
        except FileNotFoundError:
            return
        if foreign := [entry for entry in entries if entry not in FOUND_FILES and not RESULT_FILE.match(entry)]:
            raise ForeignFiles(self.result(name), foreign)

    def failure(self, name: str) -> FailureRecord | None:
        """Reads why the latest attempt at a capture failed. Returns None if no failure is recorded."""
        with suppress(OSError, ValueError, KeyError, TypeError):
            record = json.loads(self.failure_file(name).read_text(encoding="utf-8"))
            origin = None if record["origin"] is None else Origin(**record["origin"])
            message, faults = read_message(record["message"]), tuple(map(read_message, record["faults"]))
            return FailureRecord(record["kind"], message, faults, origin, record["trace"])
        return None

    def note_failure(self, name: str, failure: FailureRecord) -> None:
        """Writes why the latest attempt at a capture failed, replacing an earlier record atomically. Raises OSError."""
        document = {
            "format": FAILURE_FORMAT,
            "capture": name,
            "kind": failure.kind,
            "message": failure.message.document(),
            "faults": documents_of(failure.faults),
            "origin": None if failure.origin is None else asdict(failure.origin),
            "trace": failure.trace,
        }
        write_atomically(self.failure_file(name), json.dumps(document, indent=1).encode())

    def failure_file(self, name: str) -> Path:
        """Returns the path of a capture's failure record."""
        return self.work / "failures" / f"{file_name(name)}.json"

    def forget_failures_but_of(self, names: set[str]) -> None:
        """Removes the failure records of all captures that are not in ``names``, and incomplete files of killed
        processes."""
        retained = {self.failure_file(name).name for name in names}
        with suppress(FileNotFoundError):
            for path in (self.work / "failures").iterdir():
                if path.name not in retained:
                    path.unlink(missing_ok=True)


def _locked(path: Path, *, wait: bool) -> IO[bytes] | None:
    """Opens and locks a file, which the owner of the lock may remove. Returns None if another process has the lock."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileNotFoundError):  # another process has just removed the empty folder, or the file
            file = path.open("ab")
            try:
                fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
                if path.stat().st_ino == os.fstat(file.fileno()).st_ino:
                    return file
            except BlockingIOError:
                file.close()
                return None
            file.close()


def _lock_name(shard: Shard) -> str:
    return f"{shard.number}-of-{shard.count}"


def file_name(name: str) -> str:
    """Returns a readable file name for the name of a capture. Different names give different file names."""
    readable = re.sub(r"[^\w-]+", "-", name)[:60]
    return f"{readable}.{hashlib.sha256(name.encode('utf-8', 'surrogateescape')).hexdigest()[:16]}"


def _files(folder: Path) -> Iterator[Path]:
    return (path for path in sorted(folder.rglob("*")) if path.is_file())
