"""Attacks on a real service of this machine, over loopback, each bounded: attack, what is expected, what was seen.

The service is the tests' one without a worker, at 1,024 open files, systemd's default. A witness at another address
asks for /healthz and, with another key, for a list, twenty times a second (``tests.support.attacks``).
"""

import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import httpx

from tests.server.worker.test_durability import own_worker
from tests.support.attacks import (
    ATTACKER,
    Witness,
    add_keys,
    ask_often,
    client,
    flood_header,
    get_begun,
    half_body,
    heavy_capture,
    limit_files,
    silent_connections,
    slow_capture,
    spoiled_capture,
)
from tests.support.services import (
    ROOT,
    RunningService,
    await_state,
    packed,
    running_service,
    served_client,
    small_capture,
    upload,
)

FILES, CONNECTIONS, MEGABYTES, LITTLE_MB = 1024, 1100, 98, 500
HEALTHZ_S, SLOWER, MEMORY_MB = 1.0, 3.0, 300.0  # the worst answer, the median beside a calm one, and what comes on top


@dataclass(frozen=True)
class Seen:
    """Holds an attack, what is expected of the service under it, what was seen, and whether that is as expected."""

    attack: str
    expected: str
    seen: str
    held: bool


@dataclass(frozen=True)
class Field:
    """Holds the service under attack, an attacker's and a witness's key, paths of the attacker's pictures (4 MB each)
    and waiting job, what a calm time looks like, and a folder."""

    service: RunningService
    attacker: str
    other: str
    pictures: str
    job: str
    calm: Witness
    folder: Path


def run() -> dict[str, Any]:
    """Runs all attacks. Returns the figures and a line for each attack."""
    with tempfile.TemporaryDirectory(prefix="eigenhead-attacks-") as name:
        folder = Path(name)
        to: dict[str, Any] = {"webhook_origins": '["https://*"]', "deliver_prefixes": f'["file://{folder}/heads/"]'}
        with running_service(folder / "data", worker=False, **to) as service:
            attacker, other = add_keys(service, "read,capture,submit", "read,capture")
            limit_files(service, FILES)
            with client(service, other) as http:  # both processes that check have begun
                upload(http, packed(small_capture(folder / "other"))).raise_for_status()
            with client(service, attacker) as http:
                capture = upload(http, packed(small_capture(folder / "large", size=1200))).json()["id"]
                job = http.post("/v1/jobs", json={"capture_id": capture}).headers["Location"]
            calm = Witness(service, other)
            with calm.watching():
                time.sleep(3.0)
            field = Field(service, attacker, other, f"/v1/captures/{capture}/images", job, calm, folder)
            rows = [others_under(field, name, partial(attack, field)) for name, attack in BESIDE.items()]
            rows += [attack(field) for attack in ATTACKS]
    rows += [ask_test(name, where) for name, where in TESTS.items()]
    held = {True: "held", False: "FAILS"}
    lines = [f"{held[row.held]}  {row.attack}: expected {row.expected}; seen {row.seen}" for row in rows]
    return {"figures": {"attacks": len(rows), "held": sum(row.held for row in rows)}, "lines": lines}


def others_under(field: Field, name: str, attack: Callable[[], object]) -> Seen:
    """Runs an attack beside the witness, and compares what the witness felt with a calm time."""
    witness = Witness(field.service, field.other)
    with witness.watching():
        attack()
        time.sleep(0.5)
    ratio = witness.others_median_s / field.calm.others_median_s
    more = max(witness.memory_mb) - max(field.calm.memory_mb)
    held = not witness.failures and max(witness.healthz_s) < HEALTHZ_S and ratio < SLOWER and more < MEMORY_MB
    seen = f"healthz {max(witness.healthz_s):.2f} s, others {ratio:.1f} times, {more:.0f} MB more, "
    seen += f"{len(witness.failures)} failures"
    expected = f"healthz {HEALTHZ_S:.0f} s, others {SLOWER:.0f} times, {MEMORY_MB:.0f} MB more, no failure"
    return Seen(name, expected, seen, held)


def hold(field: Field, begin: bytes, addresses: tuple[str, ...] = (ATTACKER,), buffer: int = 0) -> None:
    with silent_connections(field.service, CONNECTIONS, begin, addresses, buffer):
        time.sleep(3.0)


