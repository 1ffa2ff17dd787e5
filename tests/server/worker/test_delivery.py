"""Results delivered to an object store: each file whole and equal, the manifest last, the webhook after it; also where
the store is away, the worker is killed, or the job is removed meanwhile."""

import hashlib
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.support.loopback import Hook, hooked
from tests.support.object_server import KEYS, Network, client_of
from tests.support.services import (
    RunningService,
    await_state,
    await_true,
    awaited,
    kill_workers,
    packed_capture,
    running_service,
)

NAMES = {"head.glb", "head.ply", "overlays/cam00.png"}


@pytest.fixture(scope="module")
def bucket(object_server: str) -> Any:
    client = client_of(object_server, "studio-out")
    client.put_object(Bucket="studio-out", Key="first", Body=b"makes the server take up its disk")
    return client


@pytest.fixture(scope="module")
def hook() -> Iterator[Hook]:
    with hooked() as hook:
        yield hook


@pytest.fixture(scope="module")
def service(way: Network, hook: Hook, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    folder = tmp_path_factory.mktemp("service")
    (folder / "nas").mkdir()
    with running_service(
        folder / "data",
        variables=KEYS,
        tiny_s="0.02",
        deliver_prefixes=f'["s3://studio-out/heads/", "s3://nobody/", "file://{folder}/nas/"]',
        webhook_origins=f'["{hook.url}"]',
        store_endpoint=way.url,
        store_timeout_s="1",
        silent_s="3",
    ) as service:
        yield service


def submitted(client: httpx.Client, capture: str, to: str, **more: Any) -> str:
    answer = client.post("/v1/jobs", json={"capture_id": capture, "deliver_to": to} | more)
    assert answer.status_code == 202, answer.text
    return answer.json()["id"]


def delivery_in(client: httpx.Client, job: str, state: str) -> dict[str, Any]:
    """The job, once its delivery is in that state."""
    return awaited(lambda: client.get(f"/v1/jobs/{job}").json(), lambda found: found["delivery"]["state"] == state)


def delivered(bucket: Any, job: str, below: str = "heads/") -> dict[str, bytes]:
    prefix = f"{below}{job}/"
    listed = bucket.list_objects_v2(Bucket="studio-out", Prefix=prefix).get("Contents", ())
    keys = [entry["Key"] for entry in listed]
    return {key.removeprefix(prefix): bucket.get_object(Bucket="studio-out", Key=key)["Body"].read() for key in keys}


def test_a_result_is_delivered_and_the_webhook_says_where(
    client: httpx.Client, capture: str, bucket: Any, hook: Hook, way: Network
) -> None:
    way.seen.clear()
    job = submitted(client, capture, "s3://studio-out/heads/study 4", webhook={"url": hook.url})
    document = delivery_in(client, job, "delivered")
    place = f"s3://studio-out/heads/study 4/{job}/"
    assert document["delivery"] == {"to": place, "state": "delivered", "error": None}
    await_true(lambda: hook.data_of("job.delivered", job))
    assert hook.data_of("job.delivered", job) == [{"job_id": job, "delivered_to": place}]
    assert hook.data_of("job.succeeded", job) == [{"job_id": job}]
    files = delivered(bucket, job, "heads/study 4/")
    manifest = json.loads(files.pop("delivery.json"))
    assert {*files} == NAMES
    assert manifest == {
        "format": "eigenhead-delivery/1",
        "job_id": job,
        "capture_id": capture,
        "files": document["files"],
    }
    assert {name: hashlib.sha256(data).hexdigest() for name, data in files.items()} == {
        name: file["sha256"] for name, file in document["files"].items()
    }
    written = [path for method, path in way.seen if method == "PUT"]
    assert [path.rpartition("/")[2] for path in written][-1] == "delivery.json"


@pytest.mark.parametrize("fault", ["503", "silent", "flipped"])
def test_a_delivery_waits_for_the_store_and_other_jobs_go_on(
    fault: Any, client: httpx.Client, capture: str, bucket: Any, way: Network
) -> None:
    way.fail(fault, 10_000, "PUT")
    job = submitted(client, capture, "s3://studio-out/heads/")
    await_state(client, job, ("succeeded",))
    await_true(lambda: ("PUT", f"/studio-out/heads/{job}/head.glb") in way.seen)
    other = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    assert await_state(client, other, ("succeeded",))["delivery"] is None
    assert client.get(f"/v1/jobs/{job}").json()["delivery"]["state"] == "delivering"
    assert client.post(f"/v1/jobs/{job}/delivery").status_code == 409
    assert delivered(bucket, job) == {}
    way.heal()
    delivery_in(client, job, "delivered")
    assert {*delivered(bucket, job)} == NAMES | {"delivery.json"}


@pytest.mark.slow
def test_a_killed_worker_leaves_a_delivery_that_another_ends(
    client: httpx.Client, capture: str, bucket: Any, way: Network, service: RunningService, hook: Hook
) -> None:
    way.fail("503", 10_000, "PUT", "cam00")
    job = submitted(client, capture, "s3://studio-out/heads/", webhook={"url": hook.url})
    await_true(lambda: any(job in path and "cam00" in path for method, path in way.seen if method == "PUT"))
    kill_workers(service)
    assert "delivery.json" not in delivered(bucket, job)
    way.heal()
    document = delivery_in(client, job, "delivered")
    files = delivered(bucket, job)
    del files["delivery.json"]
    assert {name: len(data) for name, data in files.items()} == {n: f["bytes"] for n, f in document["files"].items()}
    await_true(lambda: hook.data_of("job.delivered", job))
    assert len([path for method, path in way.seen if method == "PUT" and path.endswith(f"{job}/head.glb")]) == 1


def test_what_the_store_refuses_fails_and_is_delivered_elsewhere(
    client: httpx.Client, capture: str, service: RunningService, hook: Hook
) -> None:
    job = submitted(client, capture, "s3://nobody/", webhook={"url": hook.url})
    document = delivery_in(client, job, "failed")
    assert document["state"] == "succeeded"
    assert document["delivery"]["error"]["type"] == "urn:eigenhead:problem:store-denied"
    assert "NoSuchBucket" in document["delivery"]["error"]["detail"]
    await_true(lambda: hook.data_of("job.undelivered", job))
    nas = service.data.parent / "nas"
    again = client.post(f"/v1/jobs/{job}/delivery", json={"to": f"file://{nas}/heads"})
    assert again.status_code == 202, again.text
    delivery_in(client, job, "delivered")
    there = {path.relative_to(nas / "heads" / job).as_posix() for path in (nas / "heads").rglob("*") if path.is_file()}
    assert there == NAMES | {"delivery.json"}


def test_a_job_removed_meanwhile_is_undelivered(client: httpx.Client, capture: str, bucket: Any, way: Network) -> None:
    way.fail("503", 10_000, "PUT")
    job = submitted(client, capture, "s3://studio-out/heads/")
    await_true(lambda: any(job in path for _, path in way.seen))
    await_state(client, job, ("succeeded",))
    assert client.delete(f"/v1/jobs/{job}").status_code == 204
    way.heal()
    other = submitted(client, capture, "s3://studio-out/heads/")
    delivery_in(client, other, "delivered")
    time.sleep(1.5)  # the first pause of one that waits
    await_true(lambda: not delivered(bucket, job))  # a file that was on its way is taken back


def test_a_batch_delivers_each_of_its_results(client: httpx.Client, capture: str, bucket: Any) -> None:
    wanted = {"captures": [capture], "deliver_to": "s3://studio-out/heads/batch/"}
    batch = client.post("/v1/batches", json=wanted).json()
    assert batch["deliver_to"] == "s3://studio-out/heads/batch/"
    await_true(lambda: client.get("/v1/jobs", params={"batch": batch["id"]}).json()["total"])
    (job,) = client.get("/v1/jobs", params={"batch": batch["id"]}).json()["jobs"]
    delivery_in(client, job["id"], "delivered")
    assert {*delivered(bucket, job["id"], "heads/batch/")} == NAMES | {"delivery.json"}


def test_an_upload_with_its_job_says_where_to(client: httpx.Client, bucket: Any, tmp_path: Path) -> None:
    files = {"file": packed_capture(tmp_path, 3).read_bytes()}
    away = client.post("/v1/reconstructions", files=files, data={"deliver_to": "s3://studio-out/"})
    assert (away.status_code, away.json()["type"]) == (422, "urn:eigenhead:problem:url-refused")
    made = client.post("/v1/reconstructions", files=files, data={"deliver_to": "s3://studio-out/heads/"}).json()
    delivery_in(client, made["id"], "delivered")
    assert "delivery.json" in delivered(bucket, made["id"])


def test_a_place_that_is_not_allowed_is_refused(client: httpx.Client, capture: str) -> None:
    for to in ("s3://studio-out/", "s3://studio-out/heads/../x", "file:///etc/"):
        for path, which in (("/v1/jobs", {"capture_id": capture}), ("/v1/batches", {"captures": [capture]})):
            answer = client.post(path, json=which | {"deliver_to": to})
            assert (answer.status_code, answer.json()["type"]) == (422, "urn:eigenhead:problem:url-refused"), to
    job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    await_state(client, job, ("succeeded",))
    answer = client.post(f"/v1/jobs/{job}/delivery")
    assert answer.status_code == 422
    assert "without a place" in answer.text


def test_a_failed_job_delivers_nothing(client: httpx.Client, capture: str, bucket: Any) -> None:
    job = submitted(client, capture, "s3://studio-out/heads/", settings={"front": "fail"})
    await_state(client, job, ("failed",))
    assert client.get(f"/v1/jobs/{job}").json()["delivery"]["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{job}/delivery").status_code == 409
    assert delivered(bucket, job) == {}
