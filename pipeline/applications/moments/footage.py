"""Reads a sequence folder: cameras.json, and either ``images/<camera>/<frame>.<ext>`` or ``videos/<camera>.<ext>``.

The folder may also hold clean plates (``background/``), masks (``masks/<camera>/<frame>.<ext>``), ``times.csv`` with
the columns frame and time_s, and ``clock.json``, which `eigenhead clock` writes. Without times.csv, frames follow each
other at the videos' rate or at ``FPS``; a gap in the frame numbers counts as dropped frames. For tracking, frames are
read one after another at reduced size; a single frame can also be read as a capture at full size."""

import csv
import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.compute.threads import map_in_threads
from rig.capture import Capture, ImageRgb
from rig.errors import InputError
from rig.formats.cameras.cameras_file import find_rig_file
from rig.formats.captures.capture_folder import capture_root, decode_picture, read_capture, read_rig_of
from rig.formats.pictures.images import is_picture, write_image
from rig.formats.pictures.work_size import WORK_PIXELS, work_rig
from rig.messages.message import Message, compose
from rig.rig import Rig

TRACKED_PIXELS = 640 * 480  # of a picture that is tracked: a pixel covers 0.9 mm of the usual rig's head
FPS = 25.0  # where neither times.csv nor a video says it
MIN_FRAMES = 2
MIN_VIEWS = 2  # of a frame
SAME_RATE = 0.01  # share by which videos' rates may differ: a nominal one is rounded, a phone's is a mean
IMAGES, VIDEOS, TIMES, CLOCK = "images", "videos", "times.csv", "clock.json"
Pictures = Mapping[str, ImageRgb]  # by camera; one that lacks the frame is left out


@dataclass(frozen=True, slots=True, eq=False)
class Footage:
    """Holds where the pictures of a sequence are stored. ``rig`` holds the cameras for full-size pictures, ``work``
    those for reduced pictures. Each camera has either ``files`` by frame or one video."""

    folder: Path
    rig: Rig
    work: Rig
    frames: tuple[str, ...]
    times_s: Float[np.ndarray, " n"]
    files: Mapping[str, Mapping[str, Path]]
    videos: Mapping[str, Path]
    spread_s: float = 0.0  # between the first and the last camera's exposure of a frame; 0 without clock.json

    def read(self, first: int = 0, cameras: Sequence[str] = ()) -> Iterator[Pictures]:
        """Yields the reduced pictures of every frame from ``first`` on; without ``cameras``, of all cameras. Missing
        and damaged pictures are left out of the result."""
        names = cameras or self.rig.names
        with ExitStack() as stack:
            of_names = {name: path for name, path in self.videos.items() if name in names}
            films = {name: stack.enter_context(_opened(path)) for name, path in of_names.items()}
            for reel in films.values():
                for _ in range(first):  # exact, unlike a seek
                    reel.grab()
            for frame in self.frames[first:]:

                def read_camera(k: int, frame: str = frame) -> ImageRgb | None:
                    name = names[k]
                    if name in films:
                        return self._of_video(films[name], name)
                    path = self.files[name].get(frame)
                    return None if path is None else self._of_file(name, path)

                found = dict(zip(names, map_in_threads(read_camera, len(names)), strict=True))
                yield {name: image for name, image in found.items() if image is not None}

    @contextmanager
    def capture(self, number: int) -> Iterator[tuple[Capture, Rig]]:
        """Yields one frame as a capture with its plates and masks, and the full-size cameras. Raises InputError."""
        with tempfile.TemporaryDirectory() as scratch:
            folder, frame = Path(scratch), self.frames[number]
            rig_file = find_rig_file(self.folder)
            assert rig_file is not None
            shutil.copy(rig_file, folder / rig_file.name)
            if (self.folder / "background").is_dir():
                (folder / "background").symlink_to((self.folder / "background").resolve())
            for kind in (IMAGES, "masks"):
                (folder / kind).mkdir()
                for name in self.rig.names:
                    for path in (self.folder / kind / name).glob(f"{frame}.*"):
                        (folder / kind / f"{name}{path.suffix}").symlink_to(path.resolve())
            if not any((folder / "masks").iterdir()):
                (folder / "masks").rmdir()
            for name, path in self.videos.items():
                with _opened(path) as reel:
                    for _ in range(number):
                        reel.grab()
                    found, image = reel.read()
                    if found:
                        write_image(folder / IMAGES / f"{name}.png", image[:, :, ::-1])
            yield read_capture(folder, pixels_most=WORK_PIXELS)

    def _of_file(self, name: str, path: Path) -> ImageRgb | None:
        found = decode_picture(self.folder, IMAGES, name, path, rig=self.rig, pixels_most=TRACKED_PIXELS, bits=8)
        return found[0]

    def _of_video(self, reel: cv2.VideoCapture, name: str) -> ImageRgb | None:
        found, image = reel.read()
        if not found:
            return None
        k, camera = self.work[name].intrinsics, self.rig[name]
        if image.shape[:2] != (k.height, k.width):
            image = cv2.resize(image, (k.width, k.height), interpolation=cv2.INTER_AREA)
        rgb = np.ascontiguousarray(image[:, :, ::-1])
        return rgb if camera.recorded is None else camera.recorded.undistort(rgb, k.matrix())


