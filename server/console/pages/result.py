"""The head: turned, coloured, measured, compared, fetched."""

from pathlib import Path
from typing import Any

from nicegui import ui
from nicegui.elements import scene
from starlette.responses import RedirectResponse

from server.console.page import Page, shared, show
from server.console.pages.jobs import jobs_list
from server.console.pages.rig import read_report
from server.services.service import Service

THREE_JS = Path(scene.__file__).with_name("dist")  # NiceGUI's own bundle of three.js
MOSTLY = 0.25  # of a contour, as on the page Jobs


class ResultPage(Page, component="result.js", esm={"nicegui-scene": str(THREE_JS)}):
    def look(self) -> dict[str, Any]:
        results = shared.get("results", 1.0, lambda: finished(self.service))
        chosen = self.choice.get("job") or (results[0]["id"] if results else None)
        known = next((job for job in results if job["id"] == chosen), None)
        return {"results": results, "job": known and head_of(self.service, known), "asked": self.choice.get("job")}


def finished(service: Service) -> list[dict[str, Any]]:
    keys = ("id", "capture", "captured", "capture_id", "created", "finished", "settings", "model")
    return [{key: job[key] for key in keys} for job in jobs_list(service) if job["state"] == "succeeded"]


def head_of(service: Service, job: dict[str, Any]) -> dict[str, Any]:
    """What stands beside the head: measurements, warnings, files, whether the truth is known."""
    report = read_report(service, job["id"])
    truth = service.store.folder("captures", job["capture_id"]) / "truth" / "head.ply"
    residuals = clear_residuals(report)
    return job | {
        "measurements": report.get("measurements", {}),
        "quality": report.get("quality", {}),
        "warnings": report.get("warnings", []),
        "seconds": report.get("seconds", {}).get("total"),
        "clear_views": len(residuals),
        "contour_px": sum(residuals) / len(residuals) if residuals else None,
        "method": report.get("method"),
        "model_name": report.get("model", {}).get("name"),
        "truth": truth.is_file(),
        "files": {
            name: file["bytes"] for name, file in service.jobs.get(job["id"])["files"].items() if "/" not in name
        },
    }


def clear_residuals(report: dict[str, Any]) -> list[float]:
    """Contour residuals (px) of the cameras that see most of the rim: elsewhere they tell of hair and clothes."""
    cameras = [c for c in report.get("cameras", {}).values() if c.get("used") and c.get("contour_rms_px") is not None]
    return [c["contour_rms_px"] for c in cameras if (c.get("excluded_share") or 0.0) < MOSTLY]


@ui.page("/result")
@ui.page("/result/{job}")
async def result_page(job: str = "") -> RedirectResponse | None:
    return await show("result", ResultPage, job=job or None)
