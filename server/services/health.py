"""Checks whether the service can do its work, and states the remedy if it cannot."""

import os
import resource
import time
from collections import Counter
from importlib.metadata import version

import sqlalchemy as sa
import structlog
from prometheus_client import generate_latest
from pydantic import Field
from sqlalchemy.exc import SQLAlchemyError

from pipeline.settings import Settings, document_from_settings
from rig.formats.cameras.cameras_json import CAMERAS_LEAST, CAMERAS_MOST
from rig.messages.message import compose, verbatim
from server.errors import Refused
from server.services.answer import Answer, JobSettings
from server.services.service import CheckOut, Service
from server.storage.database import alive_workers, slots_by_queue
from server.storage.events import failure_counts
from server.storage.folders import STOPPED
from server.storage.job_index import Queued
from server.storage.watched_objects import WatchedObjects
from server.tasks.child import WorkFailed
from server.tasks.egl import try_egl

STORE_UNKNOWN = CheckOut(ok=True, detail=compose("not-examined"))

log = structlog.get_logger()


def readiness(service: Service) -> dict[str, CheckOut]:
    """Checks database, disk, workers, queues, OpenGL (EGL), rig, records and results. Returns one finding for each of
    these parts, by name. Tolerates a database that does not answer."""
    return {
        "database": _database(service),
        "disk": _disk(service),
        "worker": _workers(service),
        "queues": _queues(service),
        "egl": service.known.get("egl") or CheckOut(ok=False, detail=compose("check-starting"), starting=True),
        "rig": _rig(service),
        "records": _records(service),
        "retention": _retention(service),
        "store": _store(service),
        "results": service.known.get("results") or CheckOut(ok=True, detail=compose("not-examined")),
    }


def _database(service: Service) -> CheckOut:
    try:
        with service.engine.connect() as connection:
            connection.execute(sa.select(1))
    except SQLAlchemyError as error:
        return CheckOut(ok=False, detail=compose("silent-because", reason=str(error)[:200]))
    return CheckOut(ok=True, detail=verbatim(service.engine.dialect.name))


def _disk(service: Service) -> CheckOut:
    if not os.access(service.settings.data, os.W_OK):
        return CheckOut(ok=False, detail=compose("disk-unwritable"))
    free, spare = service.store.free_bytes(), service.settings.free_bytes
    code = "disk-free" if free > spare else "disk-too-full"
    return CheckOut(ok=free > spare, detail=compose(code, free_gb=free / 1e9, spare_gb=spare / 1e9))


def _workers(service: Service) -> CheckOut:
    try:
        with service.engine.connect() as connection:
            alive = alive_workers(connection, service.settings.silent_s)
            count = connection.scalar(sa.select(sa.func.count()).where(alive)) or 0
    except SQLAlchemyError:
        return CheckOut(ok=False, detail=compose("worker-unknown"))
    if count:
        return CheckOut(ok=True, detail=compose("workers-alive", count=count))
    if service.jobs.worker_may_start():
        return CheckOut(ok=False, detail=compose("worker-loading"), starting=True)
    return CheckOut(ok=False, detail=compose("no-worker-alive"))


def _queues(service: Service) -> CheckOut:
    """Names queues whose jobs wait without a worker, while the service is still ready for other work."""
    try:
        queued = service.jobs.index.queued()
        idle = {queue: found.jobs for queue, found in queued.items() if service.jobs.queue_notice(queue)}
    except SQLAlchemyError:
        return CheckOut(ok=True, detail=compose("queues-unknown"))
    if not idle:
        return CheckOut(ok=True, detail=compose("queues-served"))
    return CheckOut(ok=True, detail=compose("queues-unserved", queues=sorted(idle), count=sum(idle.values())))


def check_egl(service: Service) -> None:
    """Makes an OpenGL context in a child process and stores the finding for ``readiness``. The test blocks for a second
    or more; each process makes it once."""
    try:
        with service.children.one() as child:
            service.known["egl"] = CheckOut(ok=True, detail=verbatim(child.remote(try_egl)()))
    except WorkFailed as error:
        service.known["egl"] = CheckOut(ok=False, detail=error.message)


def _rig(service: Service) -> CheckOut:
    state = service.rig.describe()
    if state.faults:
        return CheckOut(ok=state.ready, detail=compose("several", messages=state.faults))
    return CheckOut(ok=state.ready, detail=compose("rig-described", kind=state.kind, count=len(state.cameras)))


def _records(service: Service) -> CheckOut:
    names = service.store.list_quarantined()
    detail = compose("records-damaged", count=len(names), names=names[:5]) if names else compose("no-record-damaged")
    return CheckOut(ok=True, detail=detail)


