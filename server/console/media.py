"""Declares the routes by which the pages fetch and send files: live view, thumbnails, silhouettes, uploads, files of
results, numbers by vertex.

Each route identifies the caller by the browser's session, as the API does by an API key.

For the view through a camera, the routes send its pose in the head's frame and its photograph without lens distortion,
which fits the pinhole camera that draws the mesh.
"""

import asyncio
import json
import threading
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from queue import Empty
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from fastapi import Depends, Request, Response
from fastapi.responses import FileResponse, JSONResponse, StreamingResponse
from jaxtyping import Bool, Float, UInt8
from nicegui import app as pages
from scipy.spatial import KDTree

from pipeline.geometry.registration.rigid import rigid_procrustes
from pipeline.results.report_types import Report
from rig.camera import Camera
from rig.errors import Cancelled, EigenheadError, InputError
from rig.files import write_atomically
from rig.formats.cameras.cameras_file import find_rig_file, read_rig_file
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.ply import read_vertex_numbers
from rig.formats.pictures.images import encode_image, open_picture, read_image, write_image
from rig.geometry import RigidTransform
from rig.image import ImageRgb
from rig.mesh import Mesh
from rig.messages.message import compose
from rig.progress import Progress
from rig.rig import Rig
from server.console.head_pictures import head_picture, result_folder
from server.console.identity import caller_of, permit, service_of_pages
from server.console.live import LiveView
from server.console.page import as_problem
from server.errors import NotFound, Unavailable
from server.services.captures import picture_name
from server.services.keys import Caller
from server.services.service import Service
from server.services.truth import measure_distance
from server.services.work import check_kind
from server.storage.face_cache import faces_once
from server.storage.records import CaptureRecord, JsonObject
from server.tasks.child import WorkerContext
from server.tasks.faces import find_capture_faces
from server.wire.batch_files import SheetFormat, TableFormat, send_sheet, send_table
from server.wire.multipart import receive_calibration_pictures, receive_capture
from server.wire.send_file import send_archive, send_file, send_zip

WIDTH_MOST = 1600
MM = 1000.0

WIDTH = 640
COLOUR = (108, 178, 255)  # the accent of the pages
LINE_PX = 3

THUMBNAIL_WIDTH = 480
THUMBNAIL_QUALITY = 82
STRAIGHTENED_QUALITY = 88
ROUNDS = 12  # of nearest points, where two heads do not share their vertices
TRIMMED = 0.8  # share of the nearest pairs that a round uses: necks end at different heights
PATIENCE_S = 50.0  # for faces: eleven pictures of 12 Mpx take 4 s, forty 15
FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}

_live: dict[int, LiveView] = {}
_drawing = threading.Lock()
_finding: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)  # faces, by capture


def session(scope: str) -> Any:
    """Returns a FastAPI dependency that yields the service and the caller of the browser's session. The dependency
    raises Unauthenticated for an unknown caller, and Forbidden for a caller without ``scope``."""

    async def authenticate() -> tuple[Service, Caller]:
        service, stored = service_of_pages(), dict(pages.storage.user)
        caller = await asyncio.to_thread(caller_of, service, stored)
        return service, permit(caller, scope)

    return Depends(authenticate)


Reader = Annotated[tuple[Service, Caller], session("read")]
Taker = Annotated[tuple[Service, Caller], session("capture")]


@pages.exception_handler(EigenheadError)
async def _answer_problem(request: Request, error: Exception) -> Response:
    return as_problem(error).response()


def live_view(service: Service) -> LiveView:
    """Returns the live view of a service. All pages share it."""
    return _live.setdefault(id(service), LiveView(service))


@pages.get("/console/live")
async def live(who: Reader) -> StreamingResponse:
    """Streams the live pictures of all cameras, in the form of ``LiveView.stream``."""
    return StreamingResponse(live_view(who[0]).stream(), media_type="application/octet-stream")


@pages.get("/console/captures/{capture_id}/{camera}.jpg")
def thumbnail(who: Reader, capture_id: str, camera: str) -> Response:
    """Returns a small JPEG file of an image of a capture. The browser may cache it for ever, because pictures of a
    capture never change."""
    service = who[0]
    name = picture_name(service.store.capture(capture_id), "images", camera)
    path = service.store.cache_of(capture_id) / "small" / f"{camera}.jpg"
    if not path.is_file():
        make_thumbnail(service.store.capture_files(capture_id) / name, path)
    return FileResponse(path, headers=FOREVER)


