"""Prometheus metrics: counted by the middleware, measured when asked."""

import resource
import time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from server.jobs import STATES, WORKFLOW
from server.service import Service

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS = (0.005, 0.02, 0.1, 0.5, 2.0, 10.0, 60.0)


class Metrics:
    """The counters of one process; a registry of its own, so that two apps in one process do not mix."""

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
        self.captures = Gauge("eigenhead_captures", "Captures kept", registry=self.registry)
        self.free = Gauge("eigenhead_disk_free_bytes", "Free space of the data folder", registry=self.registry)
        self.memory = Gauge("eigenhead_peak_memory_bytes", "Peak memory of the service process", registry=self.registry)
        self.set_aside = Gauge("eigenhead_damaged_records", "Damaged records set aside", registry=self.registry)
        self.lag = Histogram(
            "eigenhead_event_loop_lag_seconds",
            "How late the event loop wakes",
            buckets=(0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0),
            registry=self.registry,
        )

    def observe(self, method: str, route: str, status: int, began: float) -> None:
        self.requests.labels(method, route, str(status)).inc()
        self.seconds.labels(route).observe(time.monotonic() - began)


def exposition(service: Service) -> bytes:
    metrics = service.metrics
    counts = dict.fromkeys(set(STATES.values()), 0)
    for row in service.jobs.client.list_workflows(name=WORKFLOW, load_input=False, load_output=False):
        counts[STATES[row.status]] += 1
    for state, count in counts.items():
        metrics.jobs.labels(state).set(count)
    metrics.captures.set(len(service.store.ids("captures")))
    metrics.free.set(service.store.free_bytes())
    metrics.memory.set(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
    metrics.set_aside.set(len(service.store.set_aside()))
    return generate_latest(metrics.registry)
