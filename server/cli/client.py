"""Provides a Python client of the service, which resumes uploads, waits with progress, and checks downloads.

with Client("http://127.0.0.1:8600") as client:
    capture = client.upload(Path("capture"))
    job = client.wait(client.submit(capture["id"])["id"], report=print)
    client.download(job["id"], Path("out"))
"""

import base64
import hashlib
import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import httpx

from rig.errors import EigenheadError
from rig.formats.captures.archive import is_archive, pack_folder
from rig.progress import Progress
from server.storage.result_folder import fresh_folder

if TYPE_CHECKING:
    from server.storage.records import JsonObject

PART_BYTES = 8 << 20
TUS = {"Tus-Resumable": "1.0.0"}
RETRY_STATUSES = (429, 502, 503, 504)


class ServiceError(EigenheadError):
    """Reports a request that the service refused. ``status``, ``kind`` and ``errors`` are fields of the problem
    document with which the service answered."""

    def __init__(self, status: int, kind: str, detail: str, errors: list[str]) -> None:
        super().__init__(detail + "".join(f"\n  - {error}" for error in errors))
        self.status, self.kind, self.detail, self.errors = status, kind, detail, errors


class Unreachable(EigenheadError):
    """Reports a service that could not be reached within the seconds that the client waits."""

    def __init__(self, url: str, error: Exception) -> None:
        why = str(error) or type(error).__name__
        super().__init__(f"{url} does not answer ({why}); is `eigenhead serve` running there?")


class JobEnded(EigenheadError):
    """Reports a job that failed or was cancelled; ``job`` is the job's JSON document."""

    def __init__(self, job: "JsonObject") -> None:
        error = job.get("error")
        faults = "" if error is None else "".join(f"\n  - {fault}" for fault in error["errors"])
        detail = "no reason given" if error is None else error["detail"]
        super().__init__(f"the job {job['state']}: {detail}{faults}")
        self.job = job


