"""Pictures of a job's head: drawn by the service at the first look, one at a time, and kept beside the result, so that
they go with the job."""

import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from rig.errors import EigenheadError
from rig.formats.images import write_image
from rig.formats.ply import write_ply
from rig.mesh import Mesh
from rig.messages.message import compose
from server.console.first_view import first_view
from server.console.portrait import portrait
from server.errors import Conflict, NotFound
from server.services.service import Service

HeadPicture = Literal["portrait.jpg", "first-view.jpg"]
DRAWN = {"portrait.jpg": portrait, "first-view.jpg": first_view}
QUALITY = 87

_drawing = threading.Lock()


def result_folder(service: Service, job_id: str) -> Path:
    """Returns the folder of a job's result, with all its files. Raises Conflict where the job has none."""
    local = _local_folder(service, job_id)
    return service.jobs.result_folder(job_id) if service.jobs.results.elsewhere else local


def _local_folder(service: Service, job_id: str) -> Path:
    """What was drawn lies beside it, whatever went from it to the store."""
    state = service.jobs.state(job_id)
    if state != "succeeded":
        raise Conflict("no-result", compose("job-without-result", state=state))
    return service.store.folder("jobs", job_id) / "result"


def head_picture(service: Service, job_id: str, name: HeadPicture) -> Path:
    """Returns the file of a picture of a job's head, which is drawn at the first call. Raises Conflict where the job
    has no result, and NotFound or InputError where the result has no head."""
    kept = _local_folder(service, job_id).parent / name
    if not kept.is_file():
        with _drawing:
            if not kept.is_file():
                try:  # the folder of a job that is erased meanwhile is not made anew: the face would stay
                    result = result_folder(service, job_id)
                    write_image(kept, DRAWN[name](result), quality=QUALITY, parents=False)
                except FileNotFoundError as error:
                    raise NotFound(compose("thing-job"), job_id) from error
    return kept


def draw_first_view(service: Service, job_id: str) -> None:
    """Draws the first view of a head that is about to be opened, so that it is ready when the page asks for it."""
    with suppress(EigenheadError, OSError):  # removed meanwhile, or a result without a head: the page tells
        head_picture(service, job_id, "first-view.jpg")


@cache
def warm_up() -> None:
    """Loads what reads and draws heads, so that the first head does not have to wait a second for that."""
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
