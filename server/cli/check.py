"""Implements ``eigenhead check``: finds what is wrong with a capture without fitting a head.

Files, cameras, clean plates and feature points are checked as the service checks an upload (``server.tasks.ingest``):
if these checks find no fault, the outlines are extracted and used to check pictures and cameras. A fault of this
machine is raised as an error; a fault of the capture is not."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipeline.faces.networks import DamagedNetwork, load_networks
from rig.errors import EigenheadError, InputError, WrongVariable
from rig.formats.captures.capture_folder import SCALE, capture_root, unread_files
from rig.formats.captures.shot_files import BESIDE_PICTURES, listed_pictures
from rig.formats.pictures.images import decode_image_file
from rig.formats.pictures.picture_names import entry
from rig.messages.message import compose, documents_of, texts_of
from rig.progress import Progress
from server.cli.answers import service_settings
from server.tasks.child import WorkFailed
from server.tasks.ingest import check_capture, check_views
from server.tasks.photographs import photographs_alone, read_scaled_capture
from server.tasks.reconstruct import folder_of


def checked(capture: Path, settings: dict[str, object], *, report: Progress) -> dict[str, Any]:
    """Returns what `eigenhead check --json` prints: the ``faults`` that make a reconstruction of the capture fail, its
    ``warnings``, and for photographs without cameras sentences on what a reconstruction will do (``will``).

    Raises InputError for wrong settings, and WrongVariable or WorkFailed if this machine, not the capture, is at fault.
    """
    from pipeline.evidence.plausibility import refuse
    from pipeline.settings import settings_from_document

    chosen = settings_from_document(settings)
    document: dict[str, Any] = {"capture": str(capture), "cameras": [], "front": None}
    document |= {"faults": [], "fault_messages": [], "warnings": [], "will": []}
    try:
        with folder_of(capture) as folder:
            if photographs_alone(folder):
                document["warnings"] = documents_of(unread_files(capture_root(folder), []))
                document["cameras"], document["will"] = _plan_for_photographs(folder, report)
                _check_front(chosen.front, document["cameras"])
                return document
            content = check_capture(capture_root(folder), service_settings().image_pixels, report)
            document["cameras"] = [camera.name for camera in content.cameras]
            _check_front(chosen.front, document["cameras"])
            document["front"] = chosen.front or content.front
            shot, rig = read_scaled_capture(folder)
            refuse(shot.remarks, chosen.fail_on)
            document["warnings"] = documents_of(check_views(shot, rig, chosen, load_networks(), report=report))
    except (DamagedNetwork, WrongVariable, WorkFailed):
        raise
    except InputError as error:
        document["faults"], document["fault_messages"] = texts_of(error.faults), documents_of(error.faults)
    except EigenheadError as error:
        document["faults"], document["fault_messages"] = [error.message.text], [error.message.document()]
    return document


def _check_front(front: str | None, cameras: list[str]) -> None:
    if front is not None and front not in cameras:
        raise InputError("front", [compose("front-of-other-capture", front=f"{front!r:.80}", cameras=cameras)])


def _plan_for_photographs(folder: Path, report: Progress) -> tuple[list[str], list[str]]:
    """Returns the names of the photographs of a folder without cameras, and sentences on what a reconstruction will do.

    Raises InputError if the photographs or scale.json cannot be used."""
    from calibration.scene.photographs import find_photographs
    from rig.formats.cameras.scale_json import read_scale

    root = capture_root(folder)
    photographs = find_photographs(root)
    names = photographs.names
    beside = [path for kind in BESIDE_PICTURES for path in listed_pictures(entry(root, kind))]
    _check_pictures([*(path for shots in photographs.files.values() for path in shots.values()), *beside], root, report)
    known = entry(root, SCALE).is_file()
    if known:
        read_scale(entry(root, SCALE), names)
    scale = (
        "scale.json tells the scale" if known else "the scale will be ASSUMED from a head's mean size: add scale.json"
    )
    present = [kind for kind in ("masks", "background") if entry(root, kind).is_dir()]
    masks = f"{present[0]}/ tells the subject" if present else "the subject will be found from the photographs"
    begun = f"no cameras.json: {len(names)} photographs will be calibrated from the scene"
    return list(names), [begun, scale, masks]


def _check_pictures(files: list[Path], root: Path, report: Progress) -> None:
    """Decodes the pictures one by one, and raises InputError naming every picture that is damaged or too large."""
    faults = []
    for number, path in enumerate(files):
        report("check", number / len(files))
        fault = decode_image_file(path, path.relative_to(root).as_posix(), "grey")[2]
        faults += [] if fault is None else [fault]
    if faults:
        raise InputError("photographs", faults)


def lines(document: Mapping[str, Any]) -> list[str]:
    """Returns the findings of a check as lines for people."""
    findings = [f"fault    {fault}" for fault in document["faults"]]
    findings += [f"warning  {warning['code']}: {warning['message']}" for warning in document["warnings"]]
    findings += [f"will     {step}" for step in document["will"]]
    verdict = "cannot be reconstructed" if document["faults"] else "can be reconstructed"
    summary = f"{len(document['cameras'])} cameras, " if document["cameras"] else ""
    summary += f"front {document['front']}; " if document["front"] else ""
    return [f"{document['capture']}: {summary}{verdict}", *findings]
