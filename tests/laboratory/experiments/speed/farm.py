"""Simulates a farm of workers with one database and one object store, and says where it stops growing and what a head
costs.

A discrete-event model: a worker takes a job (statements), fetches the capture, computes, stores the result and reads it
back, notes the end (statements), and looks for the next. Database and store are servers with a queue each. What workers
ask all the time (for jobs, for the state of theirs, progress) takes a share of the database from the rest. Figures of a
job are measured (``Farm`` says by which command), prices are the list prices that ``Prices`` states.
"""

import heapq
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tests.laboratory.experiments import markdown
from tests.laboratory.experiments.records import Outcome

WORKERS = (1, 8, 32, 64, 128, 256, 512, 1024)
JOBS_A_WORKER = 12
SEED = 11
EFFICIENT = 0.9
HOUR_S, MONTH_H, GB = 3600.0, 730.0, 1e9


@dataclass(frozen=True, slots=True)
class Farm:
    """Holds what a job and a worker ask for.

    Attributes:
        job_s: seconds of a default job on two cores (``eigenhead reconstruct``), and the spread of the jobs (share).
        capture_bytes, result_bytes, result_files: of shared/data/captures/scan-a and its default head.
        job_statements, running_statements, idle_statements: statements of a job, of each second that it runs, and of
            each second of a worker that looks for jobs at a poll_s of ``measured_poll_s``.
        poll_s: EIGENHEAD_POLL_S of the farm.
        statements_per_s: what the database carries out (pgbench, the same command, two cores).
        store_bytes_per_s: what the store and the way to it carry (10 Gbit/s).
    """

    job_s: float = 25.0
    spread: float = 0.1
    capture_bytes: float = 24e6
    result_bytes: float = 45e6
    result_files: int = 18
    job_statements: float = 71.0
    running_statements: float = 20.0
    idle_statements: float = 65.0
    measured_poll_s: float = 0.25
    poll_s: float = 0.25
    statements_per_s: float = 20_000.0
    store_bytes_per_s: float = 1.25e9

    def share_of_database(self, workers: int) -> float:
        """Returns the share of the database that so many busy workers take by what they ask all the time."""
        rate = (self.running_statements + self.idle_statements) * self.measured_poll_s / self.poll_s
        return workers * rate / self.statements_per_s


@dataclass(frozen=True, slots=True)
class Prices:
    """Holds list prices in US dollars, without tax and discounts: those of Amazon in Virginia, to be replaced by one's
    own. A worker and the service have two virtual cores and 4 GB (c5.large), the database two and 8 GB (RDS,
    db.m6g.large). docs/service.md says who states each, and when."""

    worker_hour: float = 0.085
    database_hour: float = 0.159
    service_hour: float = 0.085
    put: float = 5e-6
    get: float = 4e-7
    gb_month: float = 0.023


@dataclass(frozen=True, slots=True)
class Load:
    """Holds how a farm of so many workers did: share of their time that workers computed, heads an hour, and how busy
    database and store were (1: all the time)."""

    workers: int
    efficiency: float
    heads_per_hour: float
    database: float
    store: float


class Server:
    """Serves one request after another at a rate (units a second)."""

    def __init__(self, rate: float) -> None:
        self._rate, self._free, self.busy_s = rate, 0.0, 0.0

    def serve(self, at: float, amount: float) -> float:
        """Returns when a request of this amount, which comes at ``at``, is done. Requests come in the order of
        time."""
        took = amount / self._rate
        self._free = max(self._free, at) + took
        self.busy_s += took
        return self._free


