"""Draws pictures of a job's head at the first request, one at a time, and stores them beside the result, with which
they are removed.

The page Result shows ``first-view.jpg`` (some 30 kB) until the browser has loaded and drawn the 3 MB of the head.
Camera, light and texture are as in ``pages/result.js`` and ``static/views.js``: three-quarter view, light "studio".
Lists show ``portrait.jpg``, by which people recognise a head at once.
"""

import json
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.geometry.projection import picture
from pipeline.results.overlays import clay
from rig.camera import Camera, Intrinsics
from rig.errors import EigenheadError
from rig.formats.meshes.mesh_file import read_mesh
from rig.formats.meshes.ply import read_head_ply, write_ply
from rig.formats.pictures.images import write_image
from rig.geometry import RigidTransform, look_at
from rig.mesh import Mesh, vertex_normals
from rig.messages.message import compose
from server.errors import Conflict, NotFound
from server.services.service import Service

SIDE = 720  # pixels, of a picture as wide as high; the view is some 700 high on most screens
FOV_DEG, AWAY = 28.0, 4.25  # of the view; AWAY in radii of the head's sphere
DIRECTION = (0.26, 0.06, 0.96)
AMBIENT = 1.6
LIGHTS = ((0.6, 0.8, 1.2, 1.6), (-1.2, 0.3, 0.7, 0.7), (0.2, 0.9, -1.2, 0.8))  # whence, and how strong
GROUND = (16, 19, 24)  # .view3d in theme.css
GAMMA = 2.2  # near enough to sRGB's curve for a picture that is there for half a second

HeadPicture = Literal["portrait.jpg", "first-view.jpg"]
QUALITY = 87

_drawing = threading.Lock()
PANEL = (240, 300)  # width, height
PAPER = (23, 27, 33)
AZIMUTH_DEG = 22.0
DARKEST = 0.55
MARGIN = 1.12  # of the head's box, for hair


def result_folder(service: Service, job_id: str) -> Path:
    """Returns the folder of a job's result, with all its files. Raises NotFound for an unknown job, and Conflict if the
    job has not succeeded."""
    local = _local_folder(service, job_id)
    return service.jobs.result_folder(job_id) if service.jobs.results.objects is not None else local


def _local_folder(service: Service, job_id: str) -> Path:
    """Returns the folder of a job's result in the data folder. Drawn pictures lie beside that folder, even after its
    files were moved to the store. Raises as ``result_folder``."""
    state = service.jobs.state(job_id)
    if state != "succeeded":
        raise Conflict("no-result", compose("job-without-result", state=state))
    return service.store.folder("jobs", job_id) / "result"


def head_picture(service: Service, job_id: str, name: HeadPicture) -> Path:
    """Returns the file of a picture of a job's head; the first call draws the picture. Raises NotFound if the job or
    its head is gone, Conflict if the job has not succeeded, and InputError if the head cannot be read."""
    stored = _local_folder(service, job_id).parent / name
    if not stored.is_file():
        with _drawing:
            if not stored.is_file():
                try:  # the folder of a job that is erased meanwhile is not made anew: the face would stay
                    result = result_folder(service, job_id)
                    write_image(stored, DRAWN[name](result), quality=QUALITY, parents=False)
                except FileNotFoundError as error:
                    raise NotFound(compose("thing-job"), job_id) from error
    return stored


def draw_first_view(service: Service, job_id: str) -> None:
    """Draws the first view of a head before the page requests it. A head that was removed raises no error."""
    with suppress(EigenheadError, OSError):  # removed meanwhile, or a result without a head: the page tells
        head_picture(service, job_id, "first-view.jpg")


@cache
def warm_up() -> None:
    """Imports and runs the code that reads and draws heads once in each process, so that the first request does not
    take a second longer."""
    corners = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [0.0, 100.0, 0.0], [0.0, 0.0, 100.0]])
    corner = Mesh(corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32))
    with suppress(OSError), TemporaryDirectory() as folder:  # on a full disk the first head waits
        result = Path(folder)
        grey, none = np.full((4, 3), 128, np.uint8), np.zeros(4)
        write_ply(
            result / "head.ply",
            corner,
            normals=corner.normals(),
            colours=grey,
            quality=none.astype(np.float32),
            views=none.astype(np.uint8),
        )
        first_view(result)