class Client:
    """Calls one service. If a connection breaks or the service is busy, a request is repeated for ``patience_s``
    seconds. A request that the service refuses is not repeated."""

    def __init__(self, url: str, key: str | None = None, *, patience_s: float = 30.0, timeout_s: float = 300.0) -> None:
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        self._http = httpx.Client(base_url=url, headers=headers, timeout=httpx.Timeout(timeout_s, connect=10.0))
        self._patience_s = patience_s
        self.url = url

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        self._http.close()

    def get(self, path: str, **query: Any) -> Any:
        """Sends a GET and returns the JSON of the answer. Query parameters that are None are left out. Raises
        ServiceError and Unreachable."""
        return self._request("GET", path, params={k: v for k, v in query.items() if v is not None}).json()

    def post(self, path: str, document: Any = None, headers: dict[str, str] | None = None) -> Any:
        """Sends a POST of ``document`` and returns the JSON of the answer. Raises ServiceError and Unreachable.

        After a broken connection the client repeats the request only if ``headers`` has an Idempotency-Key, since the
        service may have acted.
        """
        again = bool(headers and "Idempotency-Key" in headers)
        return self._request("POST", path, json=document, headers=headers, repeat=again).json()

    def put(self, path: str, document: Any) -> Any:
        """Sends a PUT of ``document`` and returns the JSON of the answer. Raises ServiceError and Unreachable."""
        return self._request("PUT", path, json=document).json()

    def delete(self, path: str) -> None:
        """Sends a DELETE. Raises ServiceError if the service refuses the request, and Unreachable without an answer."""
        self._request("DELETE", path)

    def upload(self, source: Path, *, report: Progress | None = None, **about: str) -> "JsonObject":
        """Uploads a capture folder or an archive of one, resuming after every interruption, and returns the capture.

        ``about`` may hold session, label and expression. Raises ServiceError naming every fault of the capture, and
        Unreachable.
        """
        with tempfile.TemporaryDirectory() as scratch:
            archive = source
            if source.is_dir():
                archive = Path(scratch) / "capture.tar"
                pack_folder(source, archive)
            return self._upload_archive(archive, report or (lambda stage, fraction: None), about)

    def submit(
        self,
        capture_id: str,
        *,
        model: str | None = None,
        settings: Mapping[str, object] | None = None,
        key: str | None = None,
    ) -> "JsonObject":
        """Queues a job and returns its document. ``key`` is the idempotency key that makes the request safe to repeat;
        by default a new one is made. Raises ServiceError and Unreachable."""
        request = {"capture_id": capture_id, "model": model, "settings": settings}
        headers = {"Idempotency-Key": key or hashlib.sha256(f"{capture_id}{time.time_ns()}".encode()).hexdigest()}
        return self.post("/v1/jobs", request, headers)

    def events(self, job_id: str) -> Iterator[tuple[str, "JsonObject"]]:
        """Yields kind and document of each event of a job until the job ends. Reconnects after an interruption without
        repeating events.

        Raises Unreachable if no connection succeeds for ``patience_s`` seconds. The method waits for the next event
        without a time limit.
        """
        last, deadline = "0", time.monotonic() + self._patience_s
        while True:
            try:
                with self._stream(job_id, last) as events:
                    try:
                        for kind, identity, document in events:
                            last = identity
                            yield kind, document
                            if kind == "end":
                                return
                    finally:
                        deadline = time.monotonic() + self._patience_s
            except httpx.TransportError as error:
                if time.monotonic() > deadline:
                    raise Unreachable(self.url, error) from error
            time.sleep(0.3)

    def wait(self, job_id: str, *, report: Progress | None = None) -> "JsonObject":
        """Waits until the job ends and returns its document. Raises JobEnded if the job failed or was cancelled."""
        for kind, document in self.events(job_id):
            if kind == "end":
                if document["state"] != "succeeded":
                    raise JobEnded(document)
                return document
            if report is not None and "stage" in document:
                report(document["stage"], document["progress"])
        raise AssertionError("a stream of events ends with 'end'")

    def download(self, job_id: str, folder: Path) -> list[Path]:
        """Writes the files of a job's result into ``folder``, replacing an earlier result, and returns their paths.
        Raises ServiceError, without changing the folder, if a file does not have its SHA-256."""
        job = self.get(f"/v1/jobs/{job_id}")
        with fresh_folder(folder) as fresh:
            for name, described in job["files"].items():
                data = self._request("GET", f"/v1/jobs/{job_id}/result/{name}").content
                if hashlib.sha256(data).hexdigest() != described["sha256"]:
                    raise ServiceError(502, "damaged-download", f"{name} arrived damaged; fetch it again.", [])
                path = fresh / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_bytes(data)
        return [folder / name for name in job["files"]]

    def _upload_archive(self, archive: Path, report: Progress, about: dict[str, str]) -> "JsonObject":
        if not is_archive(archive):
            raise ServiceError(422, "no-archive", f"{archive.name} is no .zip, .tar or .tar.gz", [])
        size = archive.stat().st_size
        metadata = ",".join(f"{k} {base64.b64encode(v.encode()).decode()}" for k, v in about.items() if v)
        headers = TUS | {"Upload-Length": str(size)} | ({"Upload-Metadata": metadata} if metadata else {})
        location = self._request("POST", "/v1/uploads", headers=headers).headers["location"]
        offset, capture, deadline = 0, None, time.monotonic() + self._patience_s
        with archive.open("rb") as stream:
            while capture is None:
                report("upload", offset / max(size, 1))
                before, (offset, capture) = offset, self._send_part(location, stream, offset)
                if offset > before:
                    deadline = time.monotonic() + self._patience_s
                elif capture is None and time.monotonic() > deadline:
                    raise ServiceError(503, "upload-stalled", f"The upload stands still at {offset:,} bytes.", [])
        return self.get(capture)

    def _send_part(self, location: str, stream: Any, offset: int) -> tuple[int, str | None]:
        """Sends one PATCH and returns the new offset (bytes) and the capture's address once the upload is complete.
        After a failed PATCH the client asks the service by HEAD for the number of bytes received."""
        stream.seek(offset)
        data = stream.read(PART_BYTES)
        checksum = "sha256 " + base64.b64encode(hashlib.sha256(data).digest()).decode()
        headers = TUS | {"Content-Type": "application/offset+octet-stream", "Upload-Offset": str(offset)}
        headers |= {"Upload-Checksum": checksum}
        try:
            response = self._http.patch(location, content=data, headers=headers, timeout=600)
            if response.status_code not in (409, 460, *RETRY_STATUSES):
                _raise_for(response)
                return int(response.headers["upload-offset"]), response.headers.get("location")
            time.sleep(0.2)
        except httpx.TransportError:
            pass
        head = self._request("HEAD", location, headers=TUS)
        return int(head.headers["upload-offset"]), head.headers.get("location")

    @contextmanager
    def _stream(self, job_id: str, last: str) -> Iterator[Iterator[tuple[str, str, Any]]]:
        """Opens one connection and yields its events: kind, id and document. Raises httpx.TransportError if the
        connection fails."""
        headers = {"Last-Event-ID": last, "Accept": "text/event-stream"}
        timeout = httpx.Timeout(10.0, read=30.0)  # the service sends a comment every 15 s
        with self._http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as response:
            if response.status_code in RETRY_STATUSES:
                raise httpx.RemoteProtocolError(f"status {response.status_code}")
            if response.status_code >= 400:
                response.read()
                _raise_for(response)
            yield _events(response, last)

    def _request(self, method: str, path: str, *, repeat: bool = True, **options: Any) -> httpx.Response:
        deadline, wait = time.monotonic() + self._patience_s, 0.1
        while True:
            try:
                response = self._http.request(method, path, **options)
            except httpx.TransportError as error:
                unsent = isinstance(error, httpx.ConnectError)
                if time.monotonic() > deadline or not (repeat or unsent):
                    raise Unreachable(self.url, error) from error
            else:
                if response.status_code not in RETRY_STATUSES or time.monotonic() > deadline or not repeat:
                    _raise_for(response)
                    return response
            time.sleep(wait)
            wait = min(2.0, wait * 2)


def _events(response: httpx.Response, last: str) -> Iterator[tuple[str, str, Any]]:
    fields: dict[str, str] = {}
    for line in response.iter_lines():
        if line:
            name, _, value = line.partition(":")
            fields[name] = value.strip()
        elif "data" in fields:
            yield fields.get("event", ""), fields.get("id", last), json.loads(fields["data"])
            fields = {}


def _raise_for(response: httpx.Response) -> None:
    if response.status_code < 400:
        return
    problem: "JsonObject | None" = None
    with suppress(ValueError):
        problem = response.json()
    detail = f"{response.request.method} {response.request.url.path}: {response.status_code}"
    if not problem:
        raise ServiceError(response.status_code, "", detail, [])
    kind, errors = problem.get("type", ""), problem.get("errors", [])
    raise ServiceError(response.status_code, kind, problem.get("detail") or detail, errors)