def send_metadata(field: Field) -> Seen:
    archive, statuses = heavy_capture(field.folder / "metadata"), list[int]()
    with client(field.service, field.attacker, 10.0) as http:
        row = others_under(field, "60 MB of EXIF in a JPEG", lambda: statuses.append(upload(http, archive).status_code))
    held = row.held and statuses == [422]
    return Seen(row.attack, f"422 within 10 s, {row.expected}", f"{statuses}, {row.seen}", held)


def give_up_uploads(field: Field) -> Seen:
    slow, fine = slow_capture(field.folder / "slow"), packed(small_capture(field.folder / "fine"))
    calm_s = statistics.median(seconds_of_upload(field, fine) for _ in range(9))
    under = list[float]()
    for number in range(10):
        with client(field.service, field.attacker, 2.0) as http, suppress(httpx.TimeoutException):
            upload(http, slow)
        under += [seconds_of_upload(field, fine)] if number % 2 else []
    under_s = statistics.median(under)
    seen = f"{under_s:.2f} s beside {calm_s:.2f} s, {max(under):.2f} at worst"
    expected = "another key's upload takes 1.5 times as long at most"
    return Seen("five times two uploads that are given up", expected, seen, under_s < 1.5 * calm_s)


def call_inside(field: Field) -> Seen:
    """Webhooks and deliveries of a real capture's job, to this machine, its network and the cloud's metadata."""
    places = [
        {"webhook": {"url": f"https://{host}/"}} for host in ("127.0.0.1", "169.254.169.254", "[::1]", "10.0.0.1")
    ]
    places += [{"deliver_to": url} for url in ("file:///etc/", "s3://other/", f"file://{field.folder}/heads/../")]
    with client(field.service, field.attacker) as http:
        capture = upload(http, packed(small_capture(field.folder / "inside"))).json()["id"]
        seen = [http.post("/v1/jobs", json={"capture_id": capture, **at}).status_code for at in places]
    return Seen("webhooks and deliveries to the inside", "4xx each", f"{seen}", all(400 <= s < 500 for s in seen))


def send_hostile_files(field: Field) -> Seen:
    """Camera files of other programs and feature points that are deep, huge, cyclic, or lie about their size."""
    deep, many = b"[" * 200_000, b"&a [" + b"*a, " * 50_000
    bombs = b"a: &a [x,x,x]\nb: &b [*a,*a,*a]\n" + b"".join(b"c%d: [*b,*b]\n" % n for n in range(2000))
    files = {"cameras.yaml": (b"%YAML:1.0\n" + many, bombs), "transforms.json": (deep, b'{"frames": 1e999}')}
    files |= {"cameras.bin": (b"\xff" * 64, bytes(4096)), "cameras.toml": (b"a = " + deep, b"[a.b]\n" * 9999)}
    files |= {"cameras.json": (b"[" + b"1," * 30_000_000 + b"1]", b'{"cameras": ' + b"9" * 5_000_000 + b"}")}
    files |= {"scale.json": (deep, b'{"mm": NaN}'), "features.json": (deep, b'{"points": ' + b"9" * 9999 + b"}")}
    slowest, statuses = 0.0, list[int]()
    for number, (name, data) in enumerate((name, data) for name, some in files.items() for data in some):
        change = partial(replace_cameras, name=name, data=data)
        with client(field.service, field.attacker) as http:
            began = time.monotonic()
            archive = spoiled_capture(field.folder / f"hostile{number}", change)
            statuses.append(upload(http, archive).status_code)
            slowest = max(slowest, time.monotonic() - began)
    seen, held = f"{sorted(set(statuses))}, {slowest:.1f} s at worst", all(400 <= s < 500 for s in statuses)
    return Seen(f"{len(statuses)} hostile files of cameras and points", "4xx each in 10 s", seen, held and slowest < 10)


def replace_cameras(folder: Path, name: str, data: bytes) -> None:
    if "features" not in name:
        (folder / "cameras.json").unlink()
    (folder / name).write_bytes(data)


def ask_much(field: Field) -> Seen:
    statuses = set[int]()
    name = "2,000 small requests of a key, 100 at once"
    row = others_under(field, name, lambda: statuses.update(ask_often(field.service, field.attacker, "/v1/jobs")))
    return Seen(name, f"200 each, {row.expected}", f"{sorted(statuses)}, {row.seen}", row.held and statuses == {200})


