"""Writes a capture as a data set of views: undistorted pictures, masks, and the files that say where each was taken.

Enters: a capture, its silhouettes and rig. Leaves: the folder described in ``rig.formats.cameras.dataset_json``, of the
views that take part. For GaussianAvatars the pictures show the subject on white, by pinhole cameras with square pixels
and the principal point in the middle; for nerfstudio they keep background and camera matrix.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt8

from pipeline.compute.threads import task_pool
from pipeline.imaging.silhouette import Silhouette
from pipeline.imaging.undistortion import pinhole_of, undistorted_picture, undistorted_share
from rig.atomic_write import write_atomically
from rig.camera import Camera
from rig.capture import Capture
from rig.formats.cameras.dataset_json import (
    FLAME_CANONICAL,
    FLAME_MOMENT,
    LAYOUTS,
    DatasetFormat,
    dataset_documents,
    picture_names,
    points_ply,
)
from rig.formats.meshes.flame_param import FlameParam, canonical, encoded
from rig.formats.pictures.images import write_image
from rig.mesh import Mesh
from rig.rig import Rig

THREADS = 4  # a view of four megapixels takes half a gigabyte while it is resampled


@dataclass(frozen=True, slots=True, eq=False)
class ViewDataset:
    """Holds what a data set is made of. ``head_world`` is a surface in the capture's world frame (mm) from which
    training may start, ``flame`` its parameters there."""

    capture: Capture
    rig: Rig
    silhouettes: Mapping[str, Silhouette]
    head_world: Mesh | None = None
    flame: FlameParam | None = None

    @property
    def rig_used(self) -> Rig:
        """Returns the cameras whose views take part."""
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
        write_atomically(folder / FLAME_MOMENT, encoded(dataset.flame))
        write_atomically(folder / FLAME_CANONICAL, encoded(canonical(dataset.flame)))
    documents = dataset_documents(pinholes, form, with_points=head is not None, with_flame=dataset.flame is not None)
    for name, document in documents.items():
        write_atomically(folder / name, document)


def _write_view(folder: Path, dataset: ViewDataset, camera: Camera, pinholes: Rig, form: DatasetFormat) -> None:
    layout, file = LAYOUTS[form], picture_names(pinholes, form)[camera.name]
    lens, pinhole = camera.intrinsics, pinholes[camera.name].intrinsics
    picture = undistorted_picture(np.asarray(dataset.capture.images[camera.name]), lens, pinhole)
    share = undistorted_share(_subject_share(dataset, camera.name), lens, pinhole)
    if form == "gaussian-avatars":
        picture = _before_white(picture, share)
        mask = np.rint(share * 255.0).astype(np.uint8)
    else:
        mask = (share >= 0.5).astype(np.uint8) * np.uint8(255)  # nerfstudio takes all but black for the subject
    write_image(folder / layout.pictures / file, picture)
    write_image(folder / layout.masks / file, mask)


def _subject_share(dataset: ViewDataset, name: str) -> Float32[np.ndarray, "h w"]:
    """Returns the share of the subject in every pixel, 0 to 1: of a mask in the capture as it is, else of the sub-pixel
    contour that was found."""
    capture = dataset.capture
    if name in capture.soft_masks:
        return capture.soft_masks[name].astype(np.float32) / np.float32(255.0)
    if name in capture.masks:
        return capture.masks[name].astype(np.float32)
    return np.clip(np.float32(0.5) - dataset.silhouettes[name].distance, 0.0, 1.0)


def _before_white(
    picture: UInt8[np.ndarray, "h w 3"], share: Float[np.ndarray, "h w"] | Float32[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    weight = share[:, :, None]
    return np.rint(picture * weight + 255.0 * (1.0 - weight)).astype(np.uint8)
