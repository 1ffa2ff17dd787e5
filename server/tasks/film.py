"""Implements the tasks of a film: recognise and check one that was uploaded, and track it in a job.

A film is a capture with several pictures of each camera, ``images/<camera>/<frame>.<ext>``, or with one video of each
camera, ``videos/<camera>.<ext>``, as ``pipeline.applications.moments.footage`` reads them. A job on a film stores its
chunks of frames in the job's folder, where the next worker finds them if this one dies.
"""

import re
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from rig.errors import InputError
from rig.files import sha256_of
from rig.formats.cameras.cameras_file import find_rig_file, rig_file_parts
from rig.formats.captures.shot_files import BESIDE_PICTURES, listed_pictures
from rig.formats.pictures.images import is_picture, picture_size
from rig.messages.message import Message, compose
from rig.progress import Progress
from server.processes import share_one_heap
from server.storage.records import CameraSize, CaptureContent, EventDocument
from server.tasks.child import WorkerContext
from server.tasks.photographs import CAMERAS, JSON_BYTES_MOST
from server.tasks.progress import Clock, JobProgress

if TYPE_CHECKING:
    from pipeline.applications.moments.footage import Footage

CHUNKS = "chunks"  # folder of a job, beside its attempts: the frames that are done
SETTINGS: Mapping[str, object] = {"detail": "photo", "outputs": {"surface": "head"}}  # every film is tracked with them
USD = "usd"  # the only setting of a film's job
FRAME = re.compile(r"frame (\d+) of \d+")  # the stage of ``track_sequence``
FRAME_S = 1.5  # before a frame was tracked; eleven cameras of 640 x 480 take this on one core
PREVIEW = 0.05  # share of the work that writes preview.mp4


def is_film(root: Path) -> bool:
    """Returns whether a capture's folder holds a film: videos, or cameras and several pictures of two of them."""
    if (root / "videos").is_dir():
        return True
    folders = [path for path in (root / "images").glob("*") if len(listed_pictures(path)) > 1]
    return len(folders) > 1 and find_rig_file(root) is not None


def ingest_film(root: Path, target: Path, image_pixels: int, report: Progress) -> CaptureContent:
    """Checks the film in the folder ``root`` and moves its files to ``target``. No picture is decoded, since a film
    may have damaged ones; each has at most ``image_pixels`` pixels. Returns the content for the capture's record.
    Raises InputError naming every fault."""
    from pipeline.applications.moments.footage import CLOCK, TIMES, open_footage

    for path in (root / CAMERAS, root / CLOCK, root / TIMES):
        if path.is_file() and path.stat().st_size > JSON_BYTES_MOST:
            raise InputError(path.name, [compose("file-large", most_mib=JSON_BYTES_MOST >> 20)])
    try:
        footage = open_footage(root)
    except InputError as error:
        raise InputError("capture", error.faults) from error
    files = _files_of(footage)
    if faults := _size_faults(footage, files, image_pixels):
        raise InputError("capture", faults)
    inputs, size = dict[str, str](), 0
    for number, path in enumerate(files):
        report("check", number / len(files))
        name = path.relative_to(footage.folder).as_posix()
        inputs[name], size = sha256_of(path), size + path.stat().st_size
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        path.rename(target / name)
    return CaptureContent(
        cameras=tuple(CameraSize(c.name, c.intrinsics.width, c.intrinsics.height) for c in footage.rig),
        front=footage.rig.front_camera(),
        inputs=dict(sorted(inputs.items())),
        bytes=size,
        frames=len(footage.frames),
    )


def _files_of(footage: "Footage") -> list[Path]:
    from pipeline.applications.moments.footage import CLOCK, TIMES

    root, rig_file = footage.folder, find_rig_file(footage.folder)
    assert rig_file is not None
    pictures = [path for of in footage.files.values() for path in of.values()]
    beside = [path for kind in BESIDE_PICTURES for path in (root / kind).rglob("*") if is_picture(path)]
    tables = [path for path in (root / TIMES, root / CLOCK) if path.is_file()]
    return [*rig_file_parts(rig_file), *tables, *pictures, *footage.videos.values(), *beside]


