"""Results in an object store: a job has succeeded once its result is there; the data folder is a bounded cache; what is
erased is gone with every version; a store that is away holds jobs up and makes no other 5xx than 503."""

import hashlib
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from server.storage.capture_blobs import SMALL_BYTES
from server.storage.store import new_id
from tests.support.object_server import KEYS, Network, client_of
from tests.support.services import (
    RunningService,
    await_state,
    await_true,
    packed,
    running_service,
    small_capture,
    upload,
    uploaded_capture,
)

NAMES = {"head.glb", "head.ply", "overlays/cam00.png"}


@pytest.fixture(scope="module")
def bucket(object_server: str) -> Any:
    client = client_of(object_server, "results")
    client.put_bucket_versioning(Bucket="results", VersioningConfiguration={"Status": "Enabled"})
    client.put_object(Bucket="results", Key="first", Body=b"makes the server take up its disk")
    return client


@pytest.fixture(scope="module")
def service(way: Network, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(
        tmp_path_factory.mktemp("service") / "data",
        variables=KEYS,
        tiny_s="0.02",
        tiny_bytes=str(1 << 20),
        results_store="s3://results/of/",
        results_bytes="0",
        captures_store="s3://results/captures/",
        captures_bytes="0",
        sweep_s="0.3",
        keep_unclaimed_days="0.00001",
        store_endpoint=way.url,
        store_timeout_s="1",
    ) as service:
        yield service


def submitted(client: httpx.Client, capture: str) -> str:
    return client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]


def listed(bucket: Any, job: str) -> set[str]:
    found = bucket.list_objects_v2(Bucket="results", Prefix=f"of/{job}/").get("Contents", ())
    return {entry["Key"].removeprefix(f"of/{job}/") for entry in found}


def age(folder: Path) -> None:
    """Makes files look unused for an hour."""
    for path in folder.rglob("*"):
        if path.is_file():
            os.utime(path, (time.time() - 3600, time.time() - 3600))


def test_a_result_goes_from_the_data_folder_and_comes_back(
    client: httpx.Client, capture: str, bucket: Any, service: RunningService, way: Network
) -> None:
    job = submitted(client, capture)
    files = await_state(client, job, ("succeeded",))["files"]
    assert {*files} == NAMES == listed(bucket, job)
    folder = service.data / "jobs" / job / "result"
    age(folder)
    await_true(lambda: not any(path.is_file() for path in folder.rglob("*")), 30)
    assert client.get(f"/v1/jobs/{job}").json()["notice"] is None
    for fault in ("503", "torn"):
        way.fail(fault, 1000, "GET")
        answer = client.get(f"/v1/jobs/{job}/result/head.ply")
        assert (answer.status_code, answer.headers["retry-after"]) == (503, "10"), answer.text
        way.heal()
    for name in NAMES:
        data = client.get(f"/v1/jobs/{job}/result/{name}").content
        assert hashlib.sha256(data).hexdigest() == files[name]["sha256"]
    assert client.get(f"/v1/jobs/{job}/result/all.zip").status_code == 200


def test_a_capture_goes_from_the_data_folder_and_comes_back(
    client: httpx.Client, bucket: Any, service: RunningService, way: Network, tmp_path: Path
) -> None:
    data = packed(small_capture(tmp_path / "large", 3, size=200))
    capture, again = (upload(client, data).json()["id"] for _ in range(2))
    folder = service.data / "captures" / capture / "files"
    pictures = {path.name: path.read_bytes() for path in (folder / "images").iterdir()}
    assert {len(content) > SMALL_BYTES for content in pictures.values()} == {True}

    def versions() -> set[str]:
        found = bucket.list_object_versions(Bucket="results", Prefix="captures/")
        parts = {kind: found.get(kind, ()) for kind in ("Versions", "DeleteMarkers")}
        names = [entry["Key"].split("/")[1].split("-")[0] for entries in parts.values() for entry in entries]
        return {
            name for name in names if name in {hashlib.sha256(content).hexdigest() for content in pictures.values()}
        }

    assert len(versions()) == len(pictures)

    def gone() -> bool:
        os.utime(folder, (time.time() - 7200, time.time() - 7200))
        return not [*folder.glob("images/*.png")]

    await_true(gone)
    way.fail("torn", 1000, "GET")
    assert client.get(f"/v1/captures/{capture}/images/cam00").status_code == 503
    way.heal()
    assert client.get(f"/v1/captures/{capture}/images/cam00").content == pictures["cam00.png"]
    await_true(gone)
    await_state(client, submitted(client, capture), ("succeeded",))
    assert {path.name: path.read_bytes() for path in (folder / "images").iterdir()} == pictures
    assert client.delete(f"/v1/captures/{again}").status_code == 204
    assert len(versions()) == len(pictures)  # the other has them still
    way.fail("503", 1000, "DELETE")
    way.fail("503", 1000, "POST")
    assert client.delete(f"/v1/captures/{capture}", params={"erase": True}).status_code == 503
    way.heal()
    assert client.delete(f"/v1/captures/{capture}", params={"erase": True}).status_code == 204
    await_true(lambda: not versions())  # a sweep that was storing the capture again takes that back


