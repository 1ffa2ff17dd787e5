"""Lists over HTTP by pages, searched, filtered, sorted; many things at once."""

import base64

import httpx
import pytest

from tests.support.services import RunningService, await_state, upload


@pytest.fixture(scope="module")
def captures(service: RunningService, archive: bytes) -> list[str]:
    """Five captures that a word finds and no other test's."""
    with httpx.Client(base_url=service.url, timeout=30) as http:
        return [upload(http, archive, label=f"walnut {number}").json()["id"] for number in range(5)]


def test_captures_come_in_pages_that_a_cursor_goes_on_with(http: httpx.Client, captures: list[str]) -> None:
    found, cursor = [], {}
    while True:
        page = http.get("/v1/captures", params={"q": "WALNUT", "limit": 2, "sort": "label"} | cursor).json()
        assert page["total"] == 5
        found += [capture["id"] for capture in page["captures"]]
        if page["next"] is None:
            break
        cursor = {"cursor": page["next"]}
    assert found == captures
    newest = http.get("/v1/captures", params={"q": "walnut", "before": captures[3]}).json()["captures"]
    assert [capture["id"] for capture in newest] == captures[2::-1]
    assert http.get("/v1/captures", params={"q": "walnut", "verdict": "none"}).json()["total"] == 0


@pytest.mark.parametrize(
    "query", [{"cursor": "x"}, {"sort": "shoe size"}, {"limit": 0}, {"limit": 1001}, {"verdict": "fine"}]
)
@pytest.mark.parametrize("path", ["/v1/captures", "/v1/jobs"])
def test_lists_refuse_what_they_cannot_do(http: httpx.Client, path: str, query: dict[str, str]) -> None:
    if path == "/v1/jobs" and "verdict" in query:
        query = {"state": "fine"}
    answer = http.get(path, params=query)
    assert answer.status_code == 422
    assert answer.headers["content-type"] == "application/problem+json"


def test_jobs_refuse_the_offset_of_versions_before_0_3(http: httpx.Client) -> None:
    answer = http.get("/v1/jobs", params={"offset": 0})
    assert answer.status_code == 422
    assert [error["code"] for error in answer.json()["error_messages"]] == ["cursor-in-place-of-offset"]


def test_many_captures_take_one_action_and_those_that_cannot_are_named(http: httpx.Client, captures: list[str]) -> None:
    def act(path: str, **body: object) -> dict:
        answer = http.post(path, json=body)
        assert answer.status_code == 200, answer.text
        return answer.json()

    session = http.post("/v1/sessions", json={"label": "Wanda"}).json()["id"]
    moved = act("/v1/captures/bulk", action="move", ids=captures[:2], session=session)
    assert moved == {"done": captures[:2], "refused": []}
    person = http.get("/v1/subjects", params={"q": "wanda"}).json()["subjects"][0]
    assert (person["captures"], person["heads"], person["head"], person["consent"]) == (2, 0, None, False)
    assert http.get("/v1/captures", params={"q": "wanda walnut"}).json()["total"] == 2
    missing = "0" * 28
    queued = act("/v1/captures/bulk", action="reconstruct", ids=[captures[0], missing], settings={"detail": "span"})
    assert queued["done"] == captures[:1]
    assert [(one["id"], one["type"]) for one in queued["refused"]] == [(missing, "urn:eigenhead:problem:not-found")]
    page = http.get("/v1/jobs", params={"q": "span wanda"}).json()
    assert (page["total"], page["jobs"][0]["capture_id"]) == (1, captures[0])
    job = await_state(http, page["jobs"][0]["id"], ("succeeded",))["id"]
    assert http.get("/v1/jobs", params={"q": "wanda succeeded"}).json()["total"] == 1
    assert http.get("/v1/jobs", params={"q": "wanda failed"}).json()["total"] == 0
    assert http.get("/v1/subjects", params={"q": "wanda"}).json()["subjects"][0]["head"] == job
    gone = act("/v1/jobs/bulk", action="remove", ids=[job])
    assert gone == {"done": [job], "refused": []}
    removed = act("/v1/captures/bulk", action="erase", ids=captures[:2])
    assert removed["done"] == captures[:2]
    assert http.get("/v1/sessions", params={"q": "wanda"}).json()["sessions"][0]["captures"] == []


