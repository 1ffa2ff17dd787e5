"""What a removal leaves, what an erasure takes, and that consent comes first."""

import base64
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from server.settings import ServiceSettings
from tests.server.worker.test_durability import database
from tests.support.services import (
    RunningService,
    await_state,
    packed,
    packed_capture,
    running_service,
    served_client,
    small_capture,
    upload,
)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("erasure") / "data", ask_consent="true") as running:
        yield running


HOOK = "http://127.0.0.1:9"  # nobody answers there, so that its messages wait


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def test_nothing_that_the_subject_brought_is_left(kind: str, tmp_path: Path) -> None:
    """In database, files, caches and logs: what was typed and searched for, names of files and cameras, where webhooks
    were called, and with which secret."""
    secret = base64.b64encode(b"of quast, of thirty-two bytes or so").decode()
    who, ink, profile, smirk, tag, head, tus, run, file, lost, shape = (f"quast{n}-brought" for n in range(11))
    brought = [who, ink, profile, smirk, tag, head, tus, run, lost, f"{HOOK}/quast", secret]
    with (
        database(kind) as settings,
        served_client(tmp_path / "data", webhook_origins=f'["{HOOK}"]', **settings) as (service, client),
    ):
        session = client.post("/v1/sessions", json={"label": who, "consent": ink}).json()["id"]
        fields = {"session": session, "label": profile, "expression": smirk, "tags": tag}
        captures = [
            upload(client, packed_capture(tmp_path, seed).read_bytes(), **fields).json()["id"] for seed in (5, 6)
        ]
        captures.append(upload_in_pieces(client, packed_capture(tmp_path, 7).read_bytes(), session=session, label=tus))
        archive = {"file": (file, capture_that_lost(tmp_path / "lost", lost, file))}
        captures.append(client.post("/v1/captures/uploads", files=archive, data={"session": session}).json()["id"])
        hook = {"url": f"{HOOK}/quast", "secret": f"whsec_{secret}"}
        wanted = {"capture_id": captures[0], "name": head, "webhook": hook}
        job = client.post("/v1/jobs", json=wanted).json()["id"]
        batch = client.post("/v1/batches", json={"captures": captures, "label": run}).json()["id"]
        await_state(client, job, ("succeeded",))
        assert client.post(f"/v1/jobs/{job}/exports", json={"as": "obj", "template": shape}).status_code == 422
        assert client.post(f"/v1/jobs/{job}/exports", json={"as": "obj"}).status_code == 422, (
            "this work wrote no report"
        )
        for path in (f"/v1/sessions/{session}", f"/v1/captures/{captures[0]}"):
            tagged = {"If-Match": client.get(path).headers["etag"]}
            assert client.patch(path, json={"label": who}, headers=tagged).status_code == 200
        assert client.get("/v1/captures", params={"q": who}).json()["total"] == 4
        (service.data / "captures" / captures[1] / "record.json").write_text("{")
        assert client.get(f"/v1/captures/{captures[1]}").status_code == 404, "it is set aside now"
        assert traces(service, settings, brought) == {*brought}
        assert client.delete(f"/v1/sessions/{session}").status_code == 204
        assert client.get(f"/v1/batches/{batch}").json()["label"] == ""
        assert traces(service, settings, [*brought, file, shape]) == set()
        assert not [path for path in service.data.rglob("*") if any(each in path.name for each in (*captures, job))]


def capture_that_lost(folder: Path, camera: str, file: str) -> bytes:
    """An archive of a capture of which one camera, of that name, has a damaged picture, beside a strange file."""
    cameras = small_capture(folder, cameras=4) / "cameras.json"
    cameras.write_text(cameras.read_text().replace('"cam03"', f'"{camera}"'))
    for kind in ("images", "background"):
        (folder / kind / "cam03.png").rename(folder / kind / f"{camera}.png")
    for damaged in (f"images/{camera}.png", f"images/{file}.png", f"{file}.txt"):
        (folder / damaged).write_bytes(b"no picture")
    return packed(folder)


