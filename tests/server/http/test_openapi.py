"""The service against its own description, by schemathesis: every check but positive data acceptance."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest

from server.services.keys import SCOPES
from tests.support.attacks import add_keys
from tests.support.services import ROOT, running_service

SECONDS_MOST = 120  # drawing a shot of the simulated studio takes seconds, on a machine that is busy many


@pytest.mark.slow
@pytest.mark.gl
@pytest.mark.timeout(900)
@pytest.mark.parametrize("scope", ["admin", *(pytest.param(s, marks=pytest.mark.nightly) for s in SCOPES[:-1])])
def test_schemathesis_finds_nothing(tmp_path: Path, scope: str) -> None:
    with running_service(tmp_path / "data") as service:
        key = add_keys(service, scope)[0]
        while not httpx.get(service.url + "/readyz", timeout=60).json()["ready"]:
            time.sleep(0.2)
        command = [
            str(Path(sys.executable).with_name("st")),
            "run",
            service.url + "/openapi.json",
            # A job has no log before it begins.
            *("--checks", "all", "--exclude-checks", "positive_data_acceptance,ensure_resource_availability"),
            *("--exclude-path-regex", r"preview\.mjpg$"),  # goes on for as long as it was asked to
            *("-H", f"Authorization: Bearer {key}", "--max-examples", "10", "--seed", "1"),
            *("--suppress-health-check", "all", "--generation-database", "none"),
            *("--request-timeout", str(SECONDS_MOST), "--max-response-time", str(SECONDS_MOST)),
        ]
        # An If-Match of another state is answered before the body is read.
        expected = [400, 401, 403, 404, 405, 406, 409, 412, 415, 422, 428, 429, "5xx"]
        configured = "[checks]\nnegative_data_rejection.expected-statuses = " + json.dumps(
            [str(each) for each in expected]
        )
        (tmp_path / "schemathesis.toml").write_text(configured)
        hooks = {"SCHEMATHESIS_HOOKS": "tests.support.schemathesis_hooks", "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            command, env=os.environ | hooks, cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stdout[-8000:]
        assert "unforeseen" not in service.log.read_text()
