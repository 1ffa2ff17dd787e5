"""Implements the page Result: a head in 3D, coloured, measured and compared with others, and its files."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from nicegui.elements import scene

from pipeline.results.report_types import Report
from server.console.page import Page, serve_page, shared
from server.console.pages.jobs import capture_of
from server.console.pages.rig import read_report
from server.console.removal import removals
from server.errors import NotFound
from server.services.job_rows import STATUSES
from server.services.records import JobOut
from server.services.service import Service
from server.storage.job_index import JobQuery
from server.storage.records import JsonObject

THREE_JS = Path(scene.__file__).with_name("dist")  # NiceGUI's own bundle of three.js
MOSTLY = 0.25  # of a contour, as on the page Jobs
SHOWN = 60  # heads to choose from; the search finds the others
SUBJECTS_HEADS = 100
OF_JOB = {"id", "capture_id", "created", "finished", "settings", "model"}


class ResultPage(Page, component="result.js", esm={"nicegui-scene": str(THREE_JS)}):
    """Shows one head in 3D with its figures, and the heads to choose from."""

    def look(self) -> JsonObject:
        """Returns the shown head, which stays when new heads arrive, and the heads to choose from: the newest heads
        that match the search, and the heads of the same subject. ``total`` counts the heads that match."""
        sought, chosen = self.choice.get("find") or "", self.choice.get("job")
        results, total = shared.get(("results", sought), 1.0, lambda: newest_heads(self.service, sought))
        if chosen is None:
            chosen = results[0]["id"] if results else None
        known = next((job for job in results if job["id"] == chosen), None)
        if known is None and chosen is not None:
            done = [
                job for job in self.service.jobs.of([chosen]) if job.state == "succeeded" and job.id not in removals
            ]
            known = next(iter(result_lines(self.service, done)), None)
        if known is None:
            return {"results": results, "total": total, "job": None, "requested": self.choice.get("job")}
        if self.choice.get("job") is None:  # a head that comes in meanwhile does not take the place of the shown one
            self.choice["job"] = known["id"]
        theirs: list[JsonObject] = shared.get(
            ("results", "of", known["session"], known["capture_id"]), 1.0, lambda: heads_of_subject(self.service, known)
        )
        heads = {line["id"]: line for line in (known, *theirs, *results)}
        shown = sorted(heads.values(), key=lambda line: line["id"], reverse=True)
        head = head_of(self.service, known)
        return {"results": shown, "total": total, "job": head, "requested": self.choice.get("job")}

    def preloads(self) -> Iterable[tuple[str, str]]:
        """Returns the first view and the mesh of the shown head, so that the browser fetches them early."""
        job = self.props["state"].get("job")
        if job and "head.glb" in job["files"]:
            yield "image", f"/console/jobs/{job['id']}/first-view.jpg"
            yield "fetch", f"/console/jobs/{job['id']}/head.glb"


def newest_heads(service: Service, sought: str) -> tuple[list[JsonObject], int]:
    """Returns the newest ``SHOWN`` succeeded jobs that match a search, and the total number of jobs that match."""
    page = service.jobs.page(JobQuery(sought, STATUSES["succeeded"]), SHOWN)
    return result_lines(service, [job for job in page.items if job.id not in removals]), page.total


def heads_of_subject(service: Service, head: JsonObject) -> list[JsonObject]:
    """Returns the heads of the same capture and of all sessions with the same label, newest first, ``SUBJECTS_HEADS``
    at most."""
    captures = {head["capture_id"] or ""} | set(service.sessions.captures_of_subject(head["session"]))
    jobs = service.jobs.of_captures(captures)
    done = sorted((job for some in jobs.values() for job, state in some if state == "succeeded"), reverse=True)
    return result_lines(service, service.jobs.of([job for job in done[:SUBJECTS_HEADS] if job not in removals]))


def result_lines(service: Service, jobs: Iterable[JobOut]) -> list[JsonObject]:
    """Converts jobs that have made a head, as those of films have not, to entries of the page's list, each with label
    and time of its capture (``capture``, ``captured``) and the name of its ``subject``."""
    lines = []
    for job in (job for job in jobs if job.frames is None):
        line, of_capture = job.model_dump(include=OF_JOB), capture_of(service, job)
        subject = ""
        if of_capture["session"]:
            with suppress(NotFound):
                subject = service.store.session(of_capture["session"]).label
        lines.append(line | of_capture | {"subject": subject})
    return lines


def head_of(service: Service, job: JsonObject) -> JsonObject:
    """Returns what is shown beside a head, from its report.json; values are empty or None if report.json is missing.
    ``clear_views``: how many views see most of the rim; ``contour_px``: the mean residual of these views (px);
    ``truth``: whether the true head is known; ``files``: size of each file (bytes). Raises NotFound."""
    report = read_report(service, job["id"])
    truth = service.store.folder("captures", job["capture_id"] or "") / "truth" / "head.ply"
    residuals = [] if report is None else clear_residuals(report)
    files = service.jobs.get(job["id"]).files
    return {
        **job,
        "measurements": {} if report is None else report.get("measurements", {}),
        "quality": {} if report is None else report.get("quality", {}),
        "warnings": [] if report is None else report.get("warnings", []),
        "seconds": None if report is None else report.get("seconds", {}).get("total"),
        "clear_views": len(residuals),
        "contour_px": sum(residuals) / len(residuals) if residuals else None,
        "method": None if report is None else report.get("method"),
        "level": None if report is None else report.get("detail", {}).get("level"),
        "model_name": None if report is None else report["model"]["name"],
        "truth": truth.is_file(),
        "files": {name: file.bytes for name, file in files.items() if "/" not in name},
    }


def clear_residuals(report: Report) -> list[float]:
    """Returns the contour residuals (px) of the cameras that see most of the rim. In other cameras hair and clothes
    cause the contour residuals."""
    cameras = [camera for camera in report.get("cameras", {}).values() if camera.get("used")]
    clear = [camera for camera in cameras if (camera.get("excluded_share") or 0.0) < MOSTLY]
    residuals = [camera.get("contour_rms_px") for camera in clear]
    return [residual for residual in residuals if residual is not None]


serve_page("result", ResultPage, choices=("job", "find"), paths=("/result", "/result/{job}"))
