"""What the routes work with: the store, the jobs, the keys, the child processes, made once per process by
``create_app``."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import sqlalchemy as sa
from fastapi import Depends, Request

from server.access import Keys
from server.calibrations import Calibrations
from server.child import Children
from server.database import open_database
from server.jobs import Jobs, migrate
from server.rigs import RigBackend, open_rig
from server.settings import ServiceSettings
from server.store import Store, new_id
from server.uploads import ResumableUploads, Threads
from server.webhooks import Webhooks

if TYPE_CHECKING:
    from server.metrics import Metrics
    from server.schemas import Check


@dataclass(frozen=True, slots=True)
class Service:
    """The parts of one service process."""

    settings: ServiceSettings
    store: Store
    engine: sa.Engine
    jobs: Jobs
    keys: Keys
    webhooks: Webhooks
    uploads: ResumableUploads
    threads: Threads
    children: Children
    rig: RigBackend
    calibrations: Calibrations
    metrics: "Metrics"
    known: "dict[str, Check]"  # findings that are made once

    def close(self) -> None:
        self.rig.close()
        self.children.close()
        self.jobs.close()
        self.engine.dispose()

    def accept_archive(self, archive: Path, folder: Path, about: dict[str, Any]) -> dict[str, Any]:
        """Turns a received archive into a capture; ``folder`` is the incoming folder. Raises InputError. Blocks."""
        arguments = self.archive_arguments(archive, folder / "capture" / "files")
        arguments["image_pixels"] = self.settings.image_pixels
        (folder / "capture").mkdir()
        with self.children.one() as child:
            content = child.run("server.ingest:ingest_archive", arguments)
        return self.add_capture(folder / "capture", "upload", content, about)

    def accept_board_pictures(self, archive: Path, folder: Path, label: str) -> dict[str, Any]:
        """The same for a calibration: an archive of IMAGES/ and board.toml."""
        target = folder / "calibration" / "pictures"
        target.mkdir(parents=True)
        with self.children.one() as child:
            child.run("server.calibrations:ingest", self.archive_arguments(archive, target))
        return self.calibrations.add(target, "upload", label)

    def archive_arguments(self, archive: Path, folder: Path) -> dict[str, Any]:
        self.store.reserve(archive.stat().st_size, self.settings.free_bytes)
        s = self.settings
        limits = {"members": s.archive_members, "total_bytes": s.archive_bytes, "ratio": s.archive_ratio}
        return {"archive": str(archive), "folder": str(folder), "limits": limits}

    def add_capture(
        self,
        folder: Path,
        source: str,
        content: dict[str, Any],
        about: dict[str, Any],
        shot: dict[str, Any] | None = None,
    ) -> dict[str, Any]:
        if about.get("session") is not None:
            self.store.session(about["session"])
        record = {
            "id": new_id(),
            "created": datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z"),
            "source": source,
            "session": about.get("session"),
            "label": about.get("label") or "",
            "expression": about.get("expression") or "",
            **content,
            "features": "features.json" in content["inputs"],
            "shot": shot,
        }
        self.store.add_capture(folder, record)
        return record


def open_service(settings: ServiceSettings, metrics: "Metrics") -> Service:
    store = Store(settings.data)
    engine = open_database(settings)
    migrate(settings)
    jobs = Jobs(settings, store, engine)
    return Service(
        settings=settings,
        store=store,
        engine=engine,
        jobs=jobs,
        calibrations=Calibrations(store, jobs.client, settings.queue),
        keys=Keys(engine),
        webhooks=Webhooks(engine),
        uploads=ResumableUploads(store, settings),
        threads=Threads(checks=settings.checks_at_once),
        children=Children(settings.checks_at_once, niceness=3),
        rig=open_rig(settings),
        metrics=metrics,
        known={},
    )


def _service(request: Request) -> Service:
    return request.app.state.service


ServiceOf = Annotated[Service, Depends(_service)]