def open_footage(folder: Path) -> Footage:
    """Finds the pictures of a sequence in its folder. Raises InputError that lists every fault of the folder."""
    folder = capture_root(folder)
    rig_file = find_rig_file(folder)
    if rig_file is None:
        raise InputError("sequence", [compose("sequence-without-cameras")])
    rig, faults = read_rig_of(rig_file).rig, list[Message]()
    files = {
        name: {path.stem: path for path in sorted((folder / IMAGES / name).iterdir()) if is_picture(path)}
        for name in rig.names
        if (folder / IMAGES / name).is_dir()
    }
    films = sorted((folder / VIDEOS).iterdir()) if (folder / VIDEOS).is_dir() else []
    videos = {path.stem: path for path in films if path.stem in rig and path.stem not in files}
    absent = [name for name in rig.names if not files.get(name) and name not in videos]
    if absent:
        faults.append(compose("sequence-camera-empty", cameras=absent))
    frames = tuple(sorted({frame for of in files.values() for frame in of}, key=_in_order))
    rates: dict[str, float] = {}
    for name, path in videos.items():
        with _opened(path) as reel:
            count, rate = int(reel.get(cv2.CAP_PROP_FRAME_COUNT)), reel.get(cv2.CAP_PROP_FPS)
        if rate > 0.0:
            rates[name] = rate
        if not files and count > len(frames):
            frames = tuple(f"{k:05}" for k in range(count))
    views = [len(videos) + sum(frame in of for of in files.values()) for frame in frames]
    shared = sum(count >= min(MIN_VIEWS, len(rig)) for count in views)
    if not faults and shared < MIN_FRAMES:
        faults.append(compose("sequence-too-short", count=shared))
    slow, fast = (of(rates, key=lambda name: rates[name], default="") for of in (min, max))
    if slow and rates[fast] > (1.0 + SAME_RATE) * rates[slow]:
        faults.append(
            compose("sequence-rates-differ", slow=slow, slow_fps=rates[slow], fast=fast, fast_fps=rates[fast])
        )
    if faults:
        raise InputError("sequence", faults)
    times = _times(folder / TIMES, frames, rates.get(slow, FPS))
    spread = _spread(folder / CLOCK, rig)
    return Footage(folder, rig, work_rig(rig, TRACKED_PIXELS), frames, times, files, videos, spread)


def video_size(path: Path) -> tuple[int, int]:
    """Returns the width and height (px) of a video. Raises InputError if it cannot be decoded."""
    with _opened(path) as reel:
        return int(reel.get(cv2.CAP_PROP_FRAME_WIDTH)), int(reel.get(cv2.CAP_PROP_FRAME_HEIGHT))


def _spread(path: Path, rig: Rig) -> float:
    """Returns how much later (s) the last camera exposes than the first, from clock.json. Raises InputError."""
    if not path.is_file():
        return 0.0
    try:
        measured = json.loads(path.read_text(encoding="utf-8"))["cameras"]
        later = [float(measured[name]["mean_ms"]) for name in rig.names]
    except (KeyError, TypeError, ValueError):
        raise InputError("sequence", [compose("sequence-clock-wrong")]) from None
    return (max(later) - min(later)) / 1000.0


def _times(path: Path, frames: tuple[str, ...], rate: float) -> Float[np.ndarray, " n"]:
    """Returns the time of each frame (s). Raises InputError if times.csv lacks some frames, or if times decrease."""
    if not path.is_file():
        numbers = np.array([_in_order(frame)[0] for frame in frames])
        steps = np.diff(numbers)
        counted = (steps > 0).all() and (steps % steps.min() == 0).all()
        return (numbers - numbers[0]) / steps.min() / rate if counted else np.arange(len(frames)) / rate
    try:
        with path.open(newline="", encoding="utf-8") as lines:
            known = {row["frame"]: float(row["time_s"]) for row in csv.DictReader(lines)}
        times = np.array([known[frame] for frame in frames])
    except (KeyError, TypeError, ValueError):
        raise InputError("sequence", [compose("sequence-times-wrong")]) from None
    if not (np.diff(times) > 0.0).all():
        raise InputError("sequence", [compose("sequence-times-wrong")])
    return times


def _in_order(frame: str) -> tuple[int, str]:
    """Returns a sort key that orders frame names that are numbers by value, before all other names."""
    digits = "".join(filter(str.isdecimal, frame))
    return (int(digits) if digits else -1, frame)


@contextmanager
def _opened(path: Path) -> Iterator[cv2.VideoCapture]:
    reel = cv2.VideoCapture(str(path))
    try:
        if not reel.isOpened():
            raise InputError("sequence", [compose("sequence-video-unread", file=path.name)])
        yield reel
    finally:
        reel.release()
