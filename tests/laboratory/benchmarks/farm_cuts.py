"""Workers without a common folder, killed and cut off while they work.

python -m tests.laboratory farm_cuts 8 192 8 20 10    # workers, jobs, seconds, kills, cuts

PostgreSQL and a whole S3 server (SeaweedFS), a service, and WORKERS workers, each with a data folder of its own and in
a pid namespace of its own (so that each is another machine to the rest; needs root), ``SLOTS`` jobs at once. Captures
come from the store. What a worker asks of database and store goes through two proxies of its own on the
loopback, its links. JOBS pinned jobs sleep SECONDS each. While they run, workers are SIGKILLed and started again KILLS
times, and CUTS links, of the database and of the store in turn, are cut for ``CUT_S`` seconds: every other one is
silent (what was connected stays connected, nothing comes through), the others refuse.

``efficiency``: seconds slept for results, by the seconds of all slots until the last job ended. ``undisturbed``: the
same of a fourth of the jobs before anything is killed. ``lost_to``: seconds of slots that were not slept for results in
the disturbed part, by cause: ``starting``, from a kill to the heartbeat of the next process; ``begun_again``, what was
slept for jobs whose worker was killed then; the rest are cuts, children that start, steps around a job and the last
jobs. ``taken_over_s``: from a kill until another worker goes on with a job, the median. ``connections``: of all to the
database, before anything is killed.
"""

import json
import os
import random
import signal
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import psycopg
import sqlalchemy as sa

from tests.support.object_server import KEYS, client_of, running_object_server
from tests.support.postgres import running_postgres
from tests.support.services import ROOT, RunningService, running_service, uploaded_capture

SLOTS = 2
CUT_S = (5.0, 20.0)
DEAD_S = 6.0
SEED = 37
BLOCK = 1 << 16
STARTED = "SELECT started FROM eigenhead_workers ORDER BY started"
BEGUN = """SELECT job_id, at FROM eigenhead_events WHERE document::json ->> 'stage' = 'read' ORDER BY job_id, at"""
CONNECTIONS = "SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend'"
MORE_CONNECTIONS = "-c max_connections=400"
NOW = "SELECT extract(epoch FROM clock_timestamp())"
ENDED = """SELECT count(*) FILTER (WHERE ends = 0), count(*) FILTER (WHERE ends > 1) FROM
           (SELECT job.job_id, count(event.seq) AS ends FROM eigenhead_job_index job LEFT JOIN eigenhead_events event
            ON event.job_id = job.job_id AND document::json ->> 'state' IN ('succeeded', 'failed', 'cancelled')
            GROUP BY 1) AS of_jobs"""


class Link:
    """A way to a server on the loopback, which can be cut."""

    def __init__(self, port: int) -> None:
        self._server, self._target = socket.create_server(("127.0.0.1", 0)), port
        self.port = self._server.getsockname()[1]
        self.passes, self._refuses = threading.Event(), False
        self.passes.set()
        self._open = set[socket.socket]()
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self, seconds: float, *, refuse: bool) -> None:
        """Cuts the link for so long; returns at once."""
        self._refuses = refuse
        self.passes.clear()
        for one in [*self._open] if refuse else []:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
        threading.Timer(seconds, self.passes.set).start()

    def _accept(self) -> None:
        while True:
            here, _ = self._server.accept()
            if self._refuses and not self.passes.is_set():
                here.close()
                continue
            there = socket.create_connection(("127.0.0.1", self._target))
            self._open |= {here, there}
            for pair in ((here, there), (there, here)):
                threading.Thread(target=self._forward, args=pair, daemon=True).start()

    def _forward(self, source: socket.socket, target: socket.socket) -> None:
        with suppress(OSError):
            while data := source.recv(BLOCK):
                if not self.passes.wait(60.0):
                    break
                target.sendall(data)
        for one in (source, target):
            self._open.discard(one)
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()


