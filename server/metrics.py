"""Collects metrics for Prometheus: requests are counted as they end, other metrics are measured when they are read."""

import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS = (0.005, 0.02, 0.1, 0.5, 2.0, 10.0, 60.0)


@dataclass(frozen=True, slots=True)
class QueueFigures:
    """Holds how many jobs wait in a queue, how long the oldest has waited (s), and how many jobs its live workers run
    at once."""

    jobs: int
    oldest_s: float
    slots: int


@dataclass(frozen=True, slots=True)
class StoreFigures:
    """Holds whether the store of results answered the last request, and this process's requests to it: the number of
    operations by name and outcome, and their seconds by name."""

    answers: bool
    operations: Mapping[tuple[str, str], int]
    seconds: Mapping[str, float]


class Metrics:
    """Holds the metrics of one app. Each has a registry of its own, so that two apps in one process do not mix."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route", "status")
        self.requests = Counter("eigenhead_requests", "HTTP requests", labels, registry=self.registry)
        self.seconds = Histogram(
            "eigenhead_request_seconds",
            "Time to the end of the answer",
            ("route",),
            buckets=BUCKETS,
            registry=self.registry,
        )
        self.jobs = Gauge("eigenhead_jobs", "Jobs by state", ("state",), registry=self.registry)
        queue, registry = ("queue",), self.registry
        self.queued = Gauge("eigenhead_queue_jobs", "Jobs that wait in a queue", queue, registry=registry)
        waited = "How long the oldest job of a queue has waited"
        self.oldest = Gauge("eigenhead_queue_oldest_seconds", waited, queue, registry=registry)
        at_once = "Jobs that the live workers of a queue run at once"
        self.slots = Gauge("eigenhead_worker_slots", at_once, queue, registry=registry)
        self.failures = Gauge("eigenhead_failures", "Jobs that failed, by kind", ("kind",), registry=self.registry)
        does, by_end = "What the service asked of the store of results", ("operation", "outcome")
        self.store_operations = Gauge("eigenhead_store_operations", does, by_end, registry=registry)
        took = "How long that took, in all"
        self.store_seconds = Gauge("eigenhead_store_seconds", took, ("operation",), registry=registry)
        self.store_up = Gauge(
            "eigenhead_store_up", "Whether the store of results answers", ("store",), registry=registry
        )
        self.captures = Gauge("eigenhead_captures", "Captures kept", registry=self.registry)
        self.free = Gauge("eigenhead_disk_free_bytes", "Free space of the data folder", registry=self.registry)
        self.memory = Gauge("eigenhead_peak_memory_bytes", "Peak memory of the service process", registry=self.registry)
        self.quarantined = Gauge("eigenhead_damaged_records", "Damaged records set aside", registry=self.registry)
        self.lag = Histogram(
            "eigenhead_event_loop_lag_seconds",
            "How late the event loop wakes",
            buckets=(0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0),
            registry=self.registry,
        )

    def observe(self, method: str, route: str, status: int, began: float) -> None:
        """Counts a request that has ended. ``began`` is its start on the monotonic clock (s)."""
        self.requests.labels(method, route, str(status)).inc()
        self.seconds.labels(route).observe(time.monotonic() - began)

    def exposition(
        self,
        jobs: Mapping[str, int],
        *,
        captures: int,
        free: int,
        damaged: int,
        queues: Mapping[str, QueueFigures],
        failures: Mapping[str, int],
        store: StoreFigures | None,
    ) -> bytes:
        """Returns all metrics in Prometheus' text format. ``jobs``: number by state; ``free``: bytes; ``failures``:
        number by kind; ``store``: None without one."""
        for gauge in (self.queued, self.oldest, self.slots):
            gauge.clear()  # of queues that nobody uses any more
        for name, figures in queues.items():
            self.queued.labels(name).set(figures.jobs)
            self.oldest.labels(name).set(figures.oldest_s)
            self.slots.labels(name).set(figures.slots)
        for kind, count in failures.items():
            self.failures.labels(kind).set(count)
        for state, count in jobs.items():
            self.jobs.labels(state).set(count)
        if store is not None:
            self.store_up.labels("results").set(store.answers)
            for labels, count in store.operations.items():
                self.store_operations.labels(*labels).set(count)
            for operation, seconds in store.seconds.items():
                self.store_seconds.labels(operation).set(seconds)
        self.captures.set(captures)
        self.free.set(free)
        self.memory.set(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
        self.quarantined.set(damaged)
        return generate_latest(self.registry)