def _retention(service: Service) -> CheckOut:
    try:
        return CheckOut(ok=True, detail=verbatim((service.settings.data / STOPPED).read_text(encoding="utf-8")))
    except FileNotFoundError:
        return CheckOut(ok=True, detail=compose("clock-trusted"))


def check_store(service: Service) -> None:
    """Asks the stores of captures and results whether they answer, and stores the finding for ``readiness``. Blocks
    while a store does not answer. Jobs wait for an unreachable store, so the service stays ready."""
    places = store_places(service)
    if not places:
        return
    try:
        for store in _watched(service):
            store.probe()
    except Refused as error:
        if service.known.get("store", STORE_UNKNOWN).detail.code == "store-answers":
            log.warning("the store is away", reason=error.detail.text)
        service.known["store"] = CheckOut(ok=True, detail=error.detail)
    else:
        service.known["store"] = CheckOut(ok=True, detail=compose("store-answers", place=", ".join(places)))


def store_places(service: Service) -> list[str]:
    """Returns where captures and results are kept beside the data folder."""
    places = (service.settings.captures_store, service.settings.results_store)
    return [place for place in places if place is not None]


def _store(service: Service) -> CheckOut:
    if not store_places(service):
        return CheckOut(ok=True, detail=compose("store-none"))
    return service.known.get("store", STORE_UNKNOWN)


def _watched(service: Service) -> list[WatchedObjects]:
    blobs = service.store.blobs
    stores = (service.jobs.results.objects, None if blobs is None else blobs.objects)
    return [store for store in stores if store is not None]


def exposition(service: Service) -> bytes:
    """Measures the metrics that are not counted as events happen. Returns all metrics in Prometheus' text format."""
    metrics, index = service.metrics, service.jobs.index
    queued, slots = index.queued(), slots_by_queue(service.engine, service.settings.silent_s)
    for gauge in (metrics.queued, metrics.oldest, metrics.slots):
        gauge.clear()  # of queues that nobody uses any more
    for name in {*queued, *slots}:
        found = queued.get(name) or Queued(0, time.time())
        metrics.queued.labels(name).set(found.jobs)
        metrics.oldest.labels(name).set(max(0.0, time.time() - found.since))
        metrics.slots.labels(name).set(slots.get(name, 0))
    died = index.counts().get("MAX_RECOVERY_ATTEMPTS_EXCEEDED", 0)
    for kind, count in (failure_counts(service.engine) | {"worker-died": died}).items():
        metrics.failures.labels(kind).set(count)
    for state, count in service.jobs.counts().items():
        metrics.jobs.labels(state).set(count)
    _measure_stores(service)
    metrics.captures.set(len(service.store.ids("captures")))
    metrics.free.set(service.store.free_bytes())
    metrics.memory.set(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
    metrics.quarantined.set(len(service.store.list_quarantined()))
    return generate_latest(metrics.registry)


def _measure_stores(service: Service) -> None:
    """Sets the metrics of requests to object stores, if there are any, and whether the stores answered last."""
    operations, seconds = Counter[tuple[str, str]](), Counter[str]()
    for store in _watched(service):
        service.metrics.store_up.labels("results").set(_store(service).detail.code == "store-answers")
        operations.update(store.operations())
        seconds.update(store.seconds())  # pyright: ignore[reportCallIssue, reportArgumentType]
    for labels, count in operations.items():
        service.metrics.store_operations.labels(*labels).set(count)
    for operation, took_s in seconds.items():
        service.metrics.store_seconds.labels(operation).set(took_s)


class InfoOut(Answer):
    """Describes the service: version, load, limits, and the default settings of a job."""

    version: str
    cores: int = Field(description="that this service may use; its workers may run elsewhere")
    queued: int = Field(description="jobs")
    running: int = Field(description="jobs")
    cameras_least: int = Field(description="of a capture")
    cameras_most: int = Field(description="of a capture")
    body_bytes_most: int = Field(description="of an upload")
    image_pixels_most: int = Field(description="of one image")
    jobs_per_key_most: int = Field(description="queued and running")
    settings: JobSettings = Field(description="what a job has where it gives none; its schema says what it may give")


def about(service: Service) -> InfoOut:
    """Returns the service's version, its load, its limits and the default settings of a job."""
    jobs, limits = service.jobs.counts(), service.settings
    return InfoOut(
        version=version("eigenhead"),
        cores=len(os.sched_getaffinity(0)),
        queued=jobs["queued"],
        running=jobs["running"],
        cameras_least=CAMERAS_LEAST,
        cameras_most=CAMERAS_MOST,
        body_bytes_most=limits.body_bytes,
        image_pixels_most=limits.image_pixels,
        jobs_per_key_most=limits.jobs_per_key,
        settings=document_from_settings(Settings()),
    )