@pages.get("/console/captures/{capture_id}/front")
def front(who: Reader, capture_id: str) -> Response:
    """Returns a small JPEG file of the front camera's image."""
    return thumbnail(who, capture_id, who[0].store.capture(capture_id).front)


@pages.get("/console/captures/{capture_id}/checks")
def checks(who: Reader, capture_id: str) -> Response:
    """Returns the measurements of a capture's pictures, by camera."""
    return JSONResponse(who[0].store.checks(capture_id), headers=FOREVER)


@pages.get("/console/captures/{capture_id}/holdings")
def holdings(who: Reader, capture_id: str) -> Response:
    """Returns which data a removal of the capture would delete and which would stay."""
    return JSONResponse(who[0].captures.holdings(capture_id).model_dump(), headers={"Cache-Control": "no-store"})


@pages.get("/console/captures/{capture_id}/{camera}.image")
def image(who: Reader, request: Request, capture_id: str, camera: str) -> Response:
    """Returns a camera's photograph as it was received."""
    return send_file(request, who[0].captures.image(capture_id, "images", camera))


@pages.get("/console/captures/{capture_id}/{camera}.silhouette.png")
def silhouette(who: Reader, capture_id: str, camera: str) -> Response:
    """Returns the outline of the subject in a camera's picture. The first request for a capture draws the outlines of
    all its cameras."""
    service = who[0]
    name = Path(picture_name(service.store.capture(capture_id), "images", camera)).stem
    folder = service.store.cache_of(capture_id) / "outlines"
    with _drawing:
        if not (folder / f"{name}.png").is_file():
            files = service.store.capture_files(capture_id)
            with service.children.one() as child:
                child.remote(draw)(capture=str(files), cache=str(folder.parent), target=str(folder))
    return FileResponse(folder / f"{name}.png", headers=FOREVER)


@pages.get("/console/captures/{capture_id}/faces")
def faces(who: Reader, capture_id: str) -> Response:
    """Returns the faces in a capture's pictures with their points (px). The first request detects the faces."""
    return JSONResponse(found_faces(who[0], capture_id)["faces"], headers=FOREVER)


@pages.post("/console/captures")
async def upload(who: Taker, request: Request) -> Response:
    """Receives an archive and makes a capture of it. Answers 201 with the capture's id, or a problem document."""
    try:
        record, _ = await receive_capture(who[0], request, who[1].key)
    except Exception as error:
        return as_problem(error).response()
    return JSONResponse({"id": record.id}, 201)


@pages.post("/console/calibrations")
async def upload_calibration_pictures(who: Taker, request: Request) -> Response:
    """Receives an archive of board pictures or photographs and queues a calibration. Answers 202 with the calibration's
    id, or a problem document."""
    try:
        calibration = await receive_calibration_pictures(who[0], request, who[1].key)
    except Exception as error:
        return as_problem(error).response()
    return JSONResponse({"id": calibration.id}, 202)


@pages.get("/console/jobs/{job_id}/overlays/{name}")
def overlay_file(who: Reader, request: Request, job_id: str, name: str) -> Response:
    """Returns an overlay of a job's result: a photograph with the input contour and the fitted contour."""
    return send_file(request, who[0].jobs.result_file(job_id, f"overlays/{name}"))


@pages.get("/console/jobs/{job_id}/{surface}.{name}.f32")
def numbers(who: Reader, job_id: str, surface: Literal["head", "bust"], name: Literal["quality", "part"]) -> Response:
    """Returns a number for each vertex (float32) of head.ply or bust.ply: ``quality`` (posterior standard deviation,
    mm) or ``part``."""
    path = result_folder(who[0], job_id) / f"{surface}.ply"
    if not path.is_file():
        raise NotFound(compose("thing-surface"), surface)
    return _floats(vertex_numbers(path, name))


@pages.get("/console/jobs/{job_id}/portrait.jpg")
def portrait(who: Reader, job_id: str) -> Response:
    """Returns a small picture of a job's bust or head."""
    return FileResponse(head_picture(who[0], job_id, "portrait.jpg"), headers=FOREVER)


@pages.get("/console/jobs/{job_id}/first-view.jpg")
def first_view(who: Reader, job_id: str) -> Response:
    """Returns a picture of the head as the page Result shows it first. Answers 204 without content if the head.ply was
    not written by this program."""
    try:
        return FileResponse(head_picture(who[0], job_id, "first-view.jpg"), headers=FOREVER)
    except InputError:
        return Response(status_code=204)


