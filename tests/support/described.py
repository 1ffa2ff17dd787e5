"""Runs schemathesis on a service: requests made of its own description, and every check but two."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import httpx

from tests.support.services import ROOT, RunningService, await_true

SECONDS_MOST = 120  # drawing a shot of the simulated studio takes seconds, on a machine that is busy many
# An If-Match of another state is answered before the body is read.
REFUSALS = ["400", "401", "403", "404", "405", "406", "409", "412", "415", "422", "428", "429", "5xx"]


def ask_as_described(
    service: RunningService, folder: Path, key: str, *options: str, ids: Mapping[str, Sequence[str]] | None = None
) -> "subprocess.CompletedProcess[str]":
    """Runs it in ``folder`` with a key. ``ids``: values that half the requests have for a path's parameter."""
    await_true(lambda: httpx.get(service.url + "/readyz", timeout=60).json()["ready"])
    configured = f"[checks]\nnegative_data_rejection.expected-statuses = {json.dumps(REFUSALS)}\n"
    for name, values in (ids or {}).items():
        configured += f"[parameters.'path.{name}']\ndictionary = '{name}'\nprobability = 0.5\n"
        configured += f"[dictionaries.{name}]\nvalues = {json.dumps(values)}\n"
    (folder / "schemathesis.toml").write_text(configured)
    command = [
        *(str(Path(sys.executable).with_name("st")), "run", service.url + "/openapi.json"),
        # A job has no log before it begins.
        *("--checks", "all", "--exclude-checks", "positive_data_acceptance,ensure_resource_availability"),
        *("--exclude-path-regex", r"preview\.mjpg$"),  # goes on for as long as it was asked to
        *("-H", f"Authorization: Bearer {key}", "--suppress-health-check", "all", "--generation-database", "none"),
        *("--request-timeout", str(SECONDS_MOST), "--max-response-time", str(SECONDS_MOST), *options),
    ]
    hooks = {"SCHEMATHESIS_HOOKS": "tests.support.schemathesis_hooks", "PYTHONPATH": str(ROOT)}
    return subprocess.run(command, env=os.environ | hooks, cwd=folder, capture_output=True, text=True, check=False)
