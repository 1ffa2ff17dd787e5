"""Batches over HTTP: begun in three ways, counted, paused, tried again, cancelled; behind the jobs of others."""

import csv
import io
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pyarrow.parquet
import pytest

from tests.support.loopback import hooked
from tests.support.services import (
    RunningService,
    await_state,
    await_true,
    awaited,
    kill_workers,
    running_service,
    served_client,
    uploaded_capture,
)

URN = "urn:eigenhead:problem:"


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    """Its jobs take 0.2 s, one after the other."""
    with running_service(tmp_path_factory.mktemp("batches") / "data", batch_captures="8") as running:
        yield running


@pytest.fixture(scope="module")
def captures(service: RunningService, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Labelled "subject 0" to "subject 4"."""
    folder = tmp_path_factory.mktemp("captures")
    return [uploaded_capture(service, folder, seed) for seed in range(5)]


def begin(http: httpx.Client, **wanted: object) -> dict[str, Any]:
    answer = http.post("/v1/batches", json=wanted)
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/v1/batches/{answer.json()['id']}"
    return answer.json()


def batch_once(http: httpx.Client, batch: str, reached: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    return awaited(lambda: http.get(f"/v1/batches/{batch}").json(), reached)


def finished(batch: dict[str, Any]) -> bool:
    return batch["finished"] is not None


def counted(batch: dict[str, Any]) -> dict[str, int]:
    return {state: count for state, count in batch["counts"].items() if count}


def test_a_batch_makes_a_job_of_each_capture_and_says_how_far_it_is(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures[:3], label="walk", settings={"detail": "span"})
    assert (batch["state"], batch["total"], batch["priority"], batch["queue"]) == ("running", 3, 500, "cpu")
    halfway = batch_once(http, batch["id"], lambda b: 0 < b["counts"]["succeeded"] < 3)
    assert 0 <= halfway["eta_s"] < 60  # on SQLite the engine's moments are whole seconds, and these jobs shorter
    done = batch_once(http, batch["id"], finished)
    assert (done["state"], counted(done), done["eta_s"]) == ("finished", {"succeeded": 3}, None)
    jobs = http.get("/v1/jobs", params={"batch": batch["id"], "sort": "created"}).json()
    assert jobs["total"] == 3
    assert {job["capture_id"] for job in jobs["jobs"]} == set(captures[:3])
    assert {(job["name"], job["priority"]) for job in jobs["jobs"]} == {("walk", 500)}
    assert [job["settings"] for job in jobs["jobs"]] == 3 * [{"detail": "span"}]
    assert http.get("/v1/jobs", params={"batch": "0" * 28}).json()["total"] == 0


def test_captures_are_named_by_session_or_by_how_their_labels_begin(http: httpx.Client, captures: list[str]) -> None:
    session = http.post("/v1/sessions", json={"label": "Wanda"}).json()["id"]
    http.post("/v1/captures/bulk", json={"action": "move", "ids": captures[:2], "session": session})
    of_session = batch_once(http, begin(http, session=session)["id"], finished)
    jobs = http.get("/v1/jobs", params={"batch": of_session["id"]}).json()["jobs"]
    assert {job["capture_id"] for job in jobs} == set(captures[:2])
    assert batch_once(http, begin(http, prefix="SUBJECT ")["id"], finished)["total"] == len(captures)
    assert batch_once(http, begin(http, prefix="subject 3")["id"], finished)["total"] == 1
    http.post("/v1/captures/bulk", json={"action": "move", "ids": captures[:2], "session": None})


def test_the_same_request_with_the_same_key_is_one_batch(http: httpx.Client, captures: list[str]) -> None:
    head = {"Idempotency-Key": "twice"}
    wanted = {"captures": captures[:1], "label": "once"}
    first, again = (http.post("/v1/batches", json=wanted, headers=head).json()["id"] for _ in range(2))
    assert first == again
    other = http.post("/v1/batches", json=wanted | {"priority": 600}, headers=head)
    assert (other.status_code, other.json()["type"]) == (409, URN + "idempotency-conflict")
    assert http.get("/v1/batches", params={"q": "once"}).json()["total"] == 1


@pytest.mark.parametrize(
    ("wanted", "kind", "faults"),
    [
        ({}, "invalid-request", ["Name the captures in one way"]),
        ({"session": "0" * 28, "prefix": "x"}, "invalid-request", ["Name the captures in one way"]),
        ({"prefix": "nobody is called so"}, "invalid-captures", ["no capture of a head was selected"]),
        ({"prefix": "%"}, "invalid-captures", ["no capture of a head was selected"]),
        ({"captures": ["0" * 28, "0" * 28]}, "invalid-captures", ["named 2 times", "there is no capture 000"]),
        ({"captures": ["../../etc/passwd"]}, "invalid-request", ["pattern"]),
        ({"captures": [f"{n:028x}" for n in range(9)]}, "invalid-captures", ["9 captures are more than the 8"]),
        ({"captures": [f"{n:028x}" for n in range(100_001)]}, "invalid-request", ["at most 100000 items"]),
        ({"session": "0" * 28}, "not-found", []),
        ({"prefix": "subject", "settings": {"detail": "finest"}}, "invalid-settings", ["finest"]),
        ({"prefix": "subject", "model": "nobody's"}, "invalid-model", ["not at hand"]),
        ({"prefix": "subject", "queue": "fast"}, "invalid-queue", ["is no queue"]),
        ({"prefix": "subject", "label": "a\x00b"}, "invalid-request", ["pattern"]),
        ({"prefix": "subject", "shoe": 1}, "invalid-request", ["unknown key shoe"]),
    ],
)
def test_what_cannot_be_begun_is_refused_with_every_fault(
    http: httpx.Client, captures: list[str], wanted: dict[str, object], kind: str, faults: list[str]
) -> None:
    before = http.get("/v1/batches").json()["total"]
    answer = http.post("/v1/batches", json=wanted)
    problem = answer.json()
    assert (answer.status_code, problem["type"]) == (404 if kind == "not-found" else 422, URN + kind), problem
    assert len(problem["errors"]) >= len(faults)
    assert all(any(fault in error for error in problem["errors"]) for fault in faults), problem
    assert http.get("/v1/batches").json()["total"] == before


@pytest.mark.parametrize("action", ["pause", "resume", "cancel", "retry", "", "table", "sheet"])
def test_a_batch_that_is_not_there_is_not_found(http: httpx.Client, action: str) -> None:
    for identity in ("0" * 28, "x", "%00"):
        address = f"/v1/batches/{identity}/{action}".rstrip("/")
        answer = http.get(address) if action in ("", "table", "sheet") else http.post(address)
        assert (answer.status_code, answer.json()["type"]) == (404, URN + "not-found"), address


def test_a_paused_batch_takes_back_what_waits_and_goes_on_later(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures, label="pause")["id"]
    batch_once(http, batch, lambda b: b["counts"]["succeeded"] >= 1)
    assert http.post(f"/v1/batches/{batch}/pause").json()["state"] == "paused"
    still = batch_once(http, batch, lambda b: not b["counts"]["queued"] and not b["counts"]["running"])
    assert still["counts"]["waiting"] + still["counts"]["succeeded"] == 5
    assert still["counts"]["waiting"] >= 1
    time.sleep(1.0)
    assert http.get(f"/v1/batches/{batch}").json()["counts"] == still["counts"]
    assert http.get("/v1/jobs", params={"batch": batch}).json()["total"] == still["counts"]["succeeded"]
    assert http.get("/v1/jobs", params={"state": "cancelled", "q": "pause"}).json()["total"] == 0
    assert http.post(f"/v1/batches/{batch}/resume").json()["state"] == "running"
    assert counted(batch_once(http, batch, finished)) == {"succeeded": 5}
    for action in ("pause", "resume"):
        answer = http.post(f"/v1/batches/{batch}/{action}")
        assert (answer.status_code, answer.json()["type"]) == (409, URN + "batch-ended")


def test_a_cancelled_batch_keeps_its_heads_and_ends_for_good(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures, settings={"front": "long"})["id"]
    batch_once(http, batch, lambda b: b["counts"]["running"] == 1)
    answer = http.delete(f"/v1/batches/{batch}")
    assert (answer.status_code, answer.json()["type"]) == (409, URN + "batch-active")
    assert http.post(f"/v1/batches/{batch}/cancel").json()["state"] == "cancelled"
    ended = batch_once(http, batch, finished)
    assert (ended["state"], counted(ended)) == ("cancelled", {"cancelled": 5})
    assert http.post(f"/v1/batches/{batch}/cancel").json()["state"] == "cancelled"
    for action in ("retry", "resume", "pause"):
        answer = http.post(f"/v1/batches/{batch}/{action}")
        assert (answer.status_code, answer.json()["type"]) == (409, URN + "batch-ended")
    assert http.get("/v1/batches", params={"state": "cancelled"}).json()["total"] == 1
    assert http.delete(f"/v1/batches/{batch}").status_code == 204
    assert http.get(f"/v1/batches/{batch}").status_code == 404


def test_failed_captures_are_tried_again_and_no_others(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures[:2], settings={"front": "fail"})["id"]
    assert counted(batch_once(http, batch, finished)) == {"failed": 2}
    shown = http.get("/metrics").text
    assert 'eigenhead_failures{kind="invalid-capture"} 2.0' in shown
    assert 'eigenhead_worker_slots{queue="cpu"} 1.0' in shown
    failed = {job["id"] for job in http.get("/v1/jobs", params={"batch": batch}).json()["jobs"]}
    again = http.post(f"/v1/batches/{batch}/retry").json()
    assert (again["state"], again["finished"]) == ("running", None)
    batch_once(http, batch, finished)
    jobs = {job["id"] for job in http.get("/v1/jobs", params={"batch": batch}).json()["jobs"]}
    assert len(jobs) == 2
    assert not jobs & failed
    good = batch_once(http, begin(http, captures=captures[:1])["id"], finished)["id"]
    answer = http.post(f"/v1/batches/{good}/retry")
    assert (answer.status_code, answer.json()["type"]) == (409, URN + "none-failed")


def test_the_erased_is_counted_and_leaves_nothing(service: RunningService, http: httpx.Client, tmp_path: Path) -> None:
    """Captures that wait, one whose job runs, and one that is done."""
    session = http.post("/v1/sessions", json={"label": "Erased Elif"}).json()["id"]
    theirs = [uploaded_capture(service, tmp_path, seed) for seed in range(20, 24)]
    http.post("/v1/captures/bulk", json={"action": "move", "ids": theirs, "session": session})
    batch = begin(http, captures=theirs)["id"]
    batch_once(http, batch, lambda b: b["counts"]["succeeded"] >= 1)
    assert http.delete(f"/v1/sessions/{session}").status_code == 204
    ended = batch_once(http, batch, finished)
    assert counted(ended) == {"removed": 4}
    table = http.get(f"/v1/batches/{batch}/table").text
    assert not any(capture in table for capture in theirs)
    assert http.get("/v1/jobs", params={"batch": batch}).json()["total"] == 0


def test_a_removed_capture_holds_no_other_up(service: RunningService, http: httpx.Client, tmp_path: Path) -> None:
    theirs = [uploaded_capture(service, tmp_path, seed) for seed in range(30, 33)]
    batch = begin(http, captures=theirs)["id"]
    http.post(f"/v1/batches/{batch}/pause")
    batch_once(http, batch, lambda b: not b["counts"]["queued"] and not b["counts"]["running"])
    before = http.get(f"/v1/batches/{batch}").json()["counts"]
    assert before["waiting"] >= 1, "the last of them waits"
    assert http.delete(f"/v1/captures/{theirs[2]}").status_code == 204
    http.post(f"/v1/batches/{batch}/resume")
    assert counted(batch_once(http, batch, finished)) == {"succeeded": 2, "removed": 1}


def test_the_table_and_the_sheet_are_those_of_the_command_line(tmp_path: Path) -> None:
    """Of results that have what a head's have."""
    with served_client(tmp_path / "data", work="tests.support.tiny:reporting") as (service, http):
        captures = [uploaded_capture(service, tmp_path, seed) for seed in (1, 2)]
        batch = begin(http, captures=captures, label="Study <4>")["id"]
        waiting = http.get(f"/v1/batches/{batch}/table")
        assert [row["state"] for row in csv.DictReader(io.StringIO(waiting.text))] != ["done", "done"]
        batch_once(http, batch, finished)
        answer = http.get(f"/v1/batches/{batch}/table")
        assert answer.headers["content-type"].startswith("text/csv")
        rows = [*csv.DictReader(io.StringIO(answer.text, newline=""))]
        assert [(row["capture"], row["subject"], row["state"]) for row in rows] == [
            (captures[0], "subject 1", "done"),
            (captures[1], "subject 2", "done"),
        ]
        assert all(len(row["input_sha256"]) == 64 for row in rows)
        assert rows[0]["input_sha256"] != rows[1]["input_sha256"]
        parquet = http.get(f"/v1/batches/{batch}/table", params={"format": "parquet"})
        table = pyarrow.parquet.read_table(io.BytesIO(parquet.content))
        assert table.column_names == list(rows[0])
        assert http.get(f"/v1/batches/{batch}/table", params={"format": "xls"}).status_code == 422
        sheet = http.get(f"/v1/batches/{batch}/sheet")
        assert sheet.headers["content-type"].startswith("text/html")
        assert "default-src 'none'" in sheet.headers["content-security-policy"]
        assert "<h1>Study &lt;4&gt;</h1>" in sheet.text
        assert sheet.text.count("data:image/jpeg") == 2
        pdf = http.get(f"/v1/batches/{batch}/sheet", params={"format": "pdf"})
        assert (pdf.headers["content-type"], pdf.content[:5]) == ("application/pdf", b"%PDF-")
        assert pdf.content.count(b"/DCTDecode") == 2  # a picture each, as JPEG


def test_webhooks_hear_once_of_each_end_of_a_batch(http: httpx.Client, captures: list[str]) -> None:
    with hooked() as receiver:
        hook = http.post("/v1/webhooks", json={"url": receiver.url}).json()["id"]
        batch = begin(http, captures=captures[:1], settings={"front": "fail"})["id"]
        for times in (1, 2):
            batch_once(http, batch, finished)
            await_true(lambda: len(receiver.data_of("batch.finished")) >= times)  # noqa: B023
            time.sleep(0.5)
            assert receiver.data_of("batch.finished") == times * [{"batch_id": batch}]
            if times == 1:
                http.post(f"/v1/batches/{batch}/retry")
        http.delete(f"/v1/webhooks/{hook}")


def test_an_operators_shot_goes_before_the_batch(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures)["id"]
    batch_once(http, batch, lambda b: b["counts"]["running"] == 1)
    job = http.post("/v1/jobs", json={"capture_id": captures[0]}).json()
    assert job["ahead"] <= 1, "only the one that runs"
    done = await_state(http, job["id"], ("succeeded",))
    assert http.get(f"/v1/batches/{batch}").json()["counts"]["succeeded"] <= 3
    assert done["priority"] == 100
    batch_once(http, batch, finished)


def test_batches_of_a_key_have_a_limit_and_their_jobs_none(tmp_path: Path) -> None:
    bounds = {"batches_per_key": "1", "jobs_per_key": "1"}
    with served_client(tmp_path / "data", worker=False, **bounds) as (service, http):
        captures = [uploaded_capture(service, tmp_path, seed) for seed in (1, 2)]
        batch = begin(http, captures=captures)
        assert batch_once(http, batch["id"], lambda b: b["counts"]["queued"] == 2)["state"] == "running"
        assert http.post("/v1/jobs", json={"capture_id": captures[0]}).status_code == 202
        answer = http.post("/v1/batches", json={"captures": captures})
        assert (answer.status_code, answer.json()["type"]) == (429, URN + "too-many-batches")
        assert int(answer.headers["retry-after"]) > 0


def test_a_queue_that_nobody_serves_is_said(http: httpx.Client, captures: list[str]) -> None:
    batch = begin(http, captures=captures[:2], queue="gpu")
    assert "No worker serves the queue 'gpu'" in batch["notice"]
    batch_once(http, batch["id"], lambda b: b["counts"]["queued"] == 2)
    check = http.get("/readyz").json()["checks"]["queues"]
    assert (check["ok"], check["detail"]) == (True, "2 jobs wait in queues without a worker: gpu")
    http.post(f"/v1/batches/{batch['id']}/cancel")
    batch_once(http, batch["id"], finished)
    served = http.get("/readyz").json()["checks"]["queues"]["detail"]
    assert served == "there is a worker for every queue with waiting jobs"


def test_batches_are_listed_by_pages_newest_first(http: httpx.Client, captures: list[str]) -> None:
    made = [begin(http, captures=captures[:1], label=f"Listed {number}")["id"] for number in range(3)]
    found, cursor = [], {}
    while True:
        page = http.get("/v1/batches", params={"q": "listed", "limit": 2} | cursor).json()
        assert page["total"] == 3
        found += [batch["id"] for batch in page["batches"]]
        if page["next"] is None:
            break
        cursor = {"cursor": page["next"]}
    assert found == made[::-1]
    for query in ({"cursor": "x"}, {"limit": 0}, {"state": "fine"}):
        assert http.get("/v1/batches", params=query).status_code == 422
    for batch in made:
        batch_once(http, batch, finished)
    assert http.get("/v1/batches", params={"q": "listed", "state": "finished"}).json()["total"] == 3
    assert http.get("/v1/batches", params={"q": "listed", "state": "running"}).json()["total"] == 0


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_capture_that_kills_workers_is_set_aside_and_the_others_are_made(tmp_path: Path) -> None:
    """Each time the first capture's job runs its worker is killed, as by the kernel's out-of-memory killer."""
    with served_client(tmp_path / "data", attempts="2", tiny_s="1.5", silent_s="5") as (service, http):
        captures = [uploaded_capture(service, tmp_path, seed) for seed in range(3)]
        batch = begin(http, captures=captures)["id"]
        deadline, kills = time.monotonic() + 200, 0
        while True:
            jobs = http.get("/v1/jobs", params={"batch": batch, "capture": captures[0]}).json()["jobs"]
            if jobs and jobs[0]["state"] in ("failed", "succeeded"):
                break
            if jobs and re.findall(f"{jobs[0]['id']} stage=read", service.log.read_text())[kills:]:
                kills += 1
                kill_workers(service)
            assert time.monotonic() < deadline
            time.sleep(0.2)
        assert (jobs[0]["state"], jobs[0]["error"]["type"]) == ("failed", URN + "worker-died")
        assert counted(batch_once(http, batch, finished)) == {"failed": 1, "succeeded": 2}