@pages.get("/console/jobs/{job_id}/cameras")
def cameras(who: Reader, job_id: str) -> Response:
    """Returns the cameras of a job's capture as seen from the head. The list of cameras is empty if the capture was
    removed or the report has no pose of the head."""
    service, views = who[0], []
    report = result_folder(who[0], job_id) / "report.json"
    with suppress(NotFound, FileNotFoundError, KeyError):
        capture, _ = _capture_files(service, job_id)
        views = camera_views(rig_of(capture), json.loads(report.read_text()))
    return JSONResponse(views, headers={"Cache-Control": "no-store"})


@pages.get("/console/jobs/{job_id}/photographs/{camera}.jpg")
def photograph(who: Reader, job_id: str, camera: str) -> Response:
    """Returns a photograph of the job's capture without lens distortion, which the first request makes and caches."""
    service = who[0]
    capture, record = _capture_files(service, job_id)
    name = picture_name(record, "images", camera)
    stored = service.store.cache_of(record.id) / "straightened" / f"{Path(name).stem}.jpg"
    if not stored.is_file():
        picture = straighten(read_image(capture / name), rig_of(capture)[camera])
        write_image(stored, picture, quality=STRAIGHTENED_QUALITY)
    return FileResponse(stored, headers=FOREVER)


@pages.get("/console/jobs/{job_id}/faces")
def faces_of_job(who: Reader, job_id: str) -> Response:
    """Returns the faces in the job's pictures, in pixels of the photographs without distortion, at full size."""
    capture, record = _capture_files(who[0], job_id)
    rig, faces_of = rig_of(capture), found_faces(who[0], record.id)["faces"]
    straight = {
        name: [straighten_face(face, rig[name]) for face in detections] for name, detections in faces_of.items()
    }
    return JSONResponse(straight, headers=FOREVER)


@pages.get("/console/jobs/{job_id}/distance.f32")
def distance(who: Reader, job_id: str, other: str) -> Response:
    """Returns the distance (mm, float32) of every vertex of a job's head to the surface of another job's head, or to
    the true head if ``other`` is ``truth``. Heads of different captures are aligned first."""
    service = who[0]
    job = service.jobs.get(job_id)
    mine = result_folder(service, job_id)
    if other == "truth":
        theirs = service.store.folder("captures", job.capture_id or "") / "truth" / "head.ply"
        if not theirs.is_file():
            raise NotFound(compose("thing-truth"), job.capture_id or "")
        return _floats(to_surface(mine, theirs))
    other_job = service.jobs.get(other)
    same = other_job.capture_id == job.capture_id
    return _floats(to_surface(mine, result_folder(service, other) / "head.ply", align=not same))


@pages.get("/console/jobs/{job_id}/all.zip")
def all_files(who: Reader, request: Request, job_id: str) -> Response:
    """Returns all files of a result in one .zip."""
    return send_archive(request, result_folder(who[0], job_id), who[0].jobs.files(job_id), name=None)


@pages.get("/console/jobs/{job_id}/exports/{form}.zip")
async def exported(who: Reader, job_id: str, form: str, morphs: bool = False) -> Response:
    """Returns a job's head in another format, as a .zip."""
    service, caller = who
    outputs = {"formats": [form], "morphs": morphs}
    return send_zip(await service.threads.check(service.export, job_id, outputs, key=caller.key))


@pages.get("/console/jobs/{job_id}/{name}")
def result_file(who: Reader, request: Request, job_id: str, name: str) -> Response:
    """Returns a file of a job's result."""
    return send_file(request, who[0].jobs.result_file(job_id, name))


@pages.get("/console/batches/{batch_id}/heads.{form}")
def batch_table(who: Reader, batch_id: str, form: TableFormat) -> Response:
    """Returns the table of a batch, as CSV or Parquet."""
    return send_table(who[0], batch_id, form)


@pages.get("/console/batches/{batch_id}/sheet.{form}")
def batch_sheet(who: Reader, batch_id: str, form: SheetFormat) -> Response:
    """Returns the contact sheet of a batch, as an HTML page or a PDF. Raises NotFound."""
    return send_sheet(who[0], batch_id, form)


@pages.get("/console/calibrations/{calibration_id}/report.html")
def calibration_report(who: Reader, request: Request, calibration_id: str) -> Response:
    """Returns the report of a calibration, an HTML page in which the browser runs no script."""
    answer = send_file(request, who[0].calibrations.file(calibration_id, "report.html"))
    answer.headers["Content-Security-Policy"] = "sandbox; default-src 'none'; style-src 'unsafe-inline'; img-src data:"
    return answer


