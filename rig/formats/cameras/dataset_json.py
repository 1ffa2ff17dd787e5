"""Writes the JSON files of data sets of views for training by nerfstudio and GaussianAvatars.

Both nerfstudio and GaussianAvatars read ``transforms.json`` with the axes and pixel centres of
``rig.formats.cameras.transforms_json``. GaussianAvatars (https://github.com/ShenhanQian/GaussianAvatars,
dataset_readers) reads one file for each of training, validation and test. GaussianAvatars assumes square pixels and a
central principal point, and needs only the field of view ``camera_angle_x`` and numbers of cameras and moments (as in
https://github.com/ShenhanQian/VHAP). Lengths are in metres in the capture's world frame.
"""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, UInt8

from rig.camera import Camera
from rig.formats.cameras.transforms_json import frame_document
from rig.rig import Rig

DatasetFormat = Literal["nerfstudio", "gaussian-avatars"]
DATASET_FORMATS: tuple[DatasetFormat, ...] = get_args(DatasetFormat)
MOMENT = 0  # a capture is one moment
FLAME_MOMENT, FLAME_CANONICAL = f"flame_param/{MOMENT:05}.npz", "canonical_flame_param.npz"  # where parameters are
POINT = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [(name, "u1") for name in ("red", "green", "blue")]
)


@dataclass(frozen=True, slots=True)
class DatasetLayout:
    """Names the folders ``pictures`` and ``masks`` and the file ``points`` of a data set."""

    pictures: str
    masks: str
    points: str


LAYOUTS: dict[DatasetFormat, DatasetLayout] = {
    "nerfstudio": DatasetLayout("images", "masks", "sparse_pc.ply"),
    "gaussian-avatars": DatasetLayout("images", "fg_masks", "points3d.ply"),
}


def picture_names(rig: Rig, form: DatasetFormat) -> dict[str, str]:
    """Returns, by camera, the common file name of the camera's picture and mask."""
    if form == "nerfstudio":
        return {name: f"{name}.png" for name in rig.names}
    return {name: f"{MOMENT:05}_{index:02}.png" for index, name in enumerate(rig.names)}


def dataset_documents(
    rig: Rig, form: DatasetFormat, *, with_points: bool, with_flame: bool = False
) -> dict[str, bytes]:
    """Returns the JSON files of a data set by file name. ``rig`` holds the pinhole cameras of the data set's pictures.
    ``with_points`` is True if the data set has a point cloud, and ``with_flame`` if it has FLAME parameters."""
    layout, names = LAYOUTS[form], picture_names(rig, form)
    head: dict[str, object] = {"camera_model": "OPENCV", "unit": "metre"}
    if with_points:
        head["ply_file_path"] = layout.points
    frames = {}
    for index, camera in enumerate(rig):
        mask_path = f"{layout.masks}/{names[camera.name]}"
        frame = frame_document(camera, f"{layout.pictures}/{names[camera.name]}") | {"mask_path": mask_path}
        if form == "gaussian-avatars":
            frame |= _avatar_fields(camera, index, mask_path)
            frame |= {"flame_param_path": FLAME_MOMENT} if with_flame else {}
        frames[camera.name] = frame
    if form == "nerfstudio":
        return {"transforms.json": _encoded(head, frames.values())}
    held_out = held_out_camera(rig)
    train = [frame for name, frame in frames.items() if name != held_out]
    divisions = {"": list(frames.values()), "_train": train, "_val": [frames[held_out]], "_test": [frames[held_out]]}
    return {f"transforms{end}.json": _encoded(head | _indices(part), part) for end, part in divisions.items()}


def held_out_camera(rig: Rig) -> str:
    """Returns the camera to hold out of training for a test: the camera whose two nearest neighbours are nearest."""
    centres = np.stack([camera.centre_world for camera in rig])
    distances = np.sort(np.linalg.norm(centres[:, None] - centres[None], axis=2), axis=1)
    return rig.names[int(np.argmin(distances[:, 1:3].sum(axis=1)))]


def points_ply(
    points_m: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], colours: UInt8[np.ndarray, "n 3"]
) -> bytes:
    """Encodes a point cloud as binary little-endian PLY, in metres."""
    points = np.empty(len(points_m), POINT)
    for names, columns in (("x y z", points_m), ("nx ny nz", normals), ("red green blue", colours)):
        for name, column in zip(names.split(), columns.T, strict=True):
            points[name] = column
    kinds = {"<f4": "float", "|u1": "uchar"}
    properties = [f"property {kinds[POINT[name].str]} {name}" for name in POINT.names or ()]
    lines = ["ply", "format binary_little_endian 1.0", "comment unit metre", f"element vertex {len(points)}"]
    return "\n".join([*lines, *properties, "end_header", ""]).encode("ascii") + points.tobytes()


def _avatar_fields(camera: Camera, index: int, mask_path: str) -> dict[str, object]:
    k = camera.intrinsics
    return {
        "fg_mask_path": mask_path,
        "camera_index": index,
        "camera_id": camera.name,
        "timestep_index": MOMENT,
        "camera_angle_x": 2.0 * math.atan(0.5 * k.width / k.fx),
        "camera_angle_y": 2.0 * math.atan(0.5 * k.height / k.fy),
    }


def _indices(frames: list[dict[str, object]]) -> dict[str, object]:
    return {"timestep_indices": [MOMENT], "camera_indices": [frame["camera_index"] for frame in frames]}


def _encoded(head: dict[str, object], frames: Iterable[dict[str, object]]) -> bytes:
    return json.dumps(head | {"frames": list(frames)}, indent=1, allow_nan=False).encode()