def starve_worker(field: Field) -> Seen:
    """A worker of ``LITTLE_MB`` in a group of its own (cgroups of version 1) takes a real job of a simulated shot."""
    name, group = f"a worker with {LITTLE_MB} MB", Path("/sys/fs/cgroup/memory/eigenhead-attacks")
    try:
        group.mkdir()
        (group / "memory.limit_in_bytes").write_text(str(LITTLE_MB << 20))
    except OSError as error:
        return Seen(name, "a group of its own", f"not tried: {error.strerror}", held=True)
    work = "server.tasks.reconstruct:reconstruct_capture"
    with served_client(field.folder / "little", worker=False, work=work) as (service, http):
        capture = http.post("/v1/captures", json={"seed": 1}).json()["id"]
        job = http.post("/v1/jobs", json={"capture_id": capture}).json()["id"]
        with own_worker(service) as process:
            (group / "cgroup.procs").write_text(str(process.pid))
            ended = await_state(http, job, ("succeeded", "failed"), 600)
    group.rmdir()
    seen = ended["state"] if ended["error"] is None else ended["error"]["detail"]
    return Seen(name, "it ends, or says so", seen, ended["state"] == "succeeded" or "signal 9" in seen)


def ask_test(name: str, where: str) -> Seen:
    """Runs a test that holds a promise on a real service of its own."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "slow or not slow", *shlex.split(where)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=3600, check=False)
    seen = done.stdout.strip().splitlines()[-1] if done.stdout.strip() else done.stderr[-200:]
    return Seen(name, "its test passes", seen, done.returncode == 0)


def seconds_of_upload(field: Field, archive: bytes) -> float:
    with client(field.service, field.other) as http:
        began = time.monotonic()
        upload(http, archive).raise_for_status()
        return time.monotonic() - began


BESIDE: dict[str, Callable[[Field], object]] = {
    f"{MEGABYTES} MB of one header, twice": lambda field: [flood_header(field.service, MEGABYTES) for _ in range(2)],
    f"{CONNECTIONS} silent connections at {FILES} open files": lambda field: hold(field, b""),
    f"{CONNECTIONS} half bodies with a key": lambda field: hold(field, half_body("/v1/sessions", field.attacker)),
    f"{CONNECTIONS} event streams of a key": lambda field: hold(
        field, get_begun(field.job + "/events", field.attacker)
    ),
    f"{CONNECTIONS} readers of three addresses who do not read": lambda field: hold(
        field, get_begun(field.pictures + "/cam00", field.attacker), (ATTACKER, "127.0.0.4", "127.0.0.5"), buffer=4096
    ),
}
ATTACKS = (send_metadata, give_up_uploads, call_inside, send_hostile_files, ask_much, starve_worker)
AT = "tests/server"
TESTS = {
    "a first key over HTTP, pages that frame ours, erasing with the scope capture": f"{AT}/http/test_auth.py",
    "98 MB of one trailer; half a header, half a body, and silence": f"{AT}/http/test_connections.py",
    "an archive of arrays that lies, a face of six million corners": "tests/rig/formats/meshes -k 'lies or million'",
    "a clock that jumps by 60 days": f"{AT}/services/test_retention.py -k clock",
    "jobs by a clock that is ahead, goes back, jumps": f"{AT}/worker/test_durability.py -k any_clock",
    "100 jobs, 30 kills, on SQLite and on PostgreSQL": f"{AT}/worker/test_durability.py -k 'survive_kills and 100-30'",
    "kills in every stage of a real head": f"{AT}/worker/test_durability.py -k 'last_byte and 5-4'",
    "a data folder of version 3ee27d5": f"{AT}/worker/test_durability.py -k earlier",
    "schemathesis with a key of each scope": f"{AT}/http/test_openapi.py",
    "a result changed or cut on the disk": f"{AT}/services/test_retention.py -k somebody_changed",
    "an erased subject": f"{AT}/services/test_erasure.py {AT}/worker/test_results_store.py -k 'brought or every'",
    "work killed with signal 9": f"{AT}/worker/test_worker.py -k kills",
    "a tus upload cut, and many open": f"{AT}/http/test_tus.py {AT}/services/test_uploads.py",
    "a database gone, emptied, damaged": f"{AT}/http/test_serve.py -k lost_database",
    "code in a row of the job database": f"{AT}/services/test_failures.py",
    "jobs of dead workers": f"{AT}/worker/test_engine.py {AT}/http/test_job_ends.py",
    "a data folder that is read only": f"{AT}/wire/test_problems.py",
    "a disk that fills at ten moments of a job": f"{AT}/http/test_hostile.py -k 'full_disk or (any_moment and 10)'",
    "units, containers and pods": "tests/test_deploy.py",
}