def upload_in_pieces(client: httpx.Client, archive: bytes, **fields: str) -> str:
    """Uploads an archive by tus. Returns the id of its capture."""
    named = ",".join(f"{name} {base64.b64encode(text.encode()).decode()}" for name, text in fields.items())
    headers = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(archive)), "Upload-Metadata": named}
    headers |= {"Content-Type": "application/offset+octet-stream", "Upload-Offset": "0"}
    place = client.post("/v1/uploads", headers=headers).headers["location"]
    return client.patch(place, headers=headers, content=archive).headers["location"].rpartition("/")[2]


def traces(service: RunningService, settings: dict[str, Any], values: list[str]) -> set[str]:
    """Those of the values that a file below the data folder or its name holds, the service's log, or a row of
    PostgreSQL."""
    paths = [*service.data.rglob("*")]
    held = [service.log.read_bytes(), *(path.read_bytes() for path in paths if path.is_file())]
    held += [str(path).encode() for path in paths]
    if settings:
        engine = sa.create_engine(ServiceSettings(**settings).url)
        with engine.connect() as connection:
            of = "schemaname NOT IN ('pg_catalog', 'information_schema')"
            for schema, table in connection.execute(sa.text(f"SELECT schemaname, tablename FROM pg_tables WHERE {of}")):
                held += [
                    row.encode() for row in connection.scalars(sa.text(f'SELECT t::text FROM "{schema}"."{table}" t'))
                ]
        engine.dispose()
    spelt = {value: (value.encode(), value.encode().hex().encode()) for value in values}  # the latter: of a bytea
    return {value for value, ways in spelt.items() if any(way in each for each in held for way in ways)}


def test_consent_comes_before_the_first_picture(http: httpx.Client, tmp_path: Path) -> None:
    silent = http.post("/v1/sessions", json={"label": "Bert"}).json()["id"]
    archive = packed_capture(tmp_path, 1).read_bytes()
    for fields in ({}, {"session": silent}):
        refused = upload(http, archive, **fields)
        assert (refused.status_code, refused.json()["type"].endswith("consent-missing")) == (409, True)
        shot = http.post("/v1/captures", json=fields)
        assert (shot.status_code, shot.json()["type"]) == (409, refused.json()["type"])
    http.patch(f"/v1/sessions/{silent}", json={"consent": "signed"})
    assert upload(http, archive, session=silent).status_code == 201


def test_a_removal_says_what_stays_and_an_erasure_leaves_nothing(
    http: httpx.Client, service: RunningService, tmp_path: Path
) -> None:
    consented = {"label": "Anna", "consent": "signed 2026-11-22"}
    session = http.post("/v1/sessions", json=consented).json()["id"]
    removed = upload(http, packed_capture(tmp_path, 2).read_bytes(), session=session).json()["id"]
    erased = upload(http, packed_capture(tmp_path, 3).read_bytes(), session=session).json()["id"]
    http.patch(f"/v1/captures/{erased}", json={"session": None})  # with or without a session
    jobs: dict[str, str] = {}
    for capture in (removed, erased):
        jobs[capture] = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
        await_state(http, jobs[capture], ("succeeded",))
        held = http.get(f"/v1/captures/{capture}/holdings").json()
        assert (held["pictures"], held["heads"], held["jobs"], held["active"]) == (3, [jobs[capture]], [], [])
        assert held["bytes"] > 0
        assert held["head_bytes"] > 0
    running = http.post("/v1/jobs", json={"capture_id": erased, "settings": {"front": "long"}}).json()["id"]
    assert http.get(f"/v1/captures/{erased}/holdings").json()["active"] == [running]

    assert http.delete(f"/v1/captures/{removed}").status_code == 204
    assert http.get(f"/v1/jobs/{jobs[removed]}/result/head.ply").status_code == 200, "the head stays"
    assert http.delete(f"/v1/captures/{erased}").status_code == 409, "a job needs it"
    assert http.delete(f"/v1/captures/{erased}", params={"erase": True}).status_code == 204
    for job in (jobs[erased], running):
        assert http.get(f"/v1/jobs/{job}").status_code == 404
        assert not (service.data / "jobs" / job).exists()
    assert http.get(f"/v1/captures/{erased}").status_code == 404
    assert not list(service.data.rglob(f"*{erased}*"))
    assert http.delete(f"/v1/captures/{erased}", params={"erase": True}).status_code == 404
