"""``eigenhead check``: what is wrong with a capture, before anybody waits for a fit.

Files, cameras, plates and feature points are judged as at the service's door (``server.tasks.ingest``); where they are
in order, outlines are asked what they say of pictures and cameras (``pipeline.silhouettes.usable_views``)."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, TypedDict

from rig.capture import Capture
from rig.errors import EigenheadError, InputError
from rig.formats.capture_folder import capture_root, read_capture
from server.cli.answers import service_settings
from server.cli.reconstruct_local import folder_of
from server.tasks.ingest import check_capture
from server.tasks.prepare import prepare_kernels

if TYPE_CHECKING:
    from pipeline.imaging.silhouette import Silhouette
    from pipeline.settings import Settings

Report = Callable[[str, float], None]


class Warned(TypedDict):
    code: str
    message: str


class Checked(TypedDict):
    """What `eigenhead check --json` prints: with ``faults`` a reconstruction fails, with ``warnings`` it goes on."""

    capture: str
    cameras: list[str]
    front: str | None
    faults: list[str]
    warnings: list[Warned]


def checked(capture: Path, settings: dict[str, object], *, report: Report) -> Checked:
    """Every fault and warning of a capture folder or archive that needs no fit. Raises InputError for settings that are
    none."""
    from pipeline.settings import settings_from_document

    chosen = settings_from_document(settings)
    found = Checked(capture=str(capture), cameras=[], front=None, faults=[], warnings=[])
    try:
        with folder_of(capture) as folder:
            content = check_capture(capture_root(folder), service_settings().image_pixels, report)
            found["cameras"] = [camera.name for camera in content.cameras]
            found["front"] = content.front
            found["warnings"] = _told_by_outlines(folder, chosen, report)
    except InputError as error:
        found["faults"] = list(error.faults)
    except EigenheadError as error:
        found["faults"] = [str(error)]
    return found


def _told_by_outlines(folder: Path, chosen: "Settings", report: Report) -> list[Warned]:
    from pipeline.settings import OutputSettings
    from pipeline.silhouettes.segment import segment
    from pipeline.silhouettes.usable_views import usable_views

    shot, rig = read_capture(folder)
    prepare_kernels(report, replace(chosen, detail="span", outputs=OutputSettings(surface="head")))  # no dense loops

    def segmented(capture: Capture) -> dict[str, "Silhouette"]:
        return segment(capture, rig, chosen.segmentation, report=report)

    views = usable_views(shot, rig, segmented, exchanged=chosen.exchanged_pictures)
    return [Warned(code=warning.code, message=warning.message) for warning in views.warnings]


def lines(found: Checked) -> list[str]:
    """The same for people."""
    told = [f"fault    {fault}" for fault in found["faults"]]
    told += [f"warning  {warning['code']}: {warning['message']}" for warning in found["warnings"]]
    verdict = "cannot be reconstructed" if found["faults"] else "can be reconstructed"
    seen = f"{len(found['cameras'])} cameras, front {found['front']}; " if found["cameras"] else ""
    return [f"{found['capture']}: {seen}{verdict}", *told]