@pages.get("/console/calibrations/{calibration_id}/cameras.json")
def cameras_file(who: Reader, calibration_id: str) -> Response:
    """Returns the cameras.json of a calibration."""
    return FileResponse(who[0].calibrations.result(calibration_id, "cameras.json"), media_type="application/json")


def make_thumbnail(source: Path, target: Path) -> None:
    """Writes a JPEG file of at most ``THUMBNAIL_WIDTH`` pixels of width. The thumbnail appears under its name only when
    it is complete."""
    target.parent.mkdir(parents=True, exist_ok=True)
    unfinished = target.with_suffix(f".{threading.get_ident()}")
    with open_picture(source) as picture:
        picture.draft("RGB", (THUMBNAIL_WIDTH * 2, THUMBNAIL_WIDTH * 2))  # JPEG decodes at a fraction of its size
        picture = picture.convert("RGB")
        picture.thumbnail((THUMBNAIL_WIDTH, THUMBNAIL_WIDTH * 2), reducing_gap=2.0)
        picture.save(unfinished, "JPEG", quality=THUMBNAIL_QUALITY)
    unfinished.rename(target)


def _capture_files(service: Service, job_id: str) -> tuple[Path, CaptureRecord]:
    """Returns the result's folder and the capture's record. Raises NotFound if the job's capture is gone."""
    capture = service.jobs.get(job_id).capture_id or ""
    return service.store.capture_files(capture), service.store.capture(capture)


def _floats(values: np.ndarray) -> Response:
    return Response(values.astype("<f4").tobytes(), media_type="application/octet-stream", headers=FOREVER)


def draw(context: WorkerContext, report: Progress, *, capture: str, cache: str, target: str) -> None:
    """Draws the subject's outline in each picture of a capture as ``target``/<camera>.png, transparent outside.
    Silhouettes are read from the folder ``cache``, or computed and stored there. Raises InputError."""
    from server.storage.silhouette_cache import segment_once
    from server.tasks.photographs import read_scaled_capture

    shot, rig = read_scaled_capture(Path(capture))
    silhouettes = segment_once(Path(cache), shot, rig, report=report)
    for name, silhouette in silhouettes.items():
        write_atomically(Path(target) / f"{name}.png", encode_image(".png", outline(silhouette.mask)))