@dataclass
class FarmWorker:
    """One worker with its folder and its links."""

    data: Path
    environment: dict[str, str]
    links: tuple[Link, Link]
    process: "subprocess.Popen[bytes] | None" = field(default=None, init=False)

    def start(self) -> None:
        apart = ["unshare", "--pid", "--fork", "--kill-child", "--mount-proc"]
        with Path(f"{self.data}.log").open("ab") as log:
            command = [*apart, sys.executable, "-m", "server.cli", "worker"]
            self.process = subprocess.Popen(command, env=os.environ | self.environment, cwd=ROOT, stderr=log)

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()


def farm_worker(number: int, folder: Path, service: RunningService, database: str, store: str) -> FarmWorker:
    data, url = folder / f"worker{number}", sa.make_url(database)
    links = Link(url.port or 0), Link(int(store.rpartition(":")[2]))
    mine = url.set(port=links[0].port).render_as_string(hide_password=False)
    environment = service.environment | {
        "EIGENHEAD_DATA": str(data),
        "EIGENHEAD_DATABASE_URL": mine,
        "EIGENHEAD_STORE_ENDPOINT": f"http://127.0.0.1:{links[1].port}",
        "EIGENHEAD_CONCURRENCY": str(SLOTS),
        "EIGENHEAD_THREADS": "1",
    }
    return FarmWorker(data, environment, links)


