"""What is kept, how large it is and what goes next, over HTTP."""

from pathlib import Path

from tests.support.services import awaited, packed, served_client, small_capture, upload


def test_storage_and_retention_are_told(tmp_path: Path) -> None:
    with served_client(tmp_path / "data", worker=False, keep_captures_days="30", keep_jobs="1") as (service, http):
        capture = upload(http, packed(small_capture(tmp_path / "capture"))).json()
        jobs = [http.post("/v1/jobs", json={"capture_id": capture["id"]}).json()["id"] for _ in range(2)]
        http.post("/v1/jobs/bulk", json={"action": "cancel", "ids": jobs})
        retention = http.get("/v1/retention").json()
        assert (retention["keep_captures_days"], retention["keep_results_days"], retention["keep_jobs"]) == (
            30.0,
            None,
            1,
        )
        assert [(one["kind"], one["why"]) for one in retention["upcoming"]] == [
            ("job", "keep_jobs"),
            ("job", "keep_jobs"),
            ("capture", "keep_captures_days"),
        ]
        assert retention["upcoming"][2]["id"] == capture["id"]
        assert (retention["upcoming"][0]["goes"] is None, retention["upcoming"][1]["goes"] is None) == (False, True)
        use = awaited(lambda: http.get("/v1/storage").json(), lambda use: use["kinds"] is not None)  # the first look
        held = {kind["kind"]: kind for kind in use["kinds"]}
        files = [path for path in (service.data / "captures").rglob("*") if path.is_file()]
        assert held["captures"] == {"kind": "captures", "bytes": sum(p.stat().st_size for p in files), "things": 1}
        assert (use["failed"], use["free"] < use["total"]) == (2, True)
        assert str(service.data) not in str(use), "where the folder lies is nobody's business"