def outline(mask: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "y x 4"]:
    """Draws a mask as an RGBA picture, at most ``WIDTH`` pixels wide: the outline solid, the inside lightly tinted."""
    factor = min(1.0, WIDTH / mask.shape[1])
    size = (round(mask.shape[1] * factor), round(mask.shape[0] * factor))
    small = cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    edges, _ = cv2.findContours(small, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    alpha = small * np.uint8(26)
    cv2.drawContours(alpha, edges, -1, 255, LINE_PX)
    return np.dstack([np.full(small.shape, value, np.uint8) for value in COLOUR] + [alpha])


def camera_views(rig: Rig, report: Report) -> list[JsonObject]:
    """Returns every camera of a capture as seen from the head, as a pinhole camera (px) with ``camera_from_head``: rows
    of a 4 x 4 matrix (metres) in the frame of head.glb. The head's pose comes from ``report``, and the head has its
    true size: x_world = R x_head + s t."""
    pose = report["world_from_head"]
    shift = np.array(pose["translation"]) * pose["scale"]
    world_from_head = RigidTransform(np.array(pose["rotation"]), shift)
    return [_view(camera, camera.camera_from_world @ world_from_head) for camera in rig]


def rig_of(capture: Path) -> Rig:
    """Reads the rig from the files of a capture. Raises InputError if there is no rig or the rig cannot be read."""
    rig_file = find_rig_file(capture)
    if rig_file is None:
        raise InputError("capture", [compose("no-cameras-json")])
    return read_rig_file(rig_file)


def straighten(image: ImageRgb, camera: Camera) -> ImageRgb:
    """Removes the lens's distortion from a photograph and reduces it to at most ``WIDTH_MOST`` pixels of width."""
    lens = camera.intrinsics
    if camera.recorded is not None:
        image = camera.recorded.undistort(image, lens.matrix(), smooth=True)
    factor = min(1.0, WIDTH_MOST / lens.width)
    size = (round(lens.width * factor), round(lens.height * factor))
    wanted = np.diag([factor, factor, 1.0]) @ lens.matrix()
    wanted[:2, 2] += (factor - 1) / 2  # the centre of the first pixel stays 0
    columns, rows = cv2.initUndistortRectifyMap(
        lens.matrix(), lens.distortion.opencv(), np.eye(3), wanted, size, cv2.CV_32FC1
    )
    return np.asarray(cv2.remap(image, columns, rows, cv2.INTER_AREA), np.uint8)


def straighten_face(face: JsonObject, camera: Camera) -> JsonObject:
    """Converts a face to the pixels of the photograph without distortion, at full size. Points that the lens cannot
    image are left out."""
    lens, pixels = camera.intrinsics, np.array(face["points"])
    if camera.recorded is not None:
        straight = camera.recorded.undistorted(pixels, lens.matrix())
    else:
        straight = camera.undistort(pixels) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    straight = straight[np.isfinite(straight).all(axis=1)].round(1)
    box = [*straight.min(axis=0), *straight.max(axis=0)] if len(straight) else face["box_px"]
    return {**face, "box_px": [float(side) for side in box], "points": straight.tolist()}


def _view(camera: Camera, camera_from_head: RigidTransform) -> JsonObject:
    lens, matrix = camera.intrinsics, np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera_from_head.rotation, camera_from_head.translation / MM
    pinhole = {key: getattr(lens, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}
    return {"name": camera.name, **pinhole, "camera_from_head": matrix.tolist()}


def vertex_numbers(path: Path, name: str) -> Float[np.ndarray, " v"]:
    """Reads one number for each vertex of a result's surface. Raises NotFound if the file does not have the number
    ``name``, and InputError for another program's file."""
    values = read_vertex_numbers(path, name)
    if values is None:
        raise NotFound(compose("thing-vertex-number"), name, compose("hint-other-numbers", file=path.name))
    return values


def to_surface(result: Path, other: Path, *, align: bool = False) -> Float[np.ndarray, " v"]:
    """Computes the distance (mm) of every vertex of a result's head to the surface of the mesh ``other``.

    With ``align`` the result's head is first moved rigidly onto the other head, since heads of different captures stand
    in different places. Raises FileNotFoundError.
    """
    mine, theirs = read_mesh(result / "head.ply"), read_mesh(other)
    points = moved_onto(mine, theirs) if align else mine.vertices
    return measure_distance(points, theirs)


def moved_onto(mine: Mesh, theirs: Mesh) -> Float[np.ndarray, "v 3"]:
    """Returns the vertices of ``mine`` after the rigid motion that brings them closest to ``theirs``. Heads with
    equally many vertices are compared vertex by vertex. Heads with different numbers of vertices are compared by
    nearest points, without the farthest fifth."""
    if len(mine.vertices) == len(theirs.vertices):
        return rigid_procrustes(mine.vertices, theirs.vertices).apply(mine.vertices)
    points = mine.vertices - mine.vertices.mean(0) + theirs.vertices.mean(0)
    tree = KDTree(theirs.vertices)
    for _ in range(ROUNDS):
        distance, nearest = (np.asarray(part) for part in tree.query(points))
        near = distance <= np.quantile(distance, TRIMMED)
        points = rigid_procrustes(points[near], theirs.vertices[nearest[near]]).apply(points)
    return points


def found_faces(service: Service, identity: str) -> JsonObject:
    """Returns the faces in a capture's pictures. The first call detects the faces; later calls read the cache. Blocks.

    Raises NotFound, Conflict for a film and the calibration board, InputError and WorkFailed if the pictures cannot be
    searched, and Unavailable after ``PATIENCE_S`` seconds.
    """
    deadline = time.monotonic() + PATIENCE_S
    record = service.store.capture(identity)
    check_kind(record)
    images = {Path(name).stem: name for name in record.inputs if Path(name).parent.name == "images"}
    files = service.store.capture_files(identity)

    def find() -> JsonObject:
        with service.children.one(max(0.0, deadline - time.monotonic())) as child:
            work = child.remote(find_capture_faces, cancelled=lambda: time.monotonic() > deadline)
            return work(capture=str(files), images=images)

    lock = _finding[identity]
    if not lock.acquire(timeout=PATIENCE_S):
        raise _slow()
    try:
        return faces_once(service.store.cache_of(identity) / "faces", record.inputs, find)
    except (Cancelled, Empty):
        raise _slow() from None
    finally:
        lock.release()


def _slow() -> Unavailable:
    return Unavailable("service-unavailable", compose("faces-slow", seconds=PATIENCE_S))
