"""Estimates what the photographs of a patch say of the cameras: by how much each view should shift in its image.

At the depth where a patch's views correlate best, the mean correlation is the least-squares problem ``sum_k v_k |f_k -
T|^2``. Here f_k are the patch's grey values in view k, centred and of unit norm, and T is their mean with the weights
v_k. That eliminates the unknown texture exactly, and with it sliding along the surface. Linear in the image shifts
delta_k (px) of the views,

    H_kl = v_k [k = l] <g_k, g_k> - v_k v_l / V <g_k, g_l>,   gradient_k = v_k <g_k, f_k - T>,

where g_k are the images' slopes and V is the sum of the weights. A displacement u along the normal and camera
corrections c_k make ``delta_k = p_k u + C_k c_k``. Eliminating u leaves the derivative of the patch's depth by the
cameras' poses, and a quadratic form in the cameras alone: shifts that no surface explains. A camera of 0.2 px error
shows in thousands of patches.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.compute.threads import in_threads
from pipeline.geometry.projection import packed_camera
from pipeline.photometric_fit.patch_kernels import (
    Members,
    Pictures,
    Samples,
    add_by_camera,
    add_cameras,
    write_grams,
    write_image_motion,
)
from pipeline.photometric_fit.patches import Patches
from rig.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class CameraSensitivity:
    """Holds, for n patches, how the depth of each depends on the cameras' poses, and the quadratic form in the cameras
    that remains when depth is eliminated. v is the number of views of a patch, a = 2 v their image axes."""

    by_camera: Float[np.ndarray, "n c"]  # d(place, mm along the normal) / d(cameras), c = 6 K
    view: Int[np.ndarray, "n v"]
    stiff: Float[np.ndarray, "n a a"]  # of the image shifts of its views, by the patch's own information
    slope: Float[np.ndarray, "n a"]
    slides: Float[np.ndarray, "n a 6"]  # d(image shifts of a view) / d(its camera)

    def cameras(self, information: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, " c"]]:
        """Returns the sum of all patches' quadratic forms: its matrix, and its gradient towards the minimum, over the
        corrections of all cameras (rad, mm). Each patch is weighted by its ``information`` (mm^-2)."""
        size = self.by_camera.shape[1]
        matrix, gradient = np.zeros((size, size)), np.zeros(size)
        add_cameras(self.view, self.stiff, self.slope, self.slides, information, matrix, gradient)
        return matrix, gradient


def camera_sensitivity(
    view: Int[np.ndarray, "n v"],
    value: Float[np.ndarray, "n v"],
    grams: tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]],
    places: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "n 3"],
    cameras: tuple[Camera, ...],
) -> CameraSensitivity:
    """Computes how the depths of n patches depend on the cameras.

    ``view``: the views of each patch, -1 for none. ``value``: their weights. ``grams``: the result of
    ``gram_matrices``. ``places``: the surface points of the patches, world, mm. ``axes``: unit normals along which they
    move, world. ``cameras``: of the views, at their current poses.
    """
    slopes, mixed = grams
    axis_value = np.repeat(value, 2, axis=1)  # of the 2 v image axes
    total = np.maximum(value.sum(axis=1), 1e-12)[:, None]
    same = np.repeat(np.repeat(np.eye(value.shape[1], dtype=bool), 2, axis=0), 2, axis=1)
    across_views = axis_value[:, :, None] * axis_value[:, None, :] / total[:, :, None]
    matrix = slopes * (axis_value[:, :, None] * same - across_views)
    own_shade = np.take_along_axis(mixed, (np.arange(axis_value.shape[1]) // 2)[None, :, None], axis=2)[:, :, 0]
    gradient = axis_value * (own_shade - np.einsum("nav,nv->na", mixed, value / total))
    ahead, slides = np.zeros(axis_value.shape), np.zeros((*axis_value.shape, 6))
    write_image_motion(view, places, axes, np.stack([packed_camera(camera) for camera in cameras]), ahead, slides)
    # The surface moves freely: u = - (ahead . (H delta + gradient)) / (ahead . H ahead).
    across = np.einsum("nab,nb->na", matrix, ahead)
    curvature = np.einsum("na,na->n", ahead, across)
    curvature = np.where(curvature > 1e-12, curvature, np.inf)[:, None]
    down = np.einsum("na,na->n", ahead, gradient)[:, None]
    by_camera = np.zeros((len(view), 6 * len(cameras)))
    add_by_camera(view, -across / curvature, slides, by_camera)
    return CameraSensitivity(
        by_camera=by_camera,
        view=view,
        stiff=(matrix - across[:, :, None] * across[:, None, :] / curvature[:, :, None]) / curvature[:, :, None],
        slope=(gradient - across * down / curvature) / curvature,
        slides=slides,
    )


def gram_matrices(
    patches: Patches,
    chosen: Int[np.ndarray, " n"],
    weights: Float[np.ndarray, " e"],
    view: Int[np.ndarray, "n v"],
    shifts: Float[np.ndarray, " n"],
    *,
    samples: Samples,
    pictures: Pictures,
) -> tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]]:
    """Computes two sets of inner products for the ``chosen`` patches, with the surface moved by ``shifts`` (mm along
    the normals): of the image slopes of its views with each other (two axes for each view), and of the slopes with the
    grey values."""
    count, views = view.shape
    slopes, mixed = np.zeros((count, 2 * views, 2 * views)), np.zeros((count, 2 * views, views))
    members = Members(patches.start, patches.member, weights)
    in_threads(count, lambda a, b: write_grams(a, b, chosen, members, view, shifts, samples, pictures, slopes, mixed))
    return slopes, mixed