def first_view(result: Path) -> UInt8[np.ndarray, "s s 3"]:
    """Draws the head of a result as the page Result shows it first (RGB). Raises InputError if the result has no head
    that can be read."""
    head, _ = read_head_ply(result / "head.ply")
    mesh = Mesh(placed(result).apply(head.vertices), head.faces, head.colours)
    return drawn(mesh)


def drawn(mesh: Mesh) -> UInt8[np.ndarray, "s s 3"]:
    """Draws a coloured head (head frame, mm) on the page's background (RGB), at twice the size, and reduces the
    picture, which smooths edges."""
    vertices = mesh.vertices
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    radius = float(np.linalg.norm(vertices - centre, axis=1).max())
    direction = np.array(DIRECTION) / np.linalg.norm(DIRECTION)
    eye, size = centre + AWAY * radius * direction, 2 * SIDE
    focal = size / 2 / np.tan(np.radians(FOV_DEG / 2))
    lens = Intrinsics(size, size, focal, focal, (size - 1) / 2, (size - 1) / 2)
    camera = Camera("view", lens, look_at(eye, centre, np.array([0.0, 1.0, 0.0])))
    large = picture(camera, vertices, mesh.faces, lit(mesh), GROUND)
    return np.asarray(cv2.resize(large, (SIDE, SIDE), interpolation=cv2.INTER_AREA), np.uint8)


def lit(mesh: Mesh) -> UInt8[np.ndarray, "v 3"]:
    """Computes the vertices' colours under the page's lights, as three.js does for a rough surface: linear colour times
    light over pi."""
    normals = vertex_normals(mesh.vertices, mesh.faces)
    light: Float[np.ndarray, " v"] = np.full(len(normals), AMBIENT)
    for *direction, power in LIGHTS:
        whence = np.array(direction) / np.linalg.norm(direction)
        light += power * np.clip(normals @ whence, 0.0, None)
    colours = np.full((len(normals), 3), 255.0) if mesh.colours is None else mesh.colours.astype(float)
    return np.clip(colours * (light[:, None] / np.pi) ** (1.0 / GAMMA), 0.0, 255.0).astype(np.uint8)


def portrait(result: Path) -> UInt8[np.ndarray, "h w 3"]:
    """Draws a small picture (RGB) of a result's bust, or else its head, turned by ``AZIMUTH_DEG``, in the colours of
    the photographs. Raises FileNotFoundError if there is no head."""
    name = "bust.ply" if (result / "bust.ply").is_file() else "head.ply"
    head_from_world = placed(result)
    head = head_from_world.apply(read_mesh(result / "head.ply").vertices)
    mesh = read_mesh(result / name)
    middle, half = (head.min(axis=0) + head.max(axis=0)) / 2, MARGIN * (head.max(axis=0) - head.min(axis=0)) / 2
    shown = Mesh(head_from_world.apply(mesh.vertices), mesh.faces)
    box = (middle - half, middle + half)
    return clay(
        shown, colours=mesh.colours, azimuth_deg=AZIMUTH_DEG, panel=PANEL, box=box, paper=PAPER, darkest=DARKEST
    )


def placed(result: Path) -> RigidTransform:
    """Returns the transform head_from_world (rigid) of a result's report; the identity if the report has none."""
    try:
        pose = json.loads((result / "report.json").read_text())["world_from_head"]
    except (FileNotFoundError, KeyError):
        return RigidTransform(np.eye(3), np.zeros(3))
    shift = np.array(pose["translation"]) * pose["scale"]
    return RigidTransform(np.array(pose["rotation"]), shift).inverse()


DRAWN = {"portrait.jpg": portrait, "first-view.jpg": first_view}
