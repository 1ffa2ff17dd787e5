"""The head: turned, coloured, measured, compared, fetched."""

from collections.abc import Mapping
from pathlib import Path
from typing import TypedDict

from nicegui import ui
from nicegui.elements import scene
from starlette.responses import RedirectResponse

from pipeline.results.report import Measured, Report, WarningReport
from server.console.page import Page, shared, show
from server.console.pages.jobs import ListedJob, jobs_list
from server.console.pages.rig import read_report
from server.services.service import Service

THREE_JS = Path(scene.__file__).with_name("dist")  # NiceGUI's own bundle of three.js
MOSTLY = 0.25  # of a contour, as on the page Jobs


class ResultLine(TypedDict):
    """A job with a result; ``capture`` and ``captured`` are its capture's label and time, ``subject`` whose session the
    capture belongs to."""

    id: str
    capture: str
    captured: str | None
    capture_id: str | None
    created: str | None
    finished: str | None
    settings: Mapping[str, object]
    model: str | None
    session: str | None
    subject: str


class Head(ResultLine):
    """What stands beside the head: measurements, warnings, files and their bytes, whether the truth is known."""

    measurements: dict[str, Measured]
    quality: dict[str, float | None]
    warnings: list[WarningReport]
    seconds: float | None
    clear_views: int
    contour_px: float | None
    method: str | None
    level: str | None
    model_name: str | None
    truth: bool
    files: dict[str, int]


class ResultShown(TypedDict):
    results: list[ResultLine]
    job: Head | None
    asked: str | None


class ResultPage(Page, component="result.js", esm={"nicegui-scene": str(THREE_JS)}):
    def look(self) -> ResultShown:
        results: list[ResultLine] = shared.get("results", 1.0, lambda: finished(self.service))
        chosen = self.choice.get("job") or (results[0]["id"] if results else None)
        known = next((job for job in results if job["id"] == chosen), None)
        head = None if known is None else head_of(self.service, known)
        return {"results": results, "job": head, "asked": self.choice.get("job")}


def finished(service: Service) -> list[ResultLine]:
    subjects = {record.id: record.label for record in service.store.sessions()}
    done = [listed for listed in jobs_list(service) if listed.job.state == "succeeded"]
    return [result_line(listed, subjects.get(listed.session or "", "")) for listed in done]


def result_line(listed: ListedJob, subject: str) -> ResultLine:
    job = listed.job
    return {
        "id": job.id,
        "capture": listed.capture,
        "captured": listed.captured,
        "capture_id": job.capture_id,
        "created": job.created,
        "finished": job.finished,
        "settings": job.settings,
        "model": job.model,
        "session": listed.session,
        "subject": subject,
    }


def head_of(service: Service, job: ResultLine) -> Head:
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
        "files": {name: file["bytes"] for name, file in files.items() if "/" not in name},
    }


def clear_residuals(report: Report) -> list[float]:
    """Contour residuals (px) of the cameras that see most of the rim: elsewhere they tell of hair and clothes."""
    cameras = [camera for camera in report.get("cameras", {}).values() if camera.get("used")]
    clear = [camera for camera in cameras if (camera.get("excluded_share") or 0.0) < MOSTLY]
    residuals = [camera.get("contour_rms_px") for camera in clear]
    return [residual for residual in residuals if residual is not None]


@ui.page("/result")
@ui.page("/result/{job}")
async def result_page(job: str = "") -> RedirectResponse | None:
    return await show("result", ResultPage, job=job or None)
