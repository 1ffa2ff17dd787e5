"""Writes a capture as a training data set for novel-view methods: undistorted pictures, masks, and camera files.

The folder is described in ``rig.formats.cameras.dataset_json``; it contains the used views. For GaussianAvatars the
pictures show the subject on white, and the pinhole cameras have square pixels and the principal point in the middle.
For nerfstudio the pictures keep the original background and camera matrix.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8
from scipy.ndimage import map_coordinates, spline_filter

from pipeline.compute.threads import task_pool
from pipeline.imaging.silhouette import Silhouette
from rig.camera import Camera, Intrinsics
from rig.capture import Capture
from rig.files import write_atomically
from rig.formats.cameras.dataset_json import (
    FLAME_CANONICAL,
    FLAME_MOMENT,
    LAYOUTS,
    DatasetFormat,
    dataset_documents,
    picture_names,
    points_ply,
)
from rig.formats.meshes.flame_param import FlameParam, canonical, encode_flame_param
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.rig import Rig

Plane = Float32[np.ndarray, "h w"]
Photograph = UInt8[np.ndarray, "h w 3"]

THREADS = 4  # a view of four megapixels takes half a gigabyte while it is resampled


@dataclass(frozen=True, slots=True, eq=False)
class ViewDataset:
    """Holds the content of a data set. ``head_world`` is a mesh in the capture's world frame (mm) from which training
    may start; ``flame`` holds the mesh's FLAME parameters."""

    capture: Capture
    rig: Rig
    silhouettes: Mapping[str, Silhouette]
    head_world: Mesh | None = None
    flame: FlameParam | None = None

    @property
    def rig_used(self) -> Rig:
        """Returns the rig with only the cameras whose views are used."""
        return self.rig.subset(name for name, view in self.silhouettes.items() if view.quality.usable)


def write_view_dataset(folder: Path, dataset: ViewDataset, form: DatasetFormat) -> None:
    """Writes the files of a data set in the layout that ``form`` names. Each file is written under a temporary name
    first; the JSON files come last."""
    rig = dataset.rig_used
    pinholes = Rig(
        tuple(
            replace(camera, intrinsics=pinhole_of(camera.intrinsics, centred=form == "gaussian-avatars"), recorded=None)
            for camera in rig
        )
    )
    with task_pool(THREADS) as pool:
        for job in [pool.submit(_write_view, folder, dataset, camera, pinholes, form) for camera in rig]:
            job.result()
    head = dataset.head_world
    if head is not None:
        colours = np.full(head.vertices.shape, 128, np.uint8) if head.colours is None else head.colours
        points = points_ply(head.vertices / 1000.0, head.normals(), np.asarray(colours, np.uint8))
        write_atomically(folder / LAYOUTS[form].points, points)
    if dataset.flame is not None:
        write_atomically(folder / FLAME_MOMENT, encode_flame_param(dataset.flame))
        write_atomically(folder / FLAME_CANONICAL, encode_flame_param(canonical(dataset.flame)))
    documents = dataset_documents(pinholes, form, with_points=head is not None, with_flame=dataset.flame is not None)
    for name, document in documents.items():
        write_atomically(folder / name, document)


def _write_view(folder: Path, dataset: ViewDataset, camera: Camera, pinholes: Rig, form: DatasetFormat) -> None:
    layout, file = LAYOUTS[form], picture_names(pinholes, form)[camera.name]
    lens, pinhole = camera.intrinsics, pinholes[camera.name].intrinsics
    picture = undistorted_picture(np.asarray(dataset.capture.images[camera.name]), lens, pinhole)
    share = undistorted_share(_subject_share(dataset, camera.name), lens, pinhole)
    if form == "gaussian-avatars":
        weight = share[:, :, None]
        picture = np.rint(picture * weight + 255.0 * (1.0 - weight)).astype(np.uint8)
        mask = np.rint(share * 255.0).astype(np.uint8)
    else:
        mask = (share >= 0.5).astype(np.uint8) * np.uint8(255)  # nerfstudio takes all but black for the subject
    write_image(folder / layout.pictures / file, picture)
    write_image(folder / layout.masks / file, mask)


def _subject_share(dataset: ViewDataset, name: str) -> Plane:
    """Returns the fraction of every pixel that shows the subject, from the capture's mask or else from the sub-pixel
    contour."""
    capture = dataset.capture
    if name in capture.soft_masks:
        return capture.soft_masks[name].astype(np.float32) / np.float32(255.0)
    if name in capture.masks:
        return capture.masks[name].astype(np.float32)
    return np.clip(np.float32(0.5) - dataset.silhouettes[name].distance, 0.0, 1.0)


SPLINE_ORDER = 3


def pinhole_of(lens: Intrinsics, *, centred: bool = False) -> Intrinsics:
    """Returns the intrinsics without distortion. If ``centred``, they have square pixels and the principal point in the
    middle of the picture, for file formats that give only a field of view."""
    if not centred:
        return Intrinsics(lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
    focal = math.sqrt(lens.fx * lens.fy)
    return Intrinsics(lens.width, lens.height, focal, focal, 0.5 * (lens.width - 1), 0.5 * (lens.height - 1))


def undistorted_picture(picture: Photograph, lens: Intrinsics, pinhole: Intrinsics) -> UInt8[np.ndarray, "y x 3"]:
    """Undistorts a picture: returns what ``pinhole`` would show, with black pixels outside the original picture."""
    if lens == pinhole:
        return picture
    places = _sampled_pixels(lens, pinhole)
    channels = []
    for channel in np.moveaxis(picture, 2, 0):
        smooth = spline_filter(channel.astype(float), SPLINE_ORDER, mode="mirror")
        channels.append(map_coordinates(smooth, places, order=SPLINE_ORDER, mode="constant", prefilter=False))
    return np.clip(np.rint(np.stack(channels, axis=2)), 0, 255).astype(np.uint8)


def undistorted_share(share: Plane, lens: Intrinsics, pinhole: Intrinsics) -> Float32[np.ndarray, "y x"]:
    """Undistorts a mask (0 to 1) to the pinhole's picture, with 0 outside the original picture."""
    if lens == pinhole:
        return share
    return map_coordinates(share, _sampled_pixels(lens, pinhole), order=1, mode="constant")


def _sampled_pixels(lens: Intrinsics, pinhole: Intrinsics) -> Float[np.ndarray, "2 y x"]:
    """Returns the row and column in the distorted picture for every pixel of the pinhole's picture; -1 beyond the
    radius up to which the distortion model is valid."""
    rows, columns = np.mgrid[: pinhole.height, : pinhole.width].astype(float)
    rays = np.stack([(columns - pinhole.cx) / pinhole.fx, (rows - pinhole.cy) / pinhole.fy], axis=-1).reshape(-1, 2)
    pixels = lens.distortion.apply(rays) * (lens.fx, lens.fy) + (lens.cx, lens.cy)
    pixels[np.hypot(*rays.T) > lens.distortion.max_valid_radius()] = -1.0
    return np.ascontiguousarray(pixels[:, ::-1].T).reshape(2, *rows.shape)
