"""What SIGKILL at any moment may not do to a batch: lose a capture, make its head twice, or leave anything over."""

import random
import time
from pathlib import Path

import httpx
import pytest

from tests.server.worker.test_durability import database
from tests.support.services import kill_workers, running_service, uploaded_capture

SPREAD_S = (0.3, 2.5)


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("kind", ["sqlite", "postgresql"])
@pytest.mark.parametrize(("total", "kills"), [(6, 4), pytest.param(12, 10, marks=pytest.mark.nightly)])
def test_a_batch_survives_kills_of_workers_and_service(kind: str, total: int, kills: int, tmp_path: Path) -> None:
    """Every second kill takes the service, too, in the midst of a pause or of a resumption."""
    rng = random.Random(37)
    with (
        database(kind) as settings,
        running_service(tmp_path / "data", silent_s="5", tiny_s="1", **settings) as service,
        httpx.Client(base_url=service.url, timeout=30) as http,
    ):
        captures = [uploaded_capture(service, tmp_path, seed) for seed in range(total)]
        batch = http.post("/v1/batches", json={"captures": captures}).json()["id"]
        for number in range(kills):
            time.sleep(rng.uniform(*SPREAD_S))
            if number % 2:
                http.post(f"/v1/batches/{batch}/{'pause' if number % 4 == 1 else 'resume'}")
                time.sleep(rng.uniform(0.0, 0.4))
                service.kill()
                service.start()
            else:
                kill_workers(service)
        http.post(f"/v1/batches/{batch}/resume")
        deadline = time.monotonic() + 240
        while not (ended := http.get(f"/v1/batches/{batch}").json())["finished"]:
            assert time.monotonic() < deadline, ended
            time.sleep(0.2)
        assert {state: count for state, count in ended["counts"].items() if count} == {"succeeded": total}
        jobs = http.get("/v1/jobs", params={"limit": 1000}).json()["jobs"]
        assert sorted(job["capture_id"] for job in jobs) == sorted(captures)
        assert sorted(path.name for path in (service.data / "jobs").iterdir()) == sorted(job["id"] for job in jobs)
        assert not [*(service.data / "jobs").glob("*/attempt-*")]
