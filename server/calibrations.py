"""Calibrations: an archive of board pictures goes in, a durable job makes a rig of them, and one is put to use.

<data>/calibrations/<id>/record.json  board.toml  images/<camera>/<shot>.<ext>  result/cameras.json  calibration.json
"""

import hashlib
import json
import os
import shutil
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from dbos import DBOSClient, EnqueueOptions, WorkflowStatus

from rig.archive import ArchiveLimits, extract_archive
from rig.capture import capture_root
from rig.errors import InputError
from rig.files import write_atomically
from server.child import Bench, Report
from server.jobs import APPLICATION_VERSION, FINISHED, STATES, failure
from server.problems import Problem, not_found
from server.store import Store, is_id, move_durably, new_id

WORKFLOW = "calibrate"
FORMAT = "eigenhead-calibration/1"


class Calibrations:
    """The calibrations of a service. Methods block."""

    def __init__(self, store: Store, client: DBOSClient, queue: str) -> None:
        self._store, self._client, self._queue = store, client, queue

    def add(self, folder: Path, source: str, label: str) -> dict[str, Any]:
        """Accepts ``folder`` (board.toml and images/) and queues the work."""
        identity = new_id()
        cameras = {path.name: len(list(path.iterdir())) for path in sorted((folder / "images").iterdir())}
        record = {
            "format": FORMAT,
            "id": identity,
            "created": datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "source": source,
            "label": label,
            "pictures": cameras,
        }
        write_atomically(folder / "record.json", json.dumps(record, indent=1).encode())
        move_durably(folder, self._store.folder("calibrations", identity))
        self._client.enqueue(self._options(identity), identity)
        return self.get(identity)

    def get(self, identity: str) -> dict[str, Any]:
        """Raises a 404 problem."""
        if not is_id(identity):
            raise not_found("calibration", identity)
        folder = self._store.folder("calibrations", identity)
        try:
            record = json.loads((folder / "record.json").read_bytes())
        except (OSError, ValueError) as error:
            raise not_found("calibration", identity) from error
        row = self._row(identity)
        state = STATES[row.status] if row else "queued"
        if row is None:  # the service was killed between accepting and queueing
            self._client.enqueue(self._options(identity), identity)
        result = (row.output or {}) if row is not None and state == "succeeded" else {}
        return {
            **{key: record[key] for key in ("id", "created", "source", "label", "pictures")},
            "state": state,
            "error": failure(row) if row is not None and state == "failed" else None,
            "figures": result.get("figures", {}),
            "checks": result.get("checks", []),
            "warnings": result.get("warnings", []),
            "front": result.get("front"),
            "in_use": state == "succeeded" and self.in_use() == result.get("sha256"),
        }

    def find(self) -> list[dict[str, Any]]:
        """Newest first."""
        return [self.get(identity) for identity in self._store.ids("calibrations")]

    def cameras_json(self, identity: str) -> Path:
        """Raises a 404 or 409 problem."""
        return self.result(identity, "cameras.json")

    def result(self, identity: str, name: str) -> Path:
        """A file of a calibration that succeeded. Raises a 404 or 409 problem."""
        state = self.get(identity)["state"]
        if state != "succeeded":
            raise Problem(409, "no-result", f"The calibration is {state}; it has no result.")
        return self._store.folder("calibrations", identity) / "result" / name

    def remove(self, identity: str) -> None:
        if self.get(identity)["state"] not in FINISHED:
            raise Problem(409, "calibration-active", "The calibration is under way; wait for its end.")
        self._store.remove(self._store.folder("calibrations", identity))
        self._client.delete_workflow(identity)

    def in_use(self) -> str | None:
        """sha256 of the calibration in use."""
        path = self._store.data / "rig" / "in_use"
        return path.read_text() if path.is_file() else None

    def mark_in_use(self, identity: str) -> None:
        digest = hashlib.sha256(self.cameras_json(identity).read_bytes()).hexdigest()
        write_atomically(self._store.data / "rig" / "in_use", digest.encode())

    def _row(self, identity: str) -> WorkflowStatus | None:
        rows = self._client.list_workflows(workflow_ids=[identity], name=WORKFLOW)
        return rows[0] if rows else None

    def _options(self, identity: str) -> EnqueueOptions:
        return {
            "workflow_name": WORKFLOW,
            "queue_name": self._queue,
            "workflow_id": identity,
            "app_version": APPLICATION_VERSION,
            "priority": 1,
        }


def ingest(bench: Bench, report: Report, *, archive: str, folder: str, limits: dict[str, Any]) -> None:
    """Runs in a child: unpacks board.toml and IMAGES/ into ``folder`` and looks at both. Raises InputError."""
    from calibration.board import read_board
    from calibration.detection import list_pictures

    target = Path(folder)
    unpacked = target.with_name(target.name + ".unpacked")
    extract_archive(Path(archive), unpacked, ArchiveLimits(**limits))
    root = capture_root(unpacked)
    if not (root / "board.toml").is_file():
        raise InputError("archive", ["holds no board.toml beside IMAGES/"])
    read_board(root / "board.toml")
    pictures = next((root / name for name in ("IMAGES", "images") if (root / name).is_dir()), root)
    for camera, shots in list_pictures(pictures).items():
        (target / "images" / camera).mkdir(parents=True)
        for path in shots.values():
            path.rename(target / "images" / camera / path.name)
    (root / "board.toml").rename(target / "board.toml")
    shutil.rmtree(unpacked)


def from_captures(store: Store, folder: Path, board: dict[str, Any], captures: list[str]) -> None:
    """Makes the pictures of the named captures into ``folder``: one shot each. Raises problems and InputError."""
    from calibration.board import board_from_document, write_board

    described = board_from_document(board)
    for number, identity in enumerate(captures):
        record = store.capture(identity)
        files = store.folder("captures", identity) / "files"
        for name in record["inputs"]:
            if Path(name).parent.name == "images":
                target = folder / "images" / Path(name).stem / f"shot{number:03}{Path(name).suffix}"
                target.parent.mkdir(parents=True, exist_ok=True)
                os.link(files / name, target)
    write_board(described, folder / "board.toml")


def calibrate_folder(
    bench: Bench, report: Report, *, folder: str, result: str, previous: str | None, cache: str, front: str | None
) -> dict[str, Any]:
    """Runs in a worker's child: ``calibrate()`` and its files; returns what the record shows."""
    from calibration.board import read_board
    from calibration.calibrate import CalibrationRefused, calibrate, write_calibration
    from calibration.report import write_report
    from rig.layout import read_rig

    known = None if previous is None else read_rig(Path(previous))
    try:
        found = calibrate(
            Path(folder) / "images",
            read_board(Path(folder) / "board.toml"),
            front=front,
            previous=known,
            cache=Path(cache),
            report=report,
        )
    except CalibrationRefused as error:
        raise InputError("calibration", error.reasons) from error
    document = found.document()
    write_report(found, Path(result) / "report.html")
    write_calibration(found, Path(result) / "cameras.json")
    write_atomically(Path(result) / "calibration.json", json.dumps(document, indent=1).encode())
    digest = hashlib.sha256((Path(result) / "cameras.json").read_bytes()).hexdigest()
    return {key: document[key] for key in ("figures", "checks", "warnings", "front")} | {"sha256": digest}
