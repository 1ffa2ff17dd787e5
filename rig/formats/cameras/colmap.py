"""Reads and writes COLMAP models, text and binary (https://colmap.github.io/format.html; parameter order of
``src/colmap/sensor/models.h``).

The centre of the top-left pixel is (0.5, 0.5) in COLMAP and (0, 0) in this project, so half a pixel is subtracted on
reading and added on writing. The unit of a COLMAP model is arbitrary and taken as millimetres."""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from rig.camera import Camera
from rig.files import write_atomically
from rig.formats.cameras.cameras_json import CAMERAS_READ_MOST
from rig.formats.cameras.foreign import (
    CamerasRead,
    Malformed,
    Reading,
    camera_entry,
    camera_names,
    lens_entry,
    parsed,
    shown,
)
from rig.formats.pictures.picture_names import entry
from rig.messages.message import Message, compose
from rig.rig import Rig

# name: (number in the binary file, parameter names in their order).
COLMAP_MODELS: dict[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, ("f", "cx", "cy")),
    "PINHOLE": (1, ("fx", "fy", "cx", "cy")),
    "SIMPLE_RADIAL": (2, ("f", "cx", "cy", "k1")),
    "RADIAL": (3, ("f", "cx", "cy", "k1", "k2")),
    "OPENCV": (4, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "SIMPLE_RADIAL_FISHEYE": (8, ("f", "cx", "cy", "k1")),
    "RADIAL_FISHEYE": (9, ("f", "cx", "cy", "k1", "k2")),
    "SIMPLE_FISHEYE": (14, ("f", "cx", "cy")),
    "FISHEYE": (15, ("fx", "fy", "cx", "cy")),
}
# Models that have no counterpart here, by their number.
REFUSED_MODELS = {
    **{7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION"},
    **{16: "EUCM", 17: "EQUIRECTANGULAR"},
}
COLMAP_NAMES = {number: name for name, (number, _) in COLMAP_MODELS.items()}


def read_colmap(path: Path) -> CamerasRead:
    """Returns the rig in the COLMAP model whose ``cameras`` file is ``path``. Each image of a COLMAP model becomes a
    camera, named after the image file. Raises InputError naming every fault."""
    folder, suffix = path.parent, path.suffix.lower()
    files = [entry(folder, f"{kind}{suffix}") for kind in ("cameras", "images")]
    subject = "/".join([folder.name, f"cameras{suffix}"]) if folder.name else f"cameras{suffix}"
    binary = suffix == ".bin"
    cameras = parsed(files[0], _binary_cameras if binary else _text_cameras)
    images = parsed(files[1], _binary_images if binary else _text_images)
    names = camera_names([image.name for image in images])
    reading = Reading(subject)
    faults = reading.faults
    entries = []
    for name, image in zip(names, images, strict=True):
        camera = cameras.get(image.camera)
        if camera is None:
            files = f"cameras{suffix}"
            faults.append(compose("image-of-strange-camera", image=f"{name!r}", camera=image.camera, file=files))
            continue
        entries.append(_colmap_entry(name, image, camera, faults))
    return reading.finish(entries)


def write_colmap(rig: Rig, folder: Path, *, binary: bool = False, suffix: str = ".png") -> None:
    """Writes ``cameras``, ``images``, ``rigs``, ``frames`` and an empty ``points3D``. Images are named
    ``<camera><suffix>``."""
    import pycolmap

    model = pycolmap.Reconstruction()
    for number, camera in enumerate(rig, start=1):
        (kind, parameters), k, pose = _colmap_model(camera), camera.intrinsics, camera.camera_from_world
        lens = pycolmap.Camera(camera_id=number, model=kind, width=k.width, height=k.height, params=parameters)
        image = pycolmap.Image(name=f"{camera.name}{suffix}", camera_id=number, image_id=number)
        model.add_camera_with_trivial_rig(lens)
        posed = pycolmap.Rigid3d(np.column_stack([pose.rotation, pose.translation]))
        model.add_image_with_trivial_frame(image, posed)
    with TemporaryDirectory() as scratch:
        model.write_binary(scratch) if binary else model.write_text(scratch)
        for path in Path(scratch).iterdir():
            write_atomically(folder / path.name, path.read_bytes())


class _Records:
    """Reads consecutive little-endian records from bytes. Raises ``struct.error`` if the bytes end too early."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += struct.calcsize("<" + layout)
        return values

    def count(self, least_bytes: int) -> int:
        """Reads a count of records, each of at least ``least_bytes`` bytes. Raises Malformed before memory is
        allocated, if the rest of the file is too short for this count."""
        (count,) = self.take("Q")
        if count * least_bytes > len(self.data) - self.at:
            raise Malformed(compose("records-promised", records=str(count)))
        return count

    def skip(self, size: int) -> None:
        self.at += size

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise Malformed(compose("name-without-end"))
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text


@dataclass(frozen=True, slots=True)
class ColmapCamera:
    """Holds a camera of a COLMAP model. ``values`` are the lens parameters in the order of COLMAP's camera model."""

    model: str
    width: int
    height: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class ColmapImage:
    """Holds an image of a COLMAP model: quaternion and translation of camera_from_world, and the camera's number."""

    pose: list[float]
    camera: int
    name: str


def _binary_cameras(data: bytes) -> dict[int, ColmapCamera]:
    records = _Records(data)
    cameras = {}
    for _ in range(records.count(24)):
        number, model, width, height = records.take("iiQQ")
        name = COLMAP_NAMES.get(model)
        if name is None:
            known = REFUSED_MODELS.get(model)
            of_number = compose("model-of-number", number=model)
            named = compose("model-and-number", model=known, number=model) if known else of_number
            raise Malformed(_model_fault(named, number))
        values = records.take(f"{len(COLMAP_MODELS[name][1])}d")
        cameras[number] = ColmapCamera(name, width, height, values)
    return cameras


def _binary_images(data: bytes) -> list[ColmapImage]:
    records = _Records(data)
    images = []
    for _ in range(_limited(records.count(73))):
        _, *pose, camera = records.take("i7di")
        images.append(ColmapImage(pose, camera, records.text()))
        records.skip(24 * records.count(24))
    return images


def _text_cameras(data: bytes) -> dict[int, ColmapCamera]:
    cameras = {}
    for line in _text_lines(data):
        if not line.split():
            continue
        number, name, width, height, *values = line.split()
        if name not in COLMAP_MODELS:
            raise Malformed(_model_fault(shown(name), number))
        wanted = len(COLMAP_MODELS[name][1])
        if len(values) != wanted:
            held = len(values)
            raise Malformed(compose("lens-parameters", camera=number[:20], held=held, model=name, wanted=wanted))
        numbers = tuple(float(value) for value in values)
        cameras[int(number)] = ColmapCamera(name, int(width), int(height), numbers)
    return cameras


def _text_images(data: bytes) -> list[ColmapImage]:
    """Reads the images of a text model. The line of an image is followed by a line of points, which hand-written files
    often lack."""
    images: list[ColmapImage] = []
    after_image = False
    for line in _text_lines(data):
        if after_image and _is_of_points(line):
            after_image = False
            continue
        if not line.split():
            continue
        words = line.split(maxsplit=9)
        if len(words) != 10:
            raise Malformed(compose("image-line", held=len(words), line=shown(line.strip())))
        pose = [float(word) for word in words[1:8]]
        images.append(ColmapImage(pose, int(words[8]), words[9].strip()))
        after_image = True
        _limited(len(images))
    return images


def _is_of_points(line: str) -> bool:
    """Returns whether a line is empty or can be a list of points, each with X, Y and an integer.

    An image's line in COLMAP's text has ten or more words, one of them a name. Ten numbers cannot be a list of points,
    each of three numbers, because 3 does not divide 10."""
    words = line.split()
    try:
        return len(words) % 3 == 0 and bool(np.isfinite([float(word) for word in words]).all())
    except ValueError:
        return False


def _text_lines(data: bytes) -> Iterator[str]:
    return (line for line in data.decode("utf-8").splitlines() if not line.lstrip().startswith("#"))


def _limited(count: int) -> int:
    if count > CAMERAS_READ_MOST:
        raise Malformed(compose("images-many", images=str(count), most=CAMERAS_READ_MOST))
    return count


def _model_fault(model: str | Message, number: Any) -> Message:
    return compose("lens-model-unread", camera=f"{number!s:.20}", model=model, known=[*COLMAP_MODELS])


def _colmap_entry(name: str, image: ColmapImage, camera: ColmapCamera, faults: list[Message]) -> dict[str, object]:
    from scipy.spatial.transform import Rotation

    parameters = dict(zip(COLMAP_MODELS[camera.model][1], camera.values, strict=True))
    focal = parameters.get("f", 0.0)
    fx, fy = parameters.get("fx", focal), parameters.get("fy", focal)
    lens = lens_entry(parameters, name, faults, fisheye="FISHEYE" in camera.model)
    # A length far from 1 is no rotation: the matrix is as long, and NaN of none; the document's own check names both.
    length = math.hypot(*image.pose[:4])
    size = 1.0 if 0.9 < length < 1.1 else length
    of_pose = Rotation.from_quat(np.roll(image.pose[:4], -1)).as_matrix() if 0 < length < math.inf else math.nan
    rotation = size * np.broadcast_to(of_pose, (3, 3))
    intrinsics = fx, fy, parameters["cx"] - 0.5, parameters["cy"] - 0.5
    size = camera.width, camera.height
    return camera_entry(name, size, intrinsics, lens, rotation, np.array(image.pose[4:]))


def _colmap_model(camera: Camera) -> tuple[str, list[float]]:
    """Returns the name and the parameters of the COLMAP camera model that represents a camera."""
    k, lens = camera.intrinsics, camera.recorded
    frame = [k.fx, k.fy, k.cx + 0.5, k.cy + 0.5]
    if lens is None:
        return "FULL_OPENCV", [*frame, *k.distortion.opencv().tolist(), 0.0, 0.0, 0.0]
    return "OPENCV_FISHEYE" if lens.model == "kannala-brandt" else "FULL_OPENCV", [*frame, *lens.coefficients]