def test_captures_and_people_are_found_by_their_tags(http: httpx.Client, captures: list[str]) -> None:
    session = http.post("/v1/sessions", json={"label": "Tagged Tess"}).json()["id"]
    edited = http.patch(
        f"/v1/captures/{captures[2]}", json={"session": session, "tags": ["Beard ", "beard", "study 4"]}
    )
    assert edited.json()["tags"] == ["Beard", "study 4"]
    done = http.post("/v1/captures/bulk", json={"action": "tag", "ids": captures[2:4], "tags": ["blind"]}).json()
    assert done == {"done": captures[2:4], "refused": []}

    def found(tag: str) -> list[str]:
        page = http.get("/v1/captures", params={"tag": tag, "sort": "label"}).json()
        return [capture["id"] for capture in page["captures"]]

    assert (found("BEARD"), found("blind"), found("bear")) == (captures[2:3], captures[2:4], [])
    people = http.get("/v1/subjects", params={"tag": "study 4"}).json()["subjects"]
    assert [(person["label"], person["tags"]) for person in people] == [("Tagged Tess", ["Beard", "blind", "study 4"])]
    assert http.get("/v1/captures", params={"q": "walnut blind"}).json()["total"] == 2
    http.post("/v1/captures/bulk", json={"action": "untag", "ids": captures[2:4], "tags": ["Blind"]})
    assert found("blind") == []
    http.patch(f"/v1/captures/{captures[2]}", json={"label": "walnut 2"})
    assert found("beard") == captures[2:3], "what is not given stays"
    http.patch(f"/v1/captures/{captures[2]}", json={"tags": [], "session": None})
    assert found("beard") == []


@pytest.mark.parametrize(
    "tags", [["a\nb"], ["x" * 51], ["a,b"], [" "], ["\u202eevil"], [""], [f"t{n}" for n in range(21)]]
)
def test_tags_that_cannot_be_are_refused(http: httpx.Client, captures: list[str], tags: list[str]) -> None:
    answer = http.patch(f"/v1/captures/{captures[4]}", json={"tags": tags})
    assert answer.status_code == 422
    assert http.get(f"/v1/captures/{captures[4]}").json()["tags"] == []


def test_a_capture_takes_no_more_tags_than_it_can_have(http: httpx.Client, captures: list[str]) -> None:
    """One by one, and many at once: the one that is full is named, the other is tagged."""
    full = [f"t{number}" for number in range(20)]
    assert http.patch(f"/v1/captures/{captures[4]}", json={"tags": full}).status_code == 200
    answer = http.post("/v1/captures/bulk", json={"action": "tag", "ids": captures[3:5], "tags": ["one more"]}).json()
    assert (answer["done"], [one["id"] for one in answer["refused"]]) == (captures[3:4], captures[4:5])
    assert "at most 20" in answer["refused"][0]["detail"]
    http.patch(f"/v1/captures/{captures[4]}", json={"tags": []})


def test_tags_come_with_an_upload(http: httpx.Client, archive: bytes) -> None:
    """As a form's field with commas between, also in one call with the job, and as an upload's metadata in parts."""
    made = upload(http, archive, tags="Study 4, study 4, beard").json()
    assert made["tags"] == ["Study 4", "beard"]
    job = upload(http, archive, "/v1/reconstructions", tags="beard").json()
    assert http.get(f"/v1/captures/{job['capture_id']}").json()["tags"] == ["beard"]
    text = base64.b64encode(b"in parts, beard").decode()
    head = {"Tus-Resumable": "1.0.0", "Upload-Length": str(len(archive)), "Upload-Metadata": f"tags {text}"}
    where = http.post("/v1/uploads", headers=head).headers["location"]
    kind = {"Content-Type": "application/offset+octet-stream"}
    part = {"Tus-Resumable": "1.0.0", "Upload-Offset": "0"} | kind
    done = http.patch(where, headers=part, content=archive)
    assert http.get(done.headers["location"]).json()["tags"] == ["in parts", "beard"]
    before = http.get("/v1/captures").json()["total"]
    refused = upload(http, archive, tags="x" * 51 + ", a\nb")
    assert (refused.status_code, len(refused.json()["errors"])) == (422, 2)
    assert http.get("/v1/captures").json()["total"] == before


def test_every_queued_job_has_a_place_of_its_own(http: httpx.Client, captures: list[str]) -> None:
    """In a queue that nobody serves; another test may have left a job in it."""
    left = http.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]
    http.post("/v1/jobs/bulk", json={"action": "cancel", "ids": [job["id"] for job in left] or ["0" * 28]})
    wanted = {"capture_id": captures[4], "queue": "gpu"}
    jobs = [http.post("/v1/jobs", json=wanted | {"priority": p}).json()["id"] for p in (100, 50, 100, 50)]
    listed = {job["id"]: job["ahead"] for job in http.get("/v1/jobs", params={"state": "queued"}).json()["jobs"]}
    assert [listed[job] for job in jobs] == [2, 0, 3, 1]
    assert http.get(f"/v1/jobs/{jobs[0]}").json()["ahead"] == 2
    both = http.post("/v1/jobs/bulk", json={"action": "cancel", "ids": jobs[:2]}).json()
    assert both == {"done": jobs[:2], "refused": []}
    assert [http.get(f"/v1/jobs/{job}").json()["ahead"] for job in jobs] == [None, None, 1, 0]
    http.post("/v1/jobs/bulk", json={"action": "cancel", "ids": jobs})