def simulate(farm: Farm, workers: int, jobs: int, seed: int = SEED) -> Load:
    """Simulates ``jobs`` jobs in a full queue. Raises no error where the database has no share left: then nothing goes
    on, and the efficiency is 0."""
    share = farm.share_of_database(workers)
    if share >= 1.0:
        return Load(workers, 0.0, 0.0, share, 0.0)
    rng = np.random.default_rng(seed)
    database, store = Server(farm.statements_per_s * (1.0 - share)), Server(farm.store_bytes_per_s)
    computed = ended = 0.0
    left, done = jobs, 0
    # an event: when, a number that breaks ties, and the phase that begins then
    events = [(float(at), number, 0) for number, at in enumerate(rng.uniform(0.0, farm.poll_s, workers))]
    heapq.heapify(events)
    while events:
        at, number, phase = heapq.heappop(events)
        if phase == 0:
            if not left:
                continue
            left -= 1
            following = database.serve(at, farm.job_statements / 2)
        elif phase == 1:
            following = store.serve(at, farm.capture_bytes)
        elif phase == 2:
            took = farm.job_s * float(np.clip(rng.normal(1.0, farm.spread), 0.5, 1.5))
            computed, following = computed + took, at + took
        elif phase == 3:
            following = store.serve(at, 2 * farm.result_bytes)  # sent, and read back
        elif phase == 4:
            following = database.serve(at, farm.job_statements / 2)
        else:
            done, ended = done + 1, max(ended, at)
            following = at + float(rng.uniform(0.0, farm.poll_s))
        heapq.heappush(events, (following, number, (phase + 1) % 6))
    busy = share + (1.0 - share) * database.busy_s / ended
    return Load(workers, computed / (workers * ended), HOUR_S * done / ended, busy, store.busy_s / ended)


def cost_of(heads: float, load: Load, farm: Farm, prices: Prices) -> dict[str, float]:
    """Returns what so many heads cost with a farm under this load, by part: computing (workers, database and service
    for as long as it takes), requests to the store, and a month of keeping captures and results."""
    hours = heads / load.heads_per_hour
    requests = farm.result_files * (prices.put + 2 * prices.get) + 11 * prices.get
    return {
        "computing": hours * (load.workers * prices.worker_hour + prices.database_hour + prices.service_hour),
        "requests": heads * requests,
        "a month kept": heads * (farm.capture_bytes + farm.result_bytes) / GB * prices.gb_month,
    }


def first_bottleneck(loads: Sequence[Load]) -> Load | None:
    """Returns the load of the smallest farm whose workers compute less than ``EFFICIENT`` of their time."""
    return next((load for load in loads if load.efficiency < EFFICIENT), None)


def scale(farm: Farm | None = None, prices: Prices | None = None) -> Outcome:
    """Simulates farms of ``WORKERS`` workers, with the default pauses and with those of a farm (poll_s of 2 s), and
    prices 1,000 and 1,000,000 heads."""
    farm, prices = farm or Farm(), prices or Prices()
    rows, figures = [], dict[str, float]()
    for poll_s in (farm.poll_s, 2.0):
        paced = _paced(farm, poll_s)
        loads = [simulate(paced, workers, JOBS_A_WORKER * workers) for workers in WORKERS]
        rows += [{"poll_s": poll_s, **_row(load)} for load in loads]
        slow = first_bottleneck(loads)
        figures[f"workers_efficient_poll_{poll_s:g}_s"] = max(
            (load.workers for load in loads if load.efficiency >= EFFICIENT), default=0
        )
        if slow is not None:
            figures[f"bottleneck_database_poll_{poll_s:g}_s"] = slow.database
            figures[f"bottleneck_store_poll_{poll_s:g}_s"] = slow.store
    for heads, workers in ((1e3, 8), (1e6, 128)):
        load = simulate(_paced(farm, 2.0), workers, JOBS_A_WORKER * workers)
        costs = cost_of(heads, load, farm, prices)
        figures |= {f"usd_{heads:.0f}_{part.replace(' ', '_')}": value for part, value in costs.items()}
        figures[f"hours_{heads:.0f}_by_{workers}_workers"] = heads / load.heads_per_hour
    header = ("poll_s", "workers", "efficiency", "heads an hour", "database", "store")
    cells = [tuple(row.values()) for row in rows]
    return {"figures": figures, "rows": rows, "markdown": markdown.table(header, cells)}


def _paced(farm: Farm, poll_s: float) -> Farm:
    return replace(farm, poll_s=poll_s)


def _row(load: Load) -> dict[str, float]:
    return {
        "workers": load.workers,
        "efficiency": load.efficiency,
        "heads_per_hour": load.heads_per_hour,
        "database": load.database,
        "store": load.store,
    }
