"""Decides, by files alone, which process works on what. A claim is a symbolic link of the claimed name to its owner's
file.

Making a link is atomic and fails if one exists, on local disks as on NFS and Lustre, where ``flock`` may not reach
other machines. The link also names its owner. An owner is one process. It touches its file every ``BEAT_S`` seconds. It
loses its claims if the file is untouched for ``HEARTBEAT_TIMEOUT_S`` seconds, if its process is gone (on the same
machine), or if the file is gone.

A lost claim is removed by one process only: the one that first claims the removal (a claim named by the claim and the
loser's token). So a newer claim is never removed by mistake. A process that was suspended for longer than
``HEARTBEAT_TIMEOUT_S`` and continues asks ``Claims.holds`` before it publishes a result.
"""

import json
import os
import secrets
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from server.processes import process_identity, process_started

BEAT_S = 10.0
HEARTBEAT_TIMEOUT_S = 180.0  # NFS tells of a touch up to 60 s late (acregmax of nfs(5)); then a beat, and as much again
SUFFIX = ".json"


class Claims:
    """Takes and releases claims for this process, so that no two processes work on the same thing. ``folder`` is shared
    by all processes of a batch. Thread-safe."""

    def __init__(self, folder: Path, *, silent_s: float = HEARTBEAT_TIMEOUT_S) -> None:
        self.token = secrets.token_hex(8)
        self._folder, self._silent_s = folder, silent_s
        self._machine, self._host, self._pid, self._started = process_identity()
        self._owner = self._owners / f"{self.token}{SUFFIX}"
        self._ended = threading.Event()

    @contextmanager
    def beating(self) -> Iterator[None]:
        """Writes this process's owner file and touches it regularly while the block runs. Claims can be taken only
        inside it; they end with it."""
        self._show()
        beat = threading.Thread(target=self._beat, name="claims", daemon=True)
        beat.start()
        try:
            yield
        finally:
            self._ended.set()
            beat.join()
            self._owner.unlink(missing_ok=True)

    def take(self, name: str) -> bool:
        """Claims a name and returns whether that succeeded. It fails if another live process holds the name."""
        return self._take(self._folder / name)

    def holds(self, name: str) -> bool:
        """Returns whether this process still holds the claim on a name."""
        return _holder(self._folder / name) == self.token

    def release(self, name: str) -> None:
        """Releases this process's claim on a name. Does nothing if another process holds it by now."""
        if self.holds(name):
            (self._folder / name).unlink(missing_ok=True)

    def is_alive(self, token: str) -> bool:
        """Returns whether the process with this token may still be at work. Raises nothing: if the file server does not
        answer, it counts as alive."""
        if token == self.token:
            return True
        path = self._owners / f"{token}{SUFFIX}"
        try:
            seen, owner = path.stat().st_mtime, json.loads(path.read_text(encoding="utf-8"))
            here, pid, started = owner["machine"] == self._machine, owner["pid"], owner["started"]
        except (OSError, ValueError, KeyError, TypeError):
            return False
        if here and process_started(pid) != started:
            return False
        with suppress(OSError):
            os.utime(self._owner)
            # Both times are the file server's, so clocks need not agree.
            return self._owner.stat().st_mtime - seen < self._silent_s
        return True

    def forget_dead(self) -> None:
        """Removes the claims and the owner files of dead processes."""
        for path in self._folder.iterdir():
            holder = _holder(path)
            if holder and not self.is_alive(holder) and self._take(path):
                path.unlink(missing_ok=True)
        for path in self._owners.glob(f"*{SUFFIX}"):
            if not self.is_alive(path.name.removesuffix(SUFFIX)):
                path.unlink(missing_ok=True)

    @property
    def _owners(self) -> Path:
        return self._folder / "owners"

    def _take(self, path: Path) -> bool:
        if self._link(path):
            return True
        holder = _holder(path)
        if holder is None:
            return self._link(path)
        if self.is_alive(holder):
            return False
        breaker = path.with_name(f"{path.name}~{holder}")
        if not self._take(breaker):
            return False
        try:
            if _holder(path) == holder:
                path.unlink(missing_ok=True)
        finally:
            breaker.unlink(missing_ok=True)
        return self._link(path)

    def _link(self, path: Path) -> bool:
        try:
            path.symlink_to(f"owners/{self.token}{SUFFIX}")
        except FileExistsError:
            return False
        return True

    def _show(self) -> None:
        """Writes the owner's file; somebody who leaves may take the empty folder away meanwhile."""
        owner = {"machine": self._machine, "host": self._host, "pid": self._pid, "started": self._started}
        while True:
            self._owners.mkdir(parents=True, exist_ok=True)
            with suppress(FileNotFoundError):
                part = self._owners / f"{self.token}.part"
                part.write_text(json.dumps(owner), encoding="utf-8")
                part.replace(self._owner)
                return

    def _beat(self) -> None:
        while not self._ended.wait(BEAT_S):
            try:
                os.utime(self._owner)
            except FileNotFoundError:  # others took this process for dead; its claims are lost, new ones are possible
                self._show()
            except OSError:  # the file server does not answer; the next beat tries again
                continue


def _holder(path: Path) -> str | None:
    """Returns the token of the process that has a claim; None if none has it."""
    try:
        return path.readlink().name.removesuffix(SUFFIX)
    except OSError:
        return None
