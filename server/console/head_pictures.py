"""Draws pictures of a job's head when they are first requested, one at a time, and keeps them beside the result, so
that they are removed with the job."""

import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import numpy as np

from rig.errors import EigenheadError
from rig.formats.meshes.ply import write_ply
from rig.formats.pictures.images import write_image
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
    """Returns the folder of a job's result, with all its files. Raises NotFound, and Conflict if the job has not
    succeeded."""
    local = _local_folder(service, job_id)
    return service.jobs.result_folder(job_id) if service.jobs.results.elsewhere else local


def _local_folder(service: Service, job_id: str) -> Path:
    """Returns where a job's result lies in the data folder. What was drawn of it lies beside that folder, even after
    its files went to the store. Raises as ``result_folder``."""
    state = service.jobs.state(job_id)
    if state != "succeeded":
        raise Conflict("no-result", compose("job-without-result", state=state))
    return service.store.folder("jobs", job_id) / "result"


def head_picture(service: Service, job_id: str, name: HeadPicture) -> Path:
    """Returns the file of a picture of a job's head, which the first call draws. Raises NotFound if the job or its head
    is gone, Conflict if the job has not succeeded, and InputError if the head cannot be read."""
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
    """Draws the first view of a head that is about to be opened, so that it is ready when the page requests it. Raises
    nothing if the head is gone."""
    with suppress(EigenheadError, OSError):  # removed meanwhile, or a result without a head: the page tells
        head_picture(service, job_id, "first-view.jpg")


@cache
def warm_up() -> None:
    """Imports and runs the code that reads and draws heads, once a process, so that the first head does not wait a
    second for it."""
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
