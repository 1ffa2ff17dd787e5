"""Eighty hostile uploads: each a 4xx that names the fault, memory bounded, the disk back to where it was; and a disk
that is full."""

import errno
import json
import os
import re
import shutil
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.rig.formats.captures.test_archive import HOSTILE
from tests.support.attacks import process_tree
from tests.support.disks import small_disk
from tests.support.services import RunningService, await_state, packed, served_client, small_capture, upload
from tests.support.small_captures import FEATURES, damage, feature, points, remove

MEMORY_MOST = 1 << 30


def cameras(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    """A fault in cameras.json; NaN and infinities are written as Python's json does, which is no JSON."""

    def spoil(folder: Path) -> None:
        document = json.loads((folder / "cameras.json").read_text())
        change(document)
        (folder / "cameras.json").write_text(json.dumps(document))

    return spoil


def of_first(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        inner = document["cameras"][0]
        *path, last = key.split(".")
        for part in path:
            inner = inner[part]
        inner[last] = value

    return change


def png_claiming(width: int, height: int) -> bytes:
    """A PNG whose header claims a size and whose pixels are not there."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


def of_each(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    def change(document: dict[str, Any]) -> None:
        for entry in document["cameras"]:
            of_first(key, value)({"cameras": [entry]})

    return change


def in_metres(document: dict[str, Any]) -> None:
    for entry in document["cameras"]:
        pose = entry["camera_from_world"]
        pose["translation"] = [x / 1000 for x in pose["translation"]]


def copies(source: str, target: str) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        for path in (folder / source).iterdir():
            shutil.copy(path, folder / target / path.name)

    return spoil


def features_on_a_line() -> bytes:
    """Points above each other at one depth, as the cameras of ``small_capture`` see them."""
    names = ("glabella", "pronasale", "subnasale", "gnathion")
    points = {name: {f"cam{i:02}": [12 + 1.2 * i - 1.2, 3.0 + 6 * k] for i in range(3)} for k, name in enumerate(names)}
    return json.dumps({"format": "eigenhead-features/1", "points": points}).encode()


THIRD_EYE = points({"format": FEATURES, "points": {"third_eye": {"cam00": [1, 2]}}})
SPOILT: dict[str, tuple[Callable[[Path], None], str]] = {
    "NaN in a rotation": (cameras(of_first("camera_from_world.rotation", [[float("nan")] * 3] * 3)), "finite number"),
    "infinite focal length": (cameras(of_first("intrinsics.fx", float("inf"))), "finite number"),
    "huge focal length": (cameras(of_first("intrinsics.fx", 1e300)), "finite number"),
    "negative focal length": (cameras(of_first("intrinsics.fx", -1.0)), "positive"),
    "text for a number": (cameras(of_first("intrinsics.cx", "middle")), "finite number"),
    "mirrored rotation": (cameras(of_first("camera_from_world.rotation", np.diag([1, 1, -1]).tolist())), "mirrored"),
    "no rotation at all": (cameras(of_first("camera_from_world.rotation", [[0, 0, 0]] * 3)), "orthonormal"),
    "no translation": (cameras(of_first("camera_from_world.translation", None)), "translation"),
    "name with a path": (cameras(of_first("name", "../../etc/passwd")), "becomes the name of files"),
    "name of a hundred": (cameras(of_first("name", "a" * 100)), "1 to 64"),
    "name twice": (cameras(of_first("name", "cam01")), "occurs 2 times"),
    "width of a billion": (cameras(of_first("width", 10**9)), "whole number of pixels"),
    "width of a half": (cameras(of_first("width", 0.5)), "whole number of pixels"),
    "another unit": (cameras(lambda d: d.update(unit="parsec")), "unit"),
    "another format": (cameras(lambda d: d.update(format="x/1")), "format"),
    "two cameras": (cameras(lambda d: d["cameras"].pop()), "2 cameras"),
    "a thousand cameras": (cameras(lambda d: d.update(cameras=d["cameras"] * 400)), "1200 cameras"),
    "cameras that are no list": (cameras(lambda d: d.update(cameras={})), "list"),
    "deep cameras.json": (damage("cameras.json", b"[" * 100_000), "cannot be read as JSON"),
    "binary cameras.json": (damage("cameras.json", bytes(range(256))), "cannot be read as JSON"),
    "image of 400 megapixels": (damage("images/cam00.png", png_claiming(20_000, 20_000)), "at most"),
    "image of another size": (damage("images/cam00.png", png_claiming(25, 24)), "damaged"),
    "image without pixels": (damage("images/cam00.png", png_claiming(24, 24)), "damaged"),
    "image that is a page": (damage("images/cam00.png", b"<svg onload=alert(1)>"), "damaged"),
    "empty image": (damage("images/cam00.png", b""), "damaged"),
    "two images of a camera": (damage("images/cam00.jpg", png_claiming(24, 24)), "which one is meant"),
    "missing image": (remove("images/cam02.png"), "images/cam02.png is missing"),
    "missing plate": (remove("background/cam01.png"), "background/cam01.png is missing"),
    "features of no camera": (feature({"camX": [1, 2]}), "does not have"),
    "features outside": (feature({"cam00": [900, 2]}), "outside the image"),
    "features of NaN": (feature({"cam00": [float("nan"), 2]}), "finite pixels"),
    "features that are no object": (damage("features.json", b"[]"), "no object"),
    "every camera at one place": (cameras(of_each("camera_from_world.translation", [0, 0, 1000])), "at one place"),
    "translations in metres": (cameras(in_metres), "look like metres"),
    "a lens of k1 = 50": (cameras(of_first("distortion.k1", 50)), "lens is absurd"),
    "an image turned": (damage("images/cam00.png", png_claiming(24, 30)), "damaged"),
    "features in one view": (feature({"cam00": [1, 2]}), "in one view only"),
    "features of a third eye": (THIRD_EYE, "is no landmark"),
    "features on a line": (damage("features.json", features_on_a_line()), "lie on one line"),
    "pictures that are their plates": (copies("background", "images"), "its own clean plate"),
}  # fmt: skip


def bodies(tmp_path: Path) -> Iterator[tuple[str, bytes, str]]:
    for case, (make, word) in HOSTILE.items():
        if case != "many members":  # its limit there is the test's own
            yield case, make(), word
    for number, (case, (spoil, word)) in enumerate(SPOILT.items()):
        folder = small_capture(tmp_path / f"spoilt{number}")
        spoil(folder)
        yield case, packed(folder), word


def peak_memory(service: RunningService) -> int:
    """The largest peak of the service's processes, bytes."""
    assert service.process is not None
    peaks = [0]
    for pid in process_tree(service.process.pid):
        with suppress(OSError):  # it has ended
            peaks += map(int, re.findall(r"VmHWM:\s+(\d+)", Path(f"/proc/{pid}/status").read_text()))
    return max(peaks) * 1024


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_eighty_hostile_uploads(tmp_path: Path) -> None:
    with served_client(tmp_path / "data", worker=False) as (service, client):
        kinds = ("captures", "incoming", "uploads", "trash")

        def disk() -> dict[str, int]:
            files = (path for kind in kinds for path in (service.data / kind).rglob("*"))
            return {str(path): path.stat().st_size for path in files if path.is_file()}

        before, count = disk(), 0
        for case, data, word in bodies(tmp_path):
            response = upload(client, data)
            assert 400 <= response.status_code < 500, case
            assert word in " ".join(response.json()["errors"]), (case, response.text)
            assert disk() == before, case
            count += 1
        assert count >= 80
        assert peak_memory(service) < MEMORY_MOST
        assert upload(client, packed(small_capture(tmp_path / "honest"))).status_code == 201


def fill(disk: Path, leave: int) -> Path:
    """A file that leaves ``leave`` bytes."""
    path = disk / "ballast"
    for _ in range(50):  # the service may take a page between the look and the allocation
        size = max(0, shutil.disk_usage(disk).free - leave)
        try:
            with path.open("wb") as stream:
                os.posix_fallocate(stream.fileno(), 0, size)
        except OSError as error:
            if error.errno != errno.ENOSPC:
                raise
            path.unlink()
            continue
        return path
    raise AssertionError("the disk never stood still")


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("moments", [2, pytest.param(10, marks=pytest.mark.nightly)])
def test_a_disk_that_fills_at_any_moment_of_a_job_changes_no_byte(tmp_path: Path, moments: int) -> None:
    data = packed(small_capture(tmp_path / "capture"))
    with (
        small_disk(tmp_path / "disk", 48) as disk,
        served_client(disk / "data", free_bytes="0", tiny_s="1.5", tiny_bytes=str(1 << 20)) as (_, client),
    ):
        capture = upload(client, data).json()["id"]
        first = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
        undisturbed = await_state(client, first, ("succeeded",))["files"]
        for moment in range(moments):
            job = client.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
            time.sleep(2.5 * moment / moments)
            ballast = fill(disk, leave=0)
            time.sleep(1.5)
            ballast.unlink()
            ended = await_state(client, job, ("succeeded", "failed"), 60)
            if ended["state"] == "failed":
                assert ended["error"]["type"].endswith("disk-full")
                job = client.post(f"/v1/jobs/{job}/restart", json={}).json()["id"]
                ended = await_state(client, job, ("succeeded", "failed"), 60)
            assert (ended["state"], ended["files"]) == ("succeeded", undisturbed), moment
            assert client.delete(f"/v1/jobs/{job}").status_code == 204


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_a_full_disk_is_said_and_survived(tmp_path: Path) -> None:
    """During an upload, a fit and the writing of a result; afterwards everything is listed, deletable, and works."""
    data = packed(small_capture(tmp_path / "capture", size=200))
    with (
        small_disk(tmp_path / "disk", 48) as disk,
        served_client(disk / "data", free_bytes="0", tiny_s="1.5", tiny_bytes=str(6 << 20)) as (_, client),
    ):
        kept = upload(client, data).json()["id"]
        ballast = fill(disk, leave=len(data) // 2)
        for response in (upload(client, data), upload(client, data, "/v1/reconstructions")):
            assert response.status_code == 507
            assert "disk" in response.json()["detail"]
        ballast.unlink()
        job = client.post("/v1/jobs", json={"capture_id": kept}).json()["id"]
        await_state(client, job, ("running",))
        ballast = fill(disk, leave=2 << 20)  # enough for the database, not for the result of 6 MB
        failed = await_state(client, job, ("failed",), 60)
        assert failed["error"]["type"].endswith("disk-full")
        assert "restart the job" in failed["error"]["detail"]
        ballast.unlink()
        ballast = fill(disk, leave=0)
        assert [c["id"] for c in client.get("/v1/captures").json()["captures"]] == [kept]
        assert [j["id"] for j in client.get("/v1/jobs").json()["jobs"]] == [job]
        assert client.delete(f"/v1/captures/{kept}").status_code == 204
        assert client.delete(f"/v1/jobs/{job}").status_code == 204
        ballast.unlink()
        again = upload(client, data).json()["id"]
        job = client.post("/v1/jobs", json={"capture_id": again}).json()["id"]
        assert await_state(client, job, ("succeeded", "failed"), 60)["state"] == "succeeded"
