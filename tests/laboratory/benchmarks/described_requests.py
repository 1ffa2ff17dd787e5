"""Requests that schemathesis makes of the service's description, with keys of one scope: how many, how many 5xx.

python -m tests.laboratory described_requests admin capture submit read erase --requests 20000 --out FOLDER

A round is a run on a new service with captures, jobs, a session and a batch, whose ids half the requests name. None
asks for a shot or a preview of the simulated studio, which takes up to a minute: server/http/test_openapi.py does.
Rounds stand in ``--out``, by scope and seed: a run that is begun again goes on behind the last of them.
"""

import json
import re
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from rig.progress import Progress
from tests.support.attacks import add_keys, client
from tests.support.described import ask_as_described
from tests.support.services import RunningService, packed, running_service, small_capture, upload

Scope = Literal["read", "capture", "submit", "erase", "admin"]
OPTIONS = ("--exclude-path-regex", r"preview\.", "--exclude-operation-id", "take_capture", "--max-examples", "100")


def run(
    scopes: Sequence[Scope],
    scratch: Path,
    report: Progress,
    *,
    requests: int = 20_000,
    minutes: Annotated[float, "of one round"] = 5.0,
    out: Annotated[Path | None, "keeps the rounds there"] = None,
) -> dict[str, Any]:
    """Returns for each scope its requests, those that nobody foresaw, and its answers by status."""
    figures, kept = {}, out or scratch
    kept.mkdir(parents=True, exist_ok=True)
    for scope in scopes:
        rows = [json.loads(path.read_text()) for path in kept.glob(f"{scope}-*.json")]
        while (total := sum(row["requests"] for row in rows)) < requests:
            report(scope, total / requests)
            seed = len(rows) + 1
            phases = "examples,coverage,fuzzing,stateful" if seed == 1 else "fuzzing,stateful"  # others know no seed
            options = ("--seed", str(seed), "--phases", phases, "--max-time", str(round(60 * minutes)), *OPTIONS)
            rows.append(ask(scope, scratch / f"{scope}-{seed}", *options))
            (kept / f"{scope}-{seed}.json").write_text(json.dumps(rows[-1]))
        statuses = sum((Counter(row["statuses"]) for row in rows), Counter[str]())
        figures[scope] = {key: sum(row[key] for row in rows) for key in ("requests", "unforeseen", "seconds")}
        figures[scope] |= {"statuses": dict(sorted(statuses.items())), "faults": [row["faults"] for row in rows]}
    return {"figures": figures}


def ask(scope: Scope, folder: Path, *options: str) -> dict[str, Any]:
    """Runs one round. Its faults are what schemathesis found, and lines of the log about what nobody foresaw."""
    folder.mkdir(parents=True)
    began = time.monotonic()
    with running_service(folder / "data", poll_s="0.4", heartbeat_s="2") as service:
        key, maker = add_keys(service, scope, "read,capture,submit")
        done = ask_as_described(service, folder, key, *options, ids=make_ids(service, maker, folder))
        log = service.log.read_text()
    statuses = Counter(re.findall(r"\] request  .* status=(\d+)", log))
    faults = [line for line in log.splitlines() if "unforeseen" in line]
    return {
        "requests": statuses.total(),
        "unforeseen": len(faults),
        "seconds": round(time.monotonic() - began),
        "statuses": dict(statuses),
        "faults": faults + ([done.stdout[-8000:]] if done.returncode else []),
    }


def make_ids(service: RunningService, key: str, folder: Path) -> dict[str, list[str]]:
    """Makes things that requests can ask for. Returns their ids by the parameters of paths."""
    with client(service, key) as http:
        archives = [packed(small_capture(folder / f"capture{seed}", seed)) for seed in range(4)]
        captures = [upload(http, archive).json()["id"] for archive in archives]
        jobs = [http.post("/v1/jobs", json={"capture_id": capture}).json()["id"] for capture in captures]
        sessions = [http.post("/v1/sessions", json={"label": "Anna"}).json()["id"]]
        batches = [http.post("/v1/batches", json={"captures": captures}).json()["id"]]
    return {"capture_id": captures, "job_id": jobs, "session_id": sessions, "batch_id": batches}
