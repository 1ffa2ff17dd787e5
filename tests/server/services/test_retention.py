"""What goes and what stays: by age, by number, by space; nothing that a job needs."""

import json
import os
import shutil
import time
from datetime import UTC, datetime
from pathlib import Path

import httpx
import pytest

from rig.files import write_atomically
from server.cli.doctor import examine
from server.metrics import Metrics
from server.services.retention import sweep
from server.services.service import open_service
from server.settings import ServiceSettings
from tests.support.services import RunningService, await_state, await_true, served_client, uploaded_capture
from tests.support.stored_captures import capture_record, stored


def await_gone(client: httpx.Client, path: str, timeout_s: float = 60.0) -> None:
    await_true(lambda: client.get(path).status_code == 404, timeout_s)


def test_a_clock_that_jumps_stops_retention_until_somebody_looked(tmp_path: Path) -> None:
    """What a sweep knows of the one before is set back, as if the clock had gone forward since; the capture too, since
    the tests' clock stays."""
    with served_client(tmp_path / "data", worker=False, keep_captures_days="30", sweep_s="0.2") as (service, client):
        old, new = uploaded_capture(service, tmp_path), uploaded_capture(service, tmp_path)
        last, stopped = service.data / "last-sweep.json", service.data / "retention-stopped.txt"
        await_readiness(client, "retention", "the clock is trusted")
        note_sweep(last, days=0.9)  # as after a laptop's night: an ordinary sweep goes on
        set_back(service, old, days=31)
        await_gone(client, f"/v1/captures/{old}")
        note_sweep(last, days=60)
        await_readiness(client, "retention", "has advanced 60 days")
        set_back(service, new, days=31)
        time.sleep(1.0)
        assert client.get(f"/v1/captures/{new}").status_code == 200
        assert not examine(ServiceSettings(data=service.data))["retention"]["ok"]
        stopped.unlink()
        await_gone(client, f"/v1/captures/{new}")


def test_after_a_restart_of_the_machine_not_half_of_all_goes_at_once(tmp_path: Path) -> None:
    """The service was off for 60 days, or the clock is wrong by them: nobody but a person knows."""
    settings = ServiceSettings(data=tmp_path, keep_captures_days=30)
    for dues, records, removed in ((19, 19, 19), (20, 39, 0), (20, 41, 20)):
        service = open_service(settings, Metrics())
        try:
            for number in range(records):
                created = datetime.fromtimestamp(time.time() - (60 if number < dues else 1) * 86400, UTC).isoformat()
                stored(service.store, capture_record(created=created))
            note_sweep(tmp_path / "last-sweep.json", days=60, boot="another")
            assert sweep(service).get("captures", 0) == removed
            (tmp_path / "retention-stopped.txt").unlink(missing_ok=True)
            for identity in service.store.ids("captures"):
                service.store.remove_capture(identity)
        finally:
            service.close()


def note_sweep(path: Path, days: float, boot: str | None = None) -> None:
    """Writes that the last sweep was that long ago, though the machine has run for a second since."""
    boot = boot or Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    up = time.clock_gettime(time.CLOCK_BOOTTIME) - 1
    write_atomically(path, json.dumps({"at": time.time() - days * 86400, "up": up, "boot": boot}).encode())


def set_back(service: RunningService, capture: str, days: float) -> None:
    path = service.data / "captures" / capture / "record.json"
    created = datetime.fromtimestamp(time.time() - days * 86400, UTC).isoformat()
    write_atomically(path, json.dumps(json.loads(path.read_bytes()) | {"created": created}).encode())


@pytest.mark.slow
def test_old_captures_go_unless_a_job_needs_them(tmp_path: Path) -> None:
    age = str(8 / 86400)
    with served_client(tmp_path / "data", keep_captures_days=age, sweep_s="0.3") as (service, client):
        needed, idle = uploaded_capture(service, tmp_path), uploaded_capture(service, tmp_path)
        job = client.post("/v1/jobs", json={"capture_id": needed, "settings": {"front": "long"}}).json()["id"]
        await_gone(client, f"/v1/captures/{idle}")
        assert client.get(f"/v1/captures/{needed}").status_code == 200
        client.post(f"/v1/jobs/{job}/cancel")
        await_gone(client, f"/v1/captures/{needed}")


