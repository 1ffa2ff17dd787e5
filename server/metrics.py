"""Declares metrics for Prometheus: requests are counted as they end; ``server.services.health`` measures all other
metrics when they are read."""

import time

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"
BUCKETS = (0.005, 0.02, 0.1, 0.5, 2.0, 10.0, 60.0)  # s, of a request
LAGS = (0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0)  # s, of the event loop


class Metrics:
    """Holds the metrics of one app, in its own registry, so that the metrics of two apps in one process do not mix."""

    def __init__(self) -> None:
        self.registry = registry = CollectorRegistry()
        labels = ("method", "route", "status")
        self.requests = Counter("eigenhead_requests", "HTTP requests", labels, registry=registry)
        answered = "Time to the end of the answer"
        self.seconds = Histogram("eigenhead_request_seconds", answered, ("route",), buckets=BUCKETS, registry=registry)
        self.lag = Histogram(
            "eigenhead_event_loop_lag_seconds", "How late the event loop wakes", buckets=LAGS, registry=registry
        )
        self.jobs = self._gauge("jobs", "Jobs by state", "state")
        self.queued = self._gauge("queue_jobs", "Jobs that wait in a queue", "queue")
        self.oldest = self._gauge("queue_oldest_seconds", "How long the oldest job of a queue has waited", "queue")
        self.slots = self._gauge("worker_slots", "Jobs that the live workers of a queue run at once", "queue")
        self.failures = self._gauge("failures", "Jobs that failed, by kind", "kind")
        operations = "What the service asked of the store of results"
        self.store_operations = self._gauge("store_operations", operations, "operation", "outcome")
        self.store_seconds = self._gauge("store_seconds", "How long that took, in all", "operation")
        self.store_up = self._gauge("store_up", "Whether the store of results answers", "store")
        self.captures = self._gauge("captures", "Captures kept")
        self.free = self._gauge("disk_free_bytes", "Free space of the data folder")
        self.memory = self._gauge("peak_memory_bytes", "Peak memory of the service process")
        self.quarantined = self._gauge("damaged_records", "Damaged records set aside")

    def _gauge(self, name: str, text: str, *labels: str) -> Gauge:
        return Gauge(f"eigenhead_{name}", text, labels, registry=self.registry)

    def observe(self, method: str, route: str, status: int, began: float) -> None:
        """Counts a request that has ended. ``began`` is its start on the monotonic clock (s)."""
        self.requests.labels(method, route, str(status)).inc()
        self.seconds.labels(route).observe(time.monotonic() - began)