class Farm:
    """The service, its database and its workers."""

    def __init__(
        self,
        client: httpx.Client,
        database: "psycopg.Connection[Any]",
        bucket: Any,
        capture: str,
        workers: list[FarmWorker],
    ) -> None:
        self.client, self.database, self.workers = client, database, workers
        self._bucket, self._capture = bucket, capture
        self.killed = list[float]()

    def submit(self, jobs: int, seconds: float) -> list[str]:
        wanted = {"capture_id": self._capture, "settings": {"front": f"{seconds:g}"}}
        return [self._submit(wanted, str(uuid4())) for _ in range(jobs)]

    def _submit(self, wanted: dict[str, Any], key: str) -> str:
        """Until it is accepted, as a client does; the key makes it one job."""
        while (said := self.client.post("/v1/jobs", json=wanted, headers={"Idempotency-Key": key})).status_code == 503:
            time.sleep(float(said.headers["Retry-After"]))
        return said.raise_for_status().json()["id"]

    def under_way(self) -> int:
        query = "SELECT count(*) FROM dbos.workflow_status WHERE status IN ('PENDING', 'ENQUEUED')"
        return self.database.execute(query).fetchall()[0][0]

    def finish(self, timeout_s: float = 1200.0) -> None:
        deadline = time.monotonic() + timeout_s
        while self.under_way():
            assert time.monotonic() < deadline, self.under_way()
            time.sleep(0.2)

    def losses(self) -> dict[str, float]:
        """Seconds of slots that kills took, and of taking over, from what the database has of workers and jobs."""
        started = [row[0] for row in self.database.execute(STARTED).fetchall()]
        starting = [min((at - kill for at in started if at > kill), default=0.0) for kill in self.killed]
        again, taken_over = 0.0, list[float]()
        begun = self.database.execute(BEGUN).fetchall()
        for (job, first), (same, second) in pairwise(begun):
            kills = [kill for kill in self.killed if first < kill < second]
            if job == same and kills:
                again += kills[0] - first
                taken_over.append(second - kills[0])
        return {
            "starting": SLOTS * sum(starting),
            "begun_again": again,
            "taken_over_s": statistics.median(taken_over) if taken_over else 0.0,
        }

    def found(self, ids: list[str]) -> dict[str, Any]:
        """How jobs ended, what of that was written, and what is left once their capture is removed."""
        ended = [self.client.get(f"/v1/jobs/{job}").raise_for_status().json() for job in ids]
        objects = self._bucket.get_paginator("list_objects_v2").paginate(Bucket="heads", Prefix="of/")
        keys = {entry["Key"] for page in objects for entry in page.get("Contents", ())} - {"of/owner"}
        everything = self.client.get("/v1/jobs", params={"limit": 1}).json()["total"]
        ((unsaid, said_twice),) = self.database.execute(ENDED).fetchall()
        assert self.client.delete(f"/v1/captures/{self._capture}").status_code == 204
        blobs = self._bucket.list_objects_v2(Bucket="heads", Prefix="captures/").get("Contents", ())
        return {
            "states": dict(Counter(job["state"] for job in ended)),
            "failures": [job["error"] for job in ended if job["state"] == "failed"],
            "different_results": len({json.dumps(job["files"], sort_keys=True) for job in ended if job["files"]}),
            "ends_never_said": unsaid,
            "ends_said_more_than_once": said_twice,
            "objects_left_over": len(keys) - 3 * everything,
            "captures_left_over": len({entry["Key"] for entry in blobs} - {"captures/owner"}),
        }

    def harm(self, kills: int, cuts: int, seconds: float) -> None:
        """Kills and cuts at random moments of about so many seconds."""
        rng = random.Random(SEED)
        acts = ["kill"] * kills + ["cut"] * cuts
        rng.shuffle(acts)
        cut = 0
        for number, act in enumerate(acts):
            time.sleep(rng.uniform(0.5, 1.5) * seconds / len(acts))
            worker = self.workers[number % len(self.workers)]
            if act == "kill":
                worker.kill()
                self.killed.append(float(self.database.execute(NOW).fetchall()[0][0]))
                worker.start()
            else:
                worker.links[cut % 2].cut(rng.uniform(*CUT_S), refuse=cut // 2 % 2 == 1)
                cut += 1


@contextmanager
def running_farm(workers: int, folder: Path) -> Iterator[Farm]:
    """Database, store, a service with one capture, and so many workers, each of which has run jobs."""
    with ExitStack() as stack:
        os.environ.update(KEYS)
        database_url = stack.enter_context(running_postgres(MORE_CONNECTIONS))
        store = stack.enter_context(running_object_server())
        bucket = client_of(store)
        bucket.create_bucket(Bucket="heads")
        settings: dict[str, Any] = {
            "database_url": database_url,
            "results_store": "s3://heads/of/",
            "captures_store": "s3://heads/captures/",
            "store_endpoint": store,
        }
        settings |= {"store_timeout_s": "3", "silent_s": str(DEAD_S), "heartbeat_s": "1", "poll_s": "0.25"}
        service = stack.enter_context(
            running_service(folder / "service", worker=False, jobs_per_key="100000", attempts="1000", **settings)
        )
        client = stack.enter_context(httpx.Client(base_url=service.url, timeout=60))
        database = stack.enter_context(psycopg.connect(database_url, autocommit=True))
        capture = uploaded_capture(service, folder)
        made = [farm_worker(number, folder, service, database_url, store) for number in range(workers)]
        farm = Farm(client, database, bucket, capture, made)
        for worker in made:
            worker.start()
            stack.callback(worker.kill)
        farm.submit(2 * workers * SLOTS, 0.5)
        farm.finish()  # every child is started
        yield farm


def run(
    workers: int = 4, jobs: int = 96, seconds: float = 8.0, kills: int = 8, cuts: int = 6, *, scratch: Path
) -> dict[str, Any]:
    """Returns the figures of this module."""
    slots = workers * SLOTS
    few = max(jobs // 4 // slots, 1) * slots  # no slot without a job while the last ones run
    with running_farm(workers, scratch) as farm:
        began = time.monotonic()
        farm.submit(few, seconds)
        farm.finish()
        undisturbed_s = time.monotonic() - began
        ((connections,),) = farm.database.execute(CONNECTIONS).fetchall()
        began = time.monotonic()
        ids = farm.submit(jobs, seconds)
        farm.harm(kills, cuts, 0.9 * jobs * seconds / slots)
        farm.finish()
        took = time.monotonic() - began
        lost = farm.losses()
        found = farm.found(ids)
    figures = {
        "workers": workers,
        "slots": slots,
        "jobs": jobs,
        "kills": kills,
        "cuts": cuts,
        "connections": connections,
        **found,
        "seconds": round(took, 1),
        "slot_seconds_lost": round(slots * took - jobs * seconds, 1),
        "lost_to": {name: round(lost[name], 1) for name in ("starting", "begun_again")},
        "taken_over_s": round(lost["taken_over_s"], 1),
        "efficiency_undisturbed": round(few * seconds / (slots * undisturbed_s), 3),
        "efficiency": round(jobs * seconds / (slots * took), 3),
    }
    return {"figures": figures}
