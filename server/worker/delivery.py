"""Delivers the result of a job to an object store, file by file, with its manifest last."""

import json
import tempfile
import threading
import time
from pathlib import Path
from typing import Literal, cast

import structlog
from dbos import DBOS, PortableWorkflowError

from rig.files import sha256_of
from rig.messages.message import compose
from server.errors import Refused
from server.services.deliveries import DELIVER, MANIFEST, MANIFEST_FORMAT, delivery_id, place_of
from server.services.failures import JobFailed, restore_failure
from server.services.job_rows import request_of
from server.services.results import Results
from server.services.webhooks import Webhooks
from server.settings import ServiceSettings
from server.storage.object_places import locate, open_objects
from server.storage.objects import ObjectStore, StoreDenied, StoreUnavailable
from server.storage.records import DeliveryRequest, FileEntry
from server.storage.store import Store, StoredFile
from server.worker.pauses import insist, pause

DELIVERIES_AT_ONCE = 4  # of one worker; they wait for the store, not for cores
FIRST_PAUSE_S, LONGEST_PAUSE_S = 1.0, 60.0  # between two tries where the store is away

log = structlog.get_logger()


class Deliverer:
    """Delivers results for one worker."""

    def __init__(
        self, settings: ServiceSettings, store: Store, webhooks: Webhooks, results: Results, stop: threading.Event
    ) -> None:
        self._settings, self._store, self._webhooks, self._results = settings, store, webhooks, results
        self._stop = stop

    def register(self) -> None:
        """Makes the workflow known to the job engine."""
        deliverer = self

        @DBOS.step(name="send")
        def send(wanted: DeliveryRequest) -> bool:
            return deliverer.deliver(wanted)

        @DBOS.workflow(name=DELIVER, max_recovery_attempts=self._settings.attempts)
        def deliver_result(wanted: DeliveryRequest) -> None:
            with structlog.contextvars.bound_contextvars(job=wanted["job_id"]):
                try:
                    if send(wanted):
                        deliverer.announce(wanted, "delivered")
                except (JobFailed, PortableWorkflowError) as error:
                    if (failed := restore_failure(error)) is None:
                        raise
                    log.warning("delivery failed", kind=failed.kind, detail=failed.detail.text)
                    deliverer.announce(wanted, "undelivered")
                    raise failed from error

        del deliver_result  # known to the engine by name

    def announce(self, wanted: DeliveryRequest, state: str) -> None:
        """Announces to the webhooks of the service and of the job whether its result was delivered."""
        hook, place = wanted.get("webhook"), place_of(wanted) if state == "delivered" else None
        enqueue = DBOS.enqueue_workflow_with_options
        insist(self._stop, lambda: self._webhooks.announce(wanted["job_id"], state, enqueue, hook, place))

    def deliver(self, wanted: DeliveryRequest) -> bool:
        """Delivers a job's result, and waits for a store that does not answer. Returns False if the job or its delivery
        was removed meanwhile. Raises JobFailed if the result cannot be delivered and once ``until`` has passed, and
        WorkerStopped."""
        pause_s, folder = FIRST_PAUSE_S, self._store.folder("jobs", wanted["job_id"])
        was_there = folder.exists()
        while True:
            try:
                delivered = self._try(wanted)
                if not was_there:  # a worker's own data folder: what was fetched for this lies in the store
                    self._store.remove(folder)
                return delivered
            except StoreUnavailable as error:
                if time.time() > wanted["until"]:
                    detail = compose("delivery-given-up", reason=error.detail)
                    raise JobFailed("delivery-failed", detail) from error
                log.warning("delivery waits for the store", reason=error.detail.text)
            except Refused as error:
                raise JobFailed(error.kind, error.detail, error.errors) from error
            pause(self._stop, pause_s)
            pause_s = min(2 * pause_s, LONGEST_PAUSE_S)

    def _try(self, wanted: DeliveryRequest) -> bool:
        job_id = wanted["job_id"]
        prefix, key = locate(place_of(wanted), self._settings.deliver_prefixes)
        objects = open_objects(prefix, self._settings)
        while (row := DBOS.get_workflow_status(job_id)) is not None and row.status in ("PENDING", "ENQUEUED"):
            pause(self._stop, self._settings.poll_s)  # the job is about to be noted as done
        if row is None or row.status != "SUCCESS":
            return self._take_back(objects, key)
        files = cast(dict[str, FileEntry], row.output)
        for name, file in files.items():
            if not self._wanted(job_id):
                return self._take_back(objects, key)
            self._put(objects, key, name, self._results.file(job_id, name, file))
        if not self._wanted(job_id):
            return self._take_back(objects, key)
        request = request_of(row)
        document = {"format": MANIFEST_FORMAT, "job_id": job_id, "capture_id": request and request["capture_id"]}
        with tempfile.TemporaryDirectory(dir=self._store.data / "incoming") as scratch:
            manifest = Path(scratch) / MANIFEST
            manifest.write_text(json.dumps(document | {"files": files}, indent=1), encoding="utf-8")
            objects.put(f"{key}{MANIFEST}", manifest, sha256_of(manifest))
        log.info("delivered", place=place_of(wanted), files=len(files))
        return True

    def _take_back(self, objects: ObjectStore, key: str) -> Literal[False]:
        """Removes the sent files of a result that is gone: nobody was told of it, and it shows a face. An earlier
        complete delivery stays."""
        try:
            if all(entry.key != f"{key}{MANIFEST}" for entry in objects.entries(key)):
                objects.erase(key)
        except StoreDenied as error:
            log.warning("an unfinished delivery stays", reason=error.detail.text)
        return False

    def _put(self, objects: ObjectStore, key: str, name: str, file: StoredFile) -> None:
        """Stores a file; raises JobFailed if its content has changed, since waiting for the store would not help."""
        try:
            if sha256_of(file.path) == file.sha256:
                return objects.put(f"{key}{name}", file.path, file.sha256)
        except FileNotFoundError:
            pass
        raise JobFailed("result-missing", compose("result-missing"))

    def _wanted(self, job_id: str) -> bool:
        row = DBOS.get_workflow_status(delivery_id(job_id))
        return row is not None and row.status == "PENDING"