@pytest.mark.slow
def test_only_the_newest_results_stay(tmp_path: Path) -> None:
    with served_client(tmp_path / "data", keep_jobs="2", sweep_s="0.3") as (service, client):
        capture = uploaded_capture(service, tmp_path)
        jobs = [client.post("/v1/jobs", json={"capture_id": capture}).json()["id"] for _ in range(4)]
        await_state(client, jobs[-1], ("succeeded",))
        for job in jobs[:2]:
            await_gone(client, f"/v1/jobs/{job}")
            assert not (service.data / "jobs" / job).exists()
        for job in jobs[2:]:
            assert client.get(f"/v1/jobs/{job}/result/head.ply").status_code == 200


def test_a_result_that_somebody_changed_or_removed_is_told_and_never_sent(tmp_path: Path) -> None:
    """In the job, in the list, by readiness, by doctor; a restart makes it again."""
    with served_client(tmp_path / "data", sweep_s="0.3") as (service, client):
        capture = uploaded_capture(service, tmp_path)
        job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
        files = await_state(client, job, ("succeeded",))["files"]
        assert client.get(f"/v1/jobs/{job}").json()["notice"] is None
        head = service.data / "jobs" / job / "result" / "head.ply"
        whole, times = head.read_bytes(), (head.stat().st_atime_ns, head.stat().st_mtime_ns)
        assert client.get(f"/v1/jobs/{job}/result/head.ply").content == whole
        for damaged in (whole[:-1], whole[:-1] + b"?"):
            head.write_bytes(damaged)
            for name in ("head.ply", "all.zip"):
                refused = client.get(f"/v1/jobs/{job}/result/{name}")
                assert (refused.status_code, refused.json()["type"]) == (500, "urn:eigenhead:problem:file-damaged")
                assert "head.ply" in refused.json()["detail"]
        head.write_bytes(whole)
        await_readiness(client, "results", "all there")  # a sweep that met the damage has set the file's time
        head.write_bytes(damaged)
        os.utime(head, ns=times)  # as where the disk itself changed it
        await_readiness(client, "results", f"{job}/head.ply")
        assert client.get(f"/v1/jobs/{job}/result/head.ply").status_code == 500
        assert f"{job}/head.ply" in examine(ServiceSettings(data=service.data))["results"]["detail"]
        head.write_bytes(whole)
        await_readiness(client, "results", "all there")
        assert client.get(f"/v1/jobs/{job}/result/head.ply").content == whole
        assert "of 1 were compared" in examine(ServiceSettings(data=service.data))["results"]["detail"]
        shutil.rmtree(service.data / "jobs" / job)
        assert "restart the job" in client.get("/v1/jobs").json()["jobs"][0]["notice"]
        refused = client.get(f"/v1/jobs/{job}/result/head.ply")
        assert (refused.status_code, refused.json()["type"]) == (409, "urn:eigenhead:problem:result-missing")
        assert client.get(f"/v1/jobs/{job}/result").status_code == 409
        await_readiness(client, "results", job)
        again = client.post(f"/v1/jobs/{job}/restart").json()["id"]
        assert await_state(client, again, ("succeeded",))["files"] == files


def await_readiness(client: httpx.Client, check: str, said: str) -> None:
    """Until readiness says this of a check."""
    await_true(lambda: said in client.get("/readyz").json()["checks"][check]["detail"], 20)


@pytest.mark.slow
def test_a_result_that_waits_to_be_delivered_stays(tmp_path: Path) -> None:
    nas = tmp_path / "nas"  # not mounted yet
    with served_client(tmp_path / "data", keep_jobs="0", sweep_s="0.3", deliver_prefixes=f'["file://{nas}/"]') as (
        service,
        client,
    ):
        wanted = {"capture_id": uploaded_capture(service, tmp_path), "deliver_to": f"file://{nas}/"}
        job = client.post("/v1/jobs", json=wanted).json()["id"]
        await_state(client, job, ("succeeded",))
        time.sleep(2.0)
        assert client.get(f"/v1/jobs/{job}").json()["delivery"]["state"] == "delivering"
        nas.mkdir()
        await_gone(client, f"/v1/jobs/{job}")
        assert (nas / job / "delivery.json").is_file()