def test_capture_is_taken_while_store_is_away(client: httpx.Client, bucket: Any, way: Network, tmp_path: Path) -> None:
    way.fail("503", 10_000, "PUT")
    answer = upload(client, packed(small_capture(tmp_path / "late", 4)))
    assert answer.status_code == 201
    way.heal()
    record = (tmp_path / "late" / "cameras.json").read_bytes()
    await_true(
        lambda: hashlib.sha256(record).hexdigest() in str(bucket.list_objects_v2(Bucket="results", Prefix="captures/"))
    )


def test_a_job_waits_for_the_store_and_goes_on(client: httpx.Client, capture: str, bucket: Any, way: Network) -> None:
    way.fail("503", 10_000, "PUT")
    job = submitted(client, capture)
    await_true(lambda: any(job in path for method, path in way.seen if method == "PUT"), 60)
    assert client.get(f"/v1/jobs/{job}").json()["state"] == "running"
    way.heal()
    await_state(client, job, ("succeeded",), 60)
    assert listed(bucket, job) == NAMES
    way.fail("503", 10_000, "PUT")
    other = submitted(client, capture)
    await_true(lambda: any(other in path for method, path in way.seen if method == "PUT"))
    assert client.post(f"/v1/jobs/{other}/cancel").status_code == 200
    way.heal()
    await_state(client, other, ("cancelled",))
    await_true(lambda: not listed(bucket, other))


def test_a_result_is_fetched_from_the_store_itself(client: httpx.Client, bucket: Any, capture: str) -> None:
    job = submitted(client, capture)
    files = await_state(client, job, ("succeeded",))["files"]
    answer = client.get(f"/v1/jobs/{job}/result/overlays/cam00.png", params={"redirect": True})
    assert (answer.status_code, answer.headers["cache-control"]) == (307, "no-store")
    data = httpx.get(answer.headers["location"]).content
    assert hashlib.sha256(data).hexdigest() == files["overlays/cam00.png"]["sha256"]
    bucket.delete_object(Bucket="results", Key=f"of/{job}/head.ply")
    here = client.get(f"/v1/jobs/{job}/result/head.ply", params={"redirect": True})
    assert (here.status_code, hashlib.sha256(here.content).hexdigest()) == (200, files["head.ply"]["sha256"])
    assert client.get(f"/v1/jobs/{job}/result/none", params={"redirect": True}).status_code == 404


def figures(client: httpx.Client) -> dict[str, float]:
    lines = client.get("/metrics").text.splitlines()
    return {name: float(value) for name, value in (line.rsplit(" ", 1) for line in lines if line[0] != "#")}


def test_metrics_and_readiness_say_whether_the_store_answers(client: httpx.Client, way: Network) -> None:
    up, away = 'eigenhead_store_up{store="results"}', 'operation="list",outcome="unavailable"'
    await_true(lambda: figures(client)[up] == 1.0)
    assert (
        client.get("/readyz").json()["checks"]["store"]["detail"] == "s3://results/captures/, s3://results/of/ answers"
    )
    way.fail("503", 10_000)
    await_true(lambda: figures(client)[up] == 0.0)
    answer = client.get("/readyz")
    assert "/none/" in answer.json()["checks"]["store"]["detail"]  # of captures or results, whichever was asked first
    assert answer.json()["checks"]["store"]["ok"], "captures and jobs are taken, and wait"
    assert figures(client)[f"eigenhead_store_operations{{{away}}}"] >= 1
    way.heal()
    await_true(lambda: figures(client)[up] == 1.0)
    assert figures(client)['eigenhead_store_seconds{operation="list"}'] > 0


def test_what_no_job_claims_goes_and_what_one_claims_stays(client: httpx.Client, bucket: Any, capture: str) -> None:
    job, stray = submitted(client, capture), new_id()
    await_state(client, job, ("succeeded",))
    for key in (f"of/{stray}/head.ply", f"of/{stray}/overlays/cam00.png", "of/somebody's own/head.ply"):
        bucket.put_object(Bucket="results", Key=key, Body=b"a head")
    await_true(lambda: not listed(bucket, stray))
    assert listed(bucket, job) == NAMES
    assert listed(bucket, "somebody's own") == {"head.ply"}


def test_what_is_erased_is_gone_from_the_store_with_every_version(
    client: httpx.Client, bucket: Any, service: RunningService, way: Network, tmp_path: Path
) -> None:
    capture = uploaded_capture(service, tmp_path, 9)  # its own: tests of this file come in any order
    job = submitted(client, capture)
    await_state(client, job, ("succeeded",))
    bucket.put_object(Bucket="results", Key=f"of/{job}/head.ply", Body=b"another version")
    way.fail("503", 10_000)
    refused = client.delete(f"/v1/captures/{capture}", params={"erase": True})
    assert (refused.status_code, refused.headers["retry-after"]) == (503, "10")
    way.heal()
    assert client.delete(f"/v1/captures/{capture}", params={"erase": True}).status_code == 204
    left = bucket.list_object_versions(Bucket="results", Prefix=f"of/{job}/")
    assert not {"Versions", "DeleteMarkers"} & {*left}
    assert client.get(f"/v1/jobs/{job}").status_code == 404
    assert not (service.data / "jobs" / job).exists()
