"""Figures of the service under load.

python -m tests.laboratory service_load soak 1000      # many small jobs: memory, descriptors, database size
python -m tests.laboratory service_load clients 50     # uploads at once: failures, seconds, lag of the event loop
python -m tests.laboratory service_load workers 20     # PostgreSQL: one pinned worker against two, by core
python -m tests.laboratory service_load heads 10       # the same with reconstructions of a simulated shot

``soak`` and ``clients`` use small captures and the tests' tiny work: they measure the service, not the pipeline.
``workers`` burns real CPU.
"""

import os
import re
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Literal

import httpx

from rig.formats.captures.archive import pack_folder
from tests.server.worker.test_durability import pinned_worker
from tests.support.postgres import running_postgres
from tests.support.services import RunningService, await_state, running_service, small_capture

KEEP_JOBS = 100  # retention: without it the database grows with the jobs that it keeps


def archive(folder: Path, size: int) -> bytes:
    pack_folder(small_capture(folder / "capture", cameras=11, size=size), folder / "capture.tar")
    return (folder / "capture.tar").read_bytes()


def processes(service: RunningService) -> list[Path]:
    """The service's process and all below it."""
    assert service.process is not None
    found = {service.process.pid}
    for folder in sorted(Path("/proc").glob("[0-9]*"), key=lambda path: int(path.name)):
        try:
            status = (folder / "status").read_text()
        except OSError:
            continue
        if int(re.search(r"PPid:\s+(\d+)", status)[1]) in found:  # type: ignore[index]
            found.add(int(folder.name))
    return [Path("/proc") / str(pid) for pid in sorted(found)]


def gauge(service: RunningService) -> dict[str, Any]:
    memory = files = 0
    for folder in processes(service):
        memory += int(re.search(r"VmRSS:\s+(\d+)", (folder / "status").read_text())[1]) // 1024  # type: ignore[index]
        files += len(list((folder / "fd").iterdir()))
    database = sum(path.stat().st_size for path in service.data.glob("eigenhead.sqlite*")) / 1e6
    return {"memory_mb": memory, "descriptors": files, "database_mb": round(database, 2)}


def soak(jobs: int, folder: Path) -> dict[str, Any]:
    settings: dict[str, Any] = {
        "tiny_s": "0.01",
        "keep_jobs": str(KEEP_JOBS),
        "sweep_s": "5",
        "jobs_per_key": "1000",
        "poll_s": "0.05",
    }
    with (
        running_service(folder / "data", **settings) as service,
        httpx.Client(base_url=service.url, timeout=60) as client,
    ):
        capture = client.post("/v1/captures/uploads", files={"file": archive(folder, 24)}).json()["id"]
        rows, began = [], time.monotonic()
        for number in range(jobs):
            job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
            assert await_state(client, job, ("succeeded", "failed"), 60)["state"] == "succeeded"
            if number % max(1, jobs // 10) == jobs // 10 - 1:
                rows.append({"jobs": number + 1, **gauge(service)})
        return {"jobs": jobs, "seconds": round(time.monotonic() - began, 1), "rows": rows}


def clients(count: int, folder: Path) -> dict[str, Any]:
    data = archive(folder, 400)
    with running_service(folder / "data", worker=False) as service:

        def upload(number: int) -> float:
            began = time.monotonic()
            with httpx.Client(base_url=service.url, timeout=600) as client:
                response = client.post("/v1/captures/uploads", files={"file": data})
            assert response.status_code == 201, response.text
            return time.monotonic() - began

        upload(0)
        began = time.monotonic()
        with ThreadPoolExecutor(count) as pool:
            seconds = sorted(pool.map(upload, range(count)))
        total = time.monotonic() - began
        text = httpx.get(service.url + "/metrics", timeout=30).text
    return {
        "clients": count,
        "megabytes_each": round(len(data) / 1e6, 1),
        "seconds": round(total, 1),
        "slowest_s": round(seconds[-1], 1),
        "lag_p99_ms": lag_p99_ms(text),
    }


def lag_p99_ms(metrics: str) -> float:
    """The upper bound of the bucket that holds the 99th percentile."""
    found = re.findall(r'eigenhead_event_loop_lag_seconds_bucket\{le="([^"]+)"\} ([\d.e+]+)', metrics)
    total = float(found[-1][1])
    return next(float(bound) * 1000 for bound, count in found if float(count) >= 0.99 * total)


def heads(jobs: int, folder: Path) -> dict[str, Any]:
    """``workers`` with the pipeline; the silhouettes are found once, as for every capture."""
    return workers(jobs, folder, work="server.tasks.reconstruct:reconstruct_capture")


def workers(jobs: int, folder: Path, *, work: str = "tests.support.tiny:busy") -> dict[str, Any]:
    """Work that keeps a core busy; each worker is bound to a core of its own."""
    times, real = {}, work.startswith("server.")
    for count in (1, 2):
        with ExitStack() as stack:
            url = stack.enter_context(running_postgres())
            data = folder / f"data{count}"
            service = stack.enter_context(running_service(data, worker=False, work=work, database_url=url))
            client = stack.enter_context(httpx.Client(base_url=service.url, timeout=120))
            if real:
                capture = client.post("/v1/captures", json={"seed": 1}).json()["id"]
            else:
                capture = client.post("/v1/captures/uploads", files={"file": archive(folder, 24)}).json()["id"]
            request = {"capture_id": capture, "settings": {"detail": "span"}}
            for core in range(count):
                stack.enter_context(pinned_worker(service, core))
            warm = [client.post("/v1/jobs", json=request).json()["id"] for _ in range(2 * count)]
            for job in warm:  # processes started, modules loaded
                await_state(client, job, ("succeeded",), 240)
            began = time.monotonic()
            submitted = [client.post("/v1/jobs", json=request).json()["id"] for _ in range(jobs)]
            for job in submitted:
                await_state(client, job, ("succeeded",), 600)
            times[count] = time.monotonic() - began
    return {
        "jobs": jobs,
        "one_s": round(times[1], 1),
        "two_s": round(times[2], 1),
        "ratio": round(times[2] / times[1], 3),
    }


LOADS = {"soak": (soak, 1000), "clients": (clients, 50), "workers": (workers, 20), "heads": (heads, 10)}


def run(
    what: Literal["soak", "clients", "workers", "heads"], count: int | None = None, *, scratch: Path
) -> dict[str, Any]:
    """Returns the figures of one of this module's loads, by so many jobs or clients."""
    load, default = LOADS[what]
    return {"figures": load(count or default, scratch) | {"load_average": os.getloadavg()[0]}}
