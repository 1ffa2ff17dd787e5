"""Captures and sessions over HTTP, against a running service: uploads, what is refused, features, erasure."""

import shutil
from pathlib import Path

import httpx
import pytest

from server.cli.client import Client, ServiceError
from tests.server.http.test_hostile import SPOILT
from tests.support.services import RunningService, await_state, packed, small_capture, stored, upload
from tests.support.small_captures import remove


def test_upload_and_job_in_one_call(http: httpx.Client, archive: bytes) -> None:
    response = upload(http, archive, "/v1/reconstructions", settings='{"method": "simplex"}')
    assert response.status_code == 202
    job = await_state(http, response.headers["location"].rsplit("/", 1)[1], ("succeeded",))
    assert job["settings"] == {"method": "simplex"}


@pytest.mark.parametrize(
    ("path", "field", "word"),
    [
        ("/v1/reconstructions", "settigns", "did you mean 'settings'?"),
        ("/v1/reconstructions", "webhook", "there are file, session, label"),
        ("/v1/captures/uploads", "settings", "there are file, session, label"),
    ],
)
def test_a_form_field_that_nobody_knows_is_named(
    service: RunningService, http: httpx.Client, archive: bytes, path: str, field: str, word: str
) -> None:
    before = stored(service)
    refused = upload(http, archive, path, **{field: "{}"})
    assert (refused.status_code, refused.json()["type"]) == (422, "urn:eigenhead:problem:invalid-form")
    assert [word in fault and repr(field) in fault for fault in refused.json()["errors"]] == [True]
    assert stored(service) == before


BAD = {case: SPOILT[case] for case in ("missing image", "NaN in a rotation", "image of another size")}
BAD |= {"cut off": (bool, "damaged or cut off"), "no cameras": (remove("cameras.json"), "contains no cameras.json")}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_capture_gets_422_by_name_and_leaves_nothing(
    service: RunningService, http: httpx.Client, tmp_path: Path, case: str
) -> None:
    """Eighty more, as captures alone, in ``test_hostile``."""
    (spoil, word), folder = BAD[case], small_capture(tmp_path / "capture")
    spoil(folder)
    data = packed(folder)
    before = stored(service)
    for path in ("/v1/captures/uploads", "/v1/reconstructions"):
        response = upload(http, data[:5000] if case == "cut off" else data, path)
        assert response.status_code == 422
        assert response.headers["content-type"] == "application/problem+json"
        assert any(word in error for error in response.json()["errors"])
    assert stored(service) == before


def test_photographs_too_few_to_do_without_cameras_say_what_is_missing(http: httpx.Client, tmp_path: Path) -> None:
    folder = small_capture(tmp_path / "capture")
    for name in ("cameras.json", "images/cam01.png", "images/cam02.png"):
        (folder / name).unlink()
    shutil.rmtree(folder / "background")
    errors = upload(http, packed(folder)).json()["errors"]
    assert "contains no cameras.json" in errors[0]
    assert errors[1].startswith("1 photograph; at least 3")


def test_a_capture_in_use_is_not_removed_and_a_finished_job_is(http: httpx.Client, capture: str) -> None:
    job = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
    assert http.delete(f"/v1/captures/{capture}").status_code == 409
    assert http.delete(f"/v1/jobs/{job}").status_code in (204, 409)
    await_state(http, job, ("succeeded",))
    assert http.delete(f"/v1/captures/{capture}").status_code == 204
    assert http.get(f"/v1/captures/{capture}").status_code == 404
    assert http.get(f"/v1/jobs/{job}/result/head.ply").status_code == 200
    assert http.post(f"/v1/jobs/{job}/restart").status_code == 404
    assert http.delete(f"/v1/jobs/{job}").status_code == 204
    assert http.get(f"/v1/jobs/{job}").status_code == 404


def test_features_are_stored_or_refused_by_name(http: httpx.Client, service: RunningService, capture: str) -> None:
    points = {"pronasale": {"cam00": [3.0, 4.0], "cam01": [5.0, 6.0]}}
    assert http.put(f"/v1/captures/{capture}/features", json={"points": points}).json()["features"] is True
    assert http.get(f"/v1/captures/{capture}/features").json()["points"] == points
    wrong = {"pronasale": {"cam09": [1, 2], "cam00": [900, 2]}}
    stored = service.data / "captures" / capture / "files" / "features.json"
    whole = stored.read_bytes()
    for damaged in (b"", b"[]", b'{"points": 3}'):
        stored.write_bytes(damaged)
        assert http.get(f"/v1/captures/{capture}/features").status_code == 404
    stored.write_bytes(whole)
    bad = http.put(f"/v1/captures/{capture}/features", json={"points": wrong})
    assert bad.status_code == 422
    assert len(bad.json()["errors"]) == 2
    assert http.get(f"/v1/captures/{capture}/features").json()["points"] == points


