"""Composes the parts of one service process, which HTTP's routes and the operator's pages share."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sa

from rig.errors import InputError
from rig.messages.message import compose
from server.errors import Conflict
from server.metrics import Metrics
from server.services.answer import Answer, Said, as_data
from server.services.batches import Batches
from server.services.calibrations import Calibrations
from server.services.captures import Captures
from server.services.deliveries import UNDER_WAY, destination, enqueue_delivery
from server.services.jobs import Jobs, migrate
from server.services.keys import Keys
from server.services.live.live import Live
from server.services.records import CalibrationOut, JobOut, RigOut
from server.services.rigs import RealRig, RigBackend, SimulatedRig
from server.services.sessions import Sessions
from server.services.storage_use import StorageCount
from server.services.threads import Threads
from server.services.uploads import ResumableUploads
from server.services.webhooks import Webhooks
from server.services.work import ReconstructionRequest
from server.settings import ServiceSettings
from server.storage.capture_blobs import open_capture_blobs
from server.storage.database import open_database
from server.storage.library import Library
from server.storage.store import Store
from server.tasks.calibrate import ingest_pictures
from server.tasks.child import ChildProcessPool, WorkFailed
from server.tasks.export_archive import export_archive


class CheckOut(Answer):
    """Holds one check of the service: whether it passed and, if not, the remedy. ``starting``: the check will soon pass
    without intervention."""

    ok: bool
    detail: Said
    detail_message = as_data("detail")
    starting: bool = False


@dataclass(frozen=True, slots=True)
class Service:
    """Holds the parts of one service process. ``known`` caches slow findings, by name."""

    settings: ServiceSettings
    store: Store
    engine: sa.Engine
    jobs: Jobs
    batches: Batches
    keys: Keys
    webhooks: Webhooks
    uploads: ResumableUploads
    threads: Threads
    children: ChildProcessPool
    rig: RigBackend
    live: Live
    captures: Captures
    sessions: Sessions
    calibrations: Calibrations
    storage: StorageCount
    metrics: Metrics
    known: dict[str, CheckOut]  # findings that are made once

    def close(self) -> None:
        """Closes the rig, ends the child processes and closes all connections to the database."""
        self.live.close()
        self.rig.close()
        self.children.close()
        self.jobs.close()
        self.engine.dispose()

    def accept_pictures(self, source: str, archive: Path, folder: Path, label: str) -> CalibrationOut:
        """Unpacks an archive of pictures and queues a calibration, from IMAGES/ and board.toml or, if ``source`` is
        "scene", from photographs. ``folder`` is a folder of ``Store.incoming``. Raises InputError naming every fault,
        and DiskFull."""
        limits, target = self.captures.archive_limits(archive), folder / "calibration" / "pictures"
        target.mkdir(parents=True)
        with self.children.one() as child:
            child.remote(ingest_pictures)(
                archive=str(archive),
                folder=str(target),
                limits=limits,
                image_pixels=self.settings.image_pixels,
                scene=source == "scene",
            )
        return self.calibrations.add(target, "upload", label)

    def use_calibration(self, identity: str, *, poor: bool = False) -> RigOut:
        """Uses a calibration for every later capture and returns the rig's state. Raises NotFound, and Conflict if the
        calibration has not succeeded, is of other cameras, or has the verdict poor and ``poor`` does not allow that."""
        if not poor:
            self.calibrations.check_usable(identity)
        self.rig.use(self.calibrations.result(identity, "cameras.json"))
        self.calibrations.mark_in_use(identity)
        return self.rig.describe()

    def cancel(self, job_id: str) -> JobOut:
        """Cancels a job and queues webhook messages about it. A finished job stays as it is. Raises NotFound."""
        job, did = self.jobs.cancel(job_id)
        if did:
            webhook = (self.jobs.request(job_id) or {}).get("webhook")
            self.webhooks.announce(job_id, "cancelled", self.jobs.client.enqueue, job_webhook=webhook)
        return job

    def deliver(self, job_id: str, to: str | None = None) -> JobOut:
        """Delivers the result of a job to a location in an object store, by default the job's own destination. Raises
        NotFound, InputError without a location, InvalidInput for a forbidden location, and Conflict if the job has no
        result or the delivery runs."""
        self.jobs.files(job_id)
        request = self.jobs.request(job_id) or {}
        if (place := to or request.get("deliver_to")) is None:
            raise InputError("to", [compose("delivery-place-missing")])
        place = destination(place, self.settings)
        begun = self.jobs.deliveries.of([job_id]).get(job_id)
        if begun is not None and begun.state in UNDER_WAY:
            raise Conflict("delivery-active", compose("delivery-active"))
        self.jobs.deliveries.forget(job_id)
        enqueue_delivery(self.jobs.client.enqueue, job_id, place, self.settings, request.get("webhook"))
        return self.jobs.get(job_id)

    def export(self, job_id: str, outputs: Mapping[str, object]) -> bytes:
        """Returns a .zip with the files of a finished head that the settings ``outputs`` name. Raises NotFound,
        Conflict for a job without result or of a film, InputError for settings that are not allowed, and DiskFull."""
        folder, job = self.jobs.result_folder(job_id), self.jobs.get(job_id)
        if job.frames:
            raise Conflict("film-capture", compose("film-export"))
        ReconstructionRequest(job.model, {"outputs": outputs}).check()
        with self.store.incoming() as scratch, self.children.one() as child:
            archive = scratch / "export.zip"
            try:
                child.remote(export_archive)(result=str(folder), archive=str(archive), outputs=outputs)
            except (InputError, WorkFailed):
                self.jobs.files(job_id)  # erased while it was read
                raise
            return archive.read_bytes()


def open_service(settings: ServiceSettings, metrics: Metrics) -> Service:
    """Opens the data folder, the database and the rig's description, brings the database's index up to date and returns
    the parts. Raises InputError for a wrong rig.toml, and DatabaseUnavailable."""
    engine = open_database(settings)
    library = Library(engine)
    store = Store(settings.data, library, open_capture_blobs(settings, engine), settings.free_bytes)
    library.reconcile(store.changes, store.found)
    migrate(settings)
    jobs, rig = Jobs(settings, store, engine, library), open_rig(settings)
    webhooks = Webhooks(engine, settings.webhook_origins)
    children = ChildProcessPool(settings.checks_at_once, niceness=3, memory=settings.check_bytes)
    return Service(
        settings=settings,
        store=store,
        engine=engine,
        jobs=jobs,
        batches=Batches(settings, engine, store, jobs, library, webhooks),
        captures=Captures(store, jobs, rig, children, settings, library),
        sessions=Sessions(store, jobs, library),
        calibrations=Calibrations(store, jobs.client, settings.queue, jobs.events),
        storage=StorageCount(store, jobs, settings),
        keys=Keys(engine),
        webhooks=webhooks,
        uploads=ResumableUploads(store, settings),
        threads=Threads(checks=settings.checks_at_once, check_s=settings.check_s),
        children=children,
        rig=rig,
        live=Live(rig, settings.rig),
        metrics=metrics,
        known={},
    )


def open_rig(settings: ServiceSettings) -> RigBackend:
    """Returns the simulated studio, or the real rig if the settings name a rig.toml. No camera is opened yet. Raises
    InputError naming every fault of rig.toml."""
    calibration = settings.data / "rig" / "cameras.json"
    return SimulatedRig(calibration) if settings.rig is None else RealRig(settings.rig, calibration)
