"""Implements calibrations: pictures of a board or of a scene are stored, a durable job estimates the rig from them, and
one of the results is selected for use.

<data>/calibrations/<id>/record.json  board.toml  images/<camera>/<shot>.<ext>  result/cameras.json  calibration.json

The pictures of a scene have no board.toml, but may have scale.json. A scene's pictures may show a person, so they are
removed once the job has ended.
"""

import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path

from dbos import DBOSClient, WorkflowStatus

from rig.errors import InputError
from rig.files import sha256_of, write_atomically
from rig.messages.message import Message, compose, read_message
from server.errors import Conflict, NotFound
from server.services.failures import failure
from server.services.job_rows import FINISHED, STATES, enqueue_options
from server.services.records import CalibrationOut, moment_now
from server.services.texts import check_texts
from server.storage.events import EventLog
from server.storage.folders import move_durably
from server.storage.records import CALIBRATION, CalibrationRecord, EventDocument, JsonObject
from server.storage.store import Store, StoredFile, new_id
from server.tasks.calibrate import BOARD, check_scale, is_of_board
from server.tasks.photographs import SCALE

WORKFLOW = "calibrate"


class Calibrations:
    """Manages the calibrations of a service. Methods block, so call them from a thread."""

    def __init__(self, store: Store, client: DBOSClient, queue: str, events: EventLog) -> None:
        self._store, self._client, self._queue, self._events = store, client, queue, events

    def add(self, folder: Path, source: str, label: str) -> CalibrationOut:
        """Moves ``folder`` to its final place in the data folder and queues its calibration. ``folder`` contains
        images/, and board.toml if the images show a board; ``source`` is the images' origin ("upload", "rig"). If the
        process is killed before the job is queued, ``get`` queues the job. Raises InputError for an invalid label."""
        check_texts({"label": label})
        identity = new_id()
        cameras = {path.name: len(list(path.iterdir())) for path in sorted((folder / "images").iterdir())}
        kind = "board" if is_of_board(folder) else "scene"
        record = CALIBRATION.document(CalibrationRecord(identity, moment_now(), source, label, cameras, kind))
        write_atomically(folder / "record.json", json.dumps(record, indent=1).encode())
        move_durably(folder, self._store.folder("calibrations", identity))
        self._enqueue(identity)
        return self.get(identity)

    def add_shots(
        self,
        board: Mapping[str, object] | None,
        captures: list[str],
        label: str,
        scale: Mapping[str, object] | None = None,
    ) -> CalibrationOut:
        """Queues a calibration from captures. ``board``: the content of a ``board.toml``, None for captures of any
        scene; ``scale``: the content of a scene's ``scale.json``. Raises NotFound for an unknown capture, and
        InputError for a wrong board or scale, or captures without images."""
        from calibration.board.board import board_from_document, write_board

        described = None if board is None else board_from_document(board)
        with self._store.incoming() as folder:
            target = folder / "calibration"
            target.mkdir()
            link_shots(self._store, target, captures)
            if described is not None:
                write_board(described, target / BOARD)
            if scale is not None:
                write_atomically(target / SCALE, json.dumps(scale).encode())
            check_scale(target)
            return self.add(target, "rig", label)

    def get(self, identity: str) -> CalibrationOut:
        """Returns a calibration with its progress or its outcome. Queues the calibration's job if the service was
        killed before it queued one. Raises NotFound."""
        record = self._store.calibration(identity)
        row = self._row(identity)
        state = STATES[row.status] if row else "queued"
        if row is None:  # the service was killed between accepting and queueing
            self._enqueue(identity)
        outcome: JsonObject = (row.output or {}) if row is not None and state == "succeeded" else {}
        latest = self._events.latest([identity]).get(identity) if state == "running" else None
        document: EventDocument = {} if latest is None else latest.document
        return CalibrationOut(
            **asdict(record),
            state=state,
            stage=document.get("stage"),
            progress=1.0 if state == "succeeded" else document.get("progress", 0.0),
            eta_s=document.get("eta_s"),
            error=failure(row) if row is not None and state == "failed" else None,
            verdict=outcome.get("verdict"),
            missing=_messages(outcome.get("missing_messages") or outcome.get("missing", [])),
            figures=outcome.get("figures", {}),
            checks=tuple(outcome.get("checks", ())),
            warnings=_messages(outcome.get("warning_messages") or outcome.get("warnings", [])),
            front=outcome.get("front"),
            in_use=self.in_use() == outcome.get("sha256", ""),
        )

    def find(self) -> list[CalibrationOut]:
        """Returns all calibrations, newest first."""
        found = []
        for identity in self._store.ids("calibrations"):
            with suppress(NotFound):  # removed since they were listed, or damaged
                found.append(self.get(identity))
        return found

    def result(self, identity: str, name: str) -> Path:
        """Returns the path of a file in the result folder of a calibration. Raises NotFound, and Conflict if the
        calibration has not succeeded."""
        state = self.get(identity).state
        if state != "succeeded":
            raise Conflict("no-result", compose("calibration-without-result", state=state))
        return self._store.folder("calibrations", identity) / "result" / name

    def file(self, identity: str, name: str) -> StoredFile:
        """Returns a file in the result folder of a calibration, with its SHA-256. Raises NotFound, and Conflict if the
        calibration has not succeeded."""
        path = self.result(identity, name)
        return StoredFile(path, sha256_of(path))

    def remove(self, identity: str) -> None:
        """Removes a calibration, its pictures and its result. A rig that uses the calibration keeps its own copy of
        cameras.json. Raises NotFound, and Conflict while the calibration's job is queued or runs."""
        if self.get(identity).state not in FINISHED:
            raise Conflict("calibration-active", compose("calibration-active"))
        self._store.remove(self._store.folder("calibrations", identity))
        self._events.remove([identity])
        self._client.delete_workflow(identity)

    def check_usable(self, identity: str) -> None:
        """Raises Conflict with the reasons for a calibration whose verdict is poor, and NotFound for an unknown one."""
        found = self.get(identity)
        if found.verdict == "poor":
            detail = compose("calibration-poor")
            raise Conflict("calibration-poor", detail, found.missing)

    def in_use(self) -> str | None:
        """Returns the SHA-256 of the cameras.json of the calibration in use; None if none was selected."""
        path = self._store.data / "rig" / "in_use"
        return path.read_text() if path.is_file() else None

    def mark_in_use(self, identity: str) -> None:
        """Records, in one atomic write, that the rig uses this calibration. Raises NotFound, and Conflict if the
        calibration has not succeeded."""
        digest = sha256_of(self.result(identity, "cameras.json"))
        write_atomically(self._store.data / "rig" / "in_use", digest.encode())

    def _enqueue(self, identity: str) -> None:
        options = enqueue_options(WORKFLOW, self._queue, identity)
        options["priority"] = 1
        self._client.enqueue(options, identity)

    def _row(self, identity: str) -> WorkflowStatus | None:
        rows = self._client.list_workflows(workflow_ids=[identity], name=WORKFLOW)
        return rows[0] if rows else None


def link_shots(store: Store, folder: Path, captures: list[str]) -> None:
    """Links the images of the captures to ``folder/images/<camera>/`` (hard links), each capture as one shot. Raises
    NotFound for an unknown capture, and InputError if none of them has images."""
    for number, identity in enumerate(captures):
        record = store.capture(identity)
        files = store.capture_files(identity)
        for name in record.inputs:
            if Path(name).parent.name == "images":
                target = folder / "images" / Path(name).stem / f"shot{number:03}{Path(name).suffix}"
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(files / name, target)
    if not (folder / "images").is_dir():
        raise InputError("captures", [compose("captures-without-images")])


def _messages(kept: Iterable[object]) -> tuple[Message, ...]:
    """Reads messages, which earlier versions stored as texts."""
    return tuple(read_message(one) for one in kept)
