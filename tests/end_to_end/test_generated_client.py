"""A client that a generator makes of the service's own description does the main job: the guide's own lines."""

import hashlib
import os
import re
import shlex
import sys
import tarfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.support import fork_server
from tests.support.attacks import add_keys
from tests.support.services import ROOT, RunningService, running_service, small_capture

GUIDE = ROOT / "docs" / "http.md"
REFUSED = """
import os
from eigenhead_client import AuthenticatedClient
from eigenhead_client.api.captures import upload_capture
from eigenhead_client.models import Problem, UploadCaptureBody
from eigenhead_client.types import File
from io import BytesIO

for key in ("eh_nobody", os.environ["KEY"]):
    client = AuthenticatedClient(os.environ["URL"], key)
    answer = upload_capture.sync(client=client, body=UploadCaptureBody(File(BytesIO(b"no archive"), "a.zip")))
    assert isinstance(answer, Problem), answer
    print(answer.status, answer.type_)
"""
OVERLAY = """
import hashlib, os
from eigenhead_client import AuthenticatedClient
from eigenhead_client.api.jobs import get_result

client = AuthenticatedClient(os.environ["URL"], os.environ["KEY"])
print(hashlib.sha256(get_result.sync("{job}", "{name}", client=client).payload.read()).hexdigest())
"""

pytestmark = pytest.mark.slow


def block(language: str) -> str:
    text = GUIDE.read_text(encoding="utf-8")
    (code,) = re.findall(rf"<!-- code: client -->\n```{language}\n(.*?)```", text, re.DOTALL)
    return code


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningService]:
    with running_service(tmp_path_factory.mktemp("service") / "data") as running:
        yield running


@pytest.fixture(scope="module")
def key(service: RunningService) -> str:
    return add_keys(service, "read,capture,submit")[0]


@pytest.fixture(scope="module")
def folder(service: RunningService, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the generated package lies, with a capture's archive beside it."""
    pytest.importorskip("openapi_python_client", reason="deploy/setup.sh --docs installs the generator")
    place = tmp_path_factory.mktemp("client")
    command = shlex.split(
        block("sh").replace("$URL", service.url).replace("docs/client.yaml", f"{ROOT}/docs/client.yaml")
    )
    command[0] = str(Path(sys.executable).with_name("openapi-python-client"))
    generated = fork_server.run([*command, "--fail-on-warning"], 120.0, cwd=place)
    assert generated.returncode == 0, generated.stdout + generated.stderr
    with tarfile.open(place / "anna.tar", "w") as archive:
        archive.add(small_capture(place / "capture"), ".")
    return place


def run(code: str, folder: Path, service: RunningService, key: str) -> str:
    environment = os.environ | {"URL": service.url, "KEY": key, "no_proxy": "127.0.0.1", "PYTHONPATH": str(folder)}
    done = fork_server.run([sys.executable, "-c", code], 120.0, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_every_operation_has_its_method(folder: Path, service: RunningService) -> None:
    paths = httpx.get(service.url + "/openapi.json").json()["paths"]
    named = {call["operationId"] for calls in paths.values() for call in calls.values()}
    made = {path.stem for path in (folder / "eigenhead_client" / "api").glob("*/*.py")} - {"__init__"}
    assert made == named


def test_the_guides_lines_upload_wait_and_fetch(folder: Path, service: RunningService, key: str) -> None:
    printed = run(block("python"), folder, service, key)
    assert "succeeded" in printed
    (job,) = httpx.get(service.url + "/v1/jobs", headers={"Authorization": f"Bearer {key}"}).json()["jobs"]
    assert job["settings"]["detail"] == "photo"
    for name in ("head.ply", "head.glb"):
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == job["files"][name]["sha256"]
    name = "overlays/cam00.png"  # a slash in a name is part of the path
    overlay = run(OVERLAY.format(job=job["id"], name=name), folder, service, key).strip()
    assert overlay == job["files"][name]["sha256"]


def test_what_is_refused_is_a_typed_problem(folder: Path, service: RunningService, key: str) -> None:
    statuses = [line.split()[0] for line in run(REFUSED, folder, service, key).splitlines()]
    assert statuses == ["401", "422"]