def _size_faults(footage: "Footage", files: list[Path], image_pixels: int) -> list[Message]:
    """Names the first picture of each folder, and each video, whose header claims too many pixels."""
    from pipeline.applications.moments.footage import video_size

    faults = dict[Path, Message]()
    for path in files:
        film = path in footage.videos.values()
        if not (film or is_picture(path)):
            continue
        try:
            width, height = video_size(path) if film else picture_size(path)
        except InputError:  # damaged: the frame lacks this picture
            continue
        if width * height > image_pixels:
            name = path.relative_to(footage.folder).as_posix()
            fault = compose("picture-too-large", file=name, width=width, height=height, most=image_pixels)
            faults.setdefault(path if film else path.parent, fault)
    return [*faults.values()]


def film_setting_faults(settings: Mapping[str, object]) -> list[Message]:
    """Returns the faults of the settings of a film's job, which has ``USD`` alone: whether to write sequence.usdc."""
    others = [name for name in settings if name != USD]
    faults = [compose("film-settings", names=others)] if others else []
    if not isinstance(settings.get(USD, False), bool):
        faults.append(compose("no-switch", key=USD, value=f"{settings[USD]!r:.80}"))
    return faults


def track_film(
    context: WorkerContext,
    report: Progress,
    *,
    capture: str,
    result: str,
    cache: str,
    model: str | None,
    settings: Mapping[str, object],
) -> None:
    """Tracks the film in the folder ``capture`` and writes the files of ``make_sequence`` to ``result``. Frames that an
    earlier attempt of the job has tracked are read from the folder ``CHUNKS`` beside ``result``. Raises the errors of
    ``make_sequence``, and Cancelled if ``report`` raises it."""
    report("read", 0.0)
    share_one_heap()
    from pipeline.applications.moments.sequence_files import make_sequence
    from pipeline.settings import settings_from_document
    from server.tasks.prepare import prepare_kernels

    chosen, out = settings_from_document(SETTINGS), Path(result)
    context.keep("loops of films", lambda: prepare_kernels(lambda _, share: report("compiling", share), chosen))
    make_sequence(
        Path(capture), out, kept=out.with_name(CHUNKS), model=model or "default", settings=chosen, report=report,
        usd=settings.get(USD) is True,
    )  # fmt: skip


class FilmProgress(JobProgress):
    """Computes progress and remaining time of a film's job from its frames. ``frames``: number of all frames; ``clock``
    returns seconds and never goes back."""

    def __init__(self, frames: int, clock: Clock = time.monotonic) -> None:
        super().__init__({}, clock)
        self._frames, self._done, self._now = frames, 0, clock
        self._first = (0, clock())  # frames that earlier attempts have done, and when this one began with the next
        self._share = 0.0

    def report(self, stage: str, fraction: float) -> None:
        """Records the stage of ``make_sequence`` that is running and which fraction of it is done, 0 to 1."""
        if found := FRAME.fullmatch(stage):
            stage, self._done = "frames", int(found[1]) - 1
            if self.stage != stage:
                self._first = (self._done, self._now())
        if stage in ("identity", "frames"):
            self._share = max(self._share, (1.0 - PREVIEW) * fraction)
        elif stage == "preview":
            self._share, self._done = 1.0 - PREVIEW + PREVIEW * fraction, self._frames
        super().report(stage, fraction)

    def remaining_s(self) -> float:
        """Estimates the seconds until the job ends from the frames that this attempt has tracked."""
        earlier, since = self._first
        tracked = self._done - earlier if self.stage == "frames" else 0
        return (self._frames - self._done) * ((self._now() - since) / tracked if tracked else FRAME_S)

    def progress(self) -> float:
        """Returns the fraction of the job that is done, 0 to 0.99. It never decreases."""
        return min(0.99, self._share)

    def counts(self) -> EventDocument:
        """Returns how many of the film's frames are done."""
        return {"frames": self._frames, "frames_done": self._done}