def test_labels_and_sessions_can_be_put_right(http: httpx.Client, archive: bytes) -> None:
    session = http.post("/v1/sessions", json={"label": "Anna"}).json()["id"]
    capture = upload(http, archive, label="first").json()["id"]
    moved = http.patch(f"/v1/captures/{capture}", json={"session": session, "expression": "smile"}).json()
    assert (moved["session"], moved["label"], moved["expression"]) == (session, "first", "smile")
    assert http.get(f"/v1/sessions/{session}").json()["captures"] == [capture]
    renamed = http.patch(f"/v1/sessions/{session}", json={"consent": "signed"}).json()
    assert (renamed["label"], renamed["consent"], renamed["captures"]) == ("Anna", "signed", [capture])
    assert http.patch(f"/v1/captures/{capture}", json={"session": "0" * 28}).status_code == 404
    assert http.patch(f"/v1/captures/{capture}", json={"name": "x"}).status_code == 422
    alone = http.patch(f"/v1/captures/{capture}", json={"session": None}).json()
    assert (alone["session"], alone["expression"]) == (None, "smile")


def test_a_resumable_upload_goes_on_after_a_break(http: httpx.Client, archive: bytes) -> None:
    tus = {"Tus-Resumable": "1.0.0"}
    created = http.post("/v1/uploads", headers=tus | {"Upload-Length": str(len(archive))})
    assert created.status_code == 201
    where, part = created.headers["location"], tus | {"Content-Type": "application/offset+octet-stream"}
    first = http.patch(where, content=archive[:7000], headers=part | {"Upload-Offset": "0"})
    assert (first.status_code, first.headers["upload-offset"]) == (204, "7000")
    assert http.head(where, headers=tus).headers["upload-offset"] == "7000"
    assert http.patch(where, content=b"x", headers=part | {"Upload-Offset": "0"}).status_code == 409
    wrong = part | {"Upload-Offset": "7000", "Upload-Checksum": "sha256 AAAA"}
    assert http.patch(where, content=archive[7000:8000], headers=wrong).status_code == 460
    assert http.head(where, headers=tus).headers["upload-offset"] == "7000"
    last = http.patch(where, content=archive[7000:], headers=part | {"Upload-Offset": "7000"})
    assert last.status_code == 204
    assert http.get(last.headers["location"]).status_code == 200
    assert http.head(where, headers=tus).headers["location"] == last.headers["location"]


def test_a_resumed_bad_capture_gets_422(service: RunningService, http: httpx.Client, archive: bytes) -> None:
    before = stored(service)
    tus, data = {"Tus-Resumable": "1.0.0"}, archive[:5000]
    where = http.post("/v1/uploads", headers=tus | {"Upload-Length": str(len(data))}).headers["location"]
    part = tus | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    response = http.patch(where, content=data, headers=part)
    assert response.status_code == 422
    assert "damaged" in response.json()["errors"][0]
    assert stored(service) == before


def test_the_client_uploads_folders_and_checks_downloads(client: Client, tmp_path: Path) -> None:
    session = client.post("/v1/sessions", {"label": "Ä"})["id"]
    capture = client.upload(small_capture(tmp_path / "capture"), session=session, label="links")
    assert (capture["session"], capture["label"]) == (session, "links")
    job = client.wait(client.submit(capture["id"])["id"])
    paths = client.download(job["id"], tmp_path / "out")
    assert sorted(path.relative_to(tmp_path / "out").as_posix() for path in paths) == sorted(job["files"])
    (tmp_path / "capture" / "images" / "cam00.png").unlink()
    with pytest.raises(ServiceError, match=r"images/cam00.png is missing") as caught:
        client.upload(tmp_path / "capture")
    assert caught.value.status == 422


def test_a_session_without_captures_is_asked_as_much(http: httpx.Client) -> None:
    session = http.post("/v1/sessions", json={}).json()["id"]
    refused = http.post(f"/v1/sessions/{session}/jobs", json={"settings": {"detial": "fine"}})
    assert (refused.status_code, "did you mean 'detail'" in refused.text) == (422, True)


def test_a_change_may_be_for_one_state_alone_and_head_is_get_without_body(http: httpx.Client, archive: bytes) -> None:
    path = f"/v1/captures/{upload(http, archive).json()['id']}"
    got = http.get(path)
    known = {"If-Match": got.headers["ETag"]}
    for address in (path, "/v1/captures", "/v1/info", "/readyz"):
        head = http.head(address)
        assert (head.status_code, head.content) == (http.get(address).status_code, b"")
        assert head.headers["content-type"] == "application/json"
    assert http.patch(path, json={"label": "anna"}, headers=known).status_code == 200
    late = http.patch(path, json={"label": "ben"}, headers=known)
    assert (late.status_code, late.json()["type"]) == (412, "urn:eigenhead:problem:changed-since")
    assert http.delete(path, headers=known).status_code == 412
    assert http.get(path).json()["label"] == "anna"
    assert http.patch(path, json={"label": "ben"}, headers={"If-Match": '"x", *'}).status_code == 200
    assert http.patch(path, json={"label": "cleo"}).status_code == 200
    assert http.delete(path, headers={"If-Match": http.get(path).headers["ETag"]}).status_code == 204
    assert http.delete(path, headers=known).status_code == 404
    assert http.head(path).status_code == 404
