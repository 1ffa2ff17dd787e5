"""What a patch's views say of the cameras: how far each view would like to slide in its image.

At a patch's peak the mean correlation of its views is the least-squares problem ``sum_k v_k |f_k - T|^2``: f_k the
patch's grey values in view k, centred and of unit norm, T their mean with the weights v_k (which eliminates the unknown
texture exactly, and sliding along the surface with it). Linear in the image shifts delta_k (px) of the views,

    H_kl = v_k [k = l] <g_k, g_k> - v_k v_l / V <g_k, g_l>,   gradient_k = v_k <g_k, f_k - T>,

g_k the images' slopes. A displacement u along the normal and camera corrections c_k make ``delta_k = p_k u + C_k c_k``.
Eliminating u leaves the derivative of patch depth with respect to camera pose, and a quadratic form in the cameras
alone: shifts that no surface explains. A camera of 0.2 px error shows in thousands of patches.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.compiled import njit
from pipeline.fitting.photo.correlation import Members, Pictures, Samples, read
from pipeline.fitting.photo.patches import Patches
from pipeline.parallel_for import in_threads
from rig.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class CameraSensitivity:
    """Of n patches: the derivative of depth with respect to camera pose, and what they say of the cameras alone."""

    by_camera: Float[np.ndarray, "n c"]  # d(place, mm along the normal) / d(cameras), c = 6 K
    stiff: Float[np.ndarray, "n a a"]  # of the image shifts of its views, by the patch's own information
    slope: Float[np.ndarray, "n a"]
    slides: Float[np.ndarray, "n a c"]  # d(image shifts) / d(cameras)

    def cameras(self, information: Float[np.ndarray, " n"]) -> tuple[Float[np.ndarray, "c c"], Float[np.ndarray, " c"]]:
        """Matrix and gradient (towards the minimum) in the cameras."""
        slides = self.slides.reshape(-1, self.slides.shape[2])
        pulled = (self.stiff * information[:, None, None]) @ self.slides
        return slides.T @ pulled.reshape(slides.shape), -(self.slope * information[:, None]).ravel() @ slides


def camera_sensitivity(
    view: Int[np.ndarray, "n v"],
    value: Float[np.ndarray, "n v"],
    grams: tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]],
    places: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "n 3"],
    cameras: tuple[Camera, ...],
) -> CameraSensitivity:
    """Of patches whose surface lies at ``places`` and moves along ``axes``; ``grams``: of ``gram_matrices``."""
    slopes, mixed = grams
    axis_value = np.repeat(value, 2, axis=1)  # of the 2 v image axes
    total = np.maximum(value.sum(axis=1), 1e-12)[:, None]
    same = np.repeat(np.repeat(np.eye(value.shape[1], dtype=bool), 2, axis=0), 2, axis=1)
    across_views = axis_value[:, :, None] * axis_value[:, None, :] / total[:, :, None]
    matrix = slopes * (axis_value[:, :, None] * same - across_views)
    own_shade = np.take_along_axis(mixed, (np.arange(axis_value.shape[1]) // 2)[None, :, None], axis=2)[:, :, 0]
    gradient = axis_value * (own_shade - np.einsum("nav,nv->na", mixed, value / total))
    ahead, slides = image_motion(view, places, axes, cameras)
    # The surface moves freely: u = - (ahead . (H delta + gradient)) / (ahead . H ahead).
    across = np.einsum("nab,nb->na", matrix, ahead)
    own = np.einsum("na,na->n", ahead, across)
    own = np.where(own > 1e-12, own, np.inf)[:, None]
    down = np.einsum("na,na->n", ahead, gradient)[:, None]
    return CameraSensitivity(
        by_camera=np.einsum("na,nac->nc", -across / own, slides),
        stiff=(matrix - across[:, :, None] * across[:, None, :] / own[:, :, None]) / own[:, :, None],
        slope=(gradient - across * down / own) / own,
        slides=slides,
    )


def image_motion(
    view: Int[np.ndarray, "n v"],
    places: Float[np.ndarray, "n 3"],
    axes: Float[np.ndarray, "n 3"],
    cameras: tuple[Camera, ...],
) -> tuple[Float[np.ndarray, "n a"], Float[np.ndarray, "n a c"]]:
    """Per image axis of each patch's views: motion (px) by a mm along the axis, and by the cameras' corrections."""
    ahead = np.zeros((*view.shape, 2))
    slides = np.zeros((*view.shape, 2, len(cameras), 6))
    for k, camera in enumerate(cameras):
        patch, column = np.nonzero(view == k)
        _, slope = camera.project_with_jacobian(places[patch])
        ahead[patch, column] = np.einsum("nac,nc->na", slope, axes[patch])
        # By the point in the camera's frame, where the correction (a left perturbation, as everywhere) acts.
        inner = slope @ camera.camera_from_world.rotation.T
        arm = camera.camera_from_world.apply(places[patch])[:, None]
        slides[patch, column, :, k] = np.concatenate([np.cross(arm, inner), inner], axis=2)
    count, axes_count = len(view), 2 * view.shape[1]
    return ahead.reshape(count, axes_count), slides.reshape(count, axes_count, 6 * len(cameras))


def gram_matrices(
    patches: Patches,
    chosen: Int[np.ndarray, " n"],
    weights: Float[np.ndarray, " e"],
    view: Int[np.ndarray, "n v"],
    shifts: Float[np.ndarray, " n"],
    samples: Samples,
    pictures: Pictures,
) -> tuple[Float[np.ndarray, "n a a"], Float[np.ndarray, "n a v"]]:
    """<g, g> of the slopes of a patch's views, two axes each, and <g, f> of slopes and grey values, with the surface
    moved by ``shifts`` (mm along the normals)."""
    count, views = view.shape
    slopes, mixed = np.zeros((count, 2 * views, 2 * views)), np.zeros((count, 2 * views, views))
    members = Members(patches.start, patches.member, weights)
    in_threads(count, lambda a, b: _grams(a, b, chosen, members, view, shifts, samples, pictures, slopes, mixed))
    return slopes, mixed


@njit(cache=True, nogil=True, fastmath=True)
def _grams(first, last, chosen, members, view, shifts, samples, pictures, slopes, mixed):
    start, member, weight = members
    pixel, along, seen = samples
    size, offset, image, noise = pictures
    for q in range(first, last):
        begin, count, views = start[chosen[q]], start[chosen[q] + 1] - start[chosen[q]], 0
        while views < view.shape[1] and view[q, views] >= 0:
            views += 1
        shades, turns = np.empty((views, count)), np.empty((2 * views, count))
        for j in range(views):
            k = view[q, j]
            from_, width, height = offset[k], size[k, 0], size[k, 1]
            total = mean = mean_x = mean_y = 0.0
            for i in range(count):
                s, w = member[begin + i], weight[begin + i]
                shades[j, i] = turns[2 * j, i] = turns[2 * j + 1, i] = 0.0
                if not seen[k, s]:
                    continue
                x = pixel[k, s, 0] + shifts[q] * along[k, s, 0]
                y = pixel[k, s, 1] + shifts[q] * along[k, s, 1]
                shades[j, i] = read(image, from_, width, height, x, y)
                turns[2 * j, i] = 0.5 * (
                    read(image, from_, width, height, x + 1.0, y) - read(image, from_, width, height, x - 1.0, y)
                )
                turns[2 * j + 1, i] = 0.5 * (
                    read(image, from_, width, height, x, y + 1.0) - read(image, from_, width, height, x, y - 1.0)
                )
                total += w
                mean += w * shades[j, i]
                mean_x += w * turns[2 * j, i]
                mean_y += w * turns[2 * j + 1, i]
            energy = along_x = along_y = 0.0
            for i in range(count):
                if seen[k, member[begin + i]]:
                    w = weight[begin + i]
                    shades[j, i] -= mean / total
                    turns[2 * j, i] -= mean_x / total
                    turns[2 * j + 1, i] -= mean_y / total
                    energy += w * shades[j, i] * shades[j, i]
                    along_x += w * shades[j, i] * turns[2 * j, i]
                    along_y += w * shades[j, i] * turns[2 * j + 1, i]
            square = energy + total * noise[k] * noise[k]
            norm = np.sqrt(square)
            for i in range(count):  # the slope of what has unit norm
                turns[2 * j, i] = (turns[2 * j, i] - along_x / square * shades[j, i]) / norm
                turns[2 * j + 1, i] = (turns[2 * j + 1, i] - along_y / square * shades[j, i]) / norm
                shades[j, i] /= norm
        for a in range(2 * views):
            for b in range(a + 1):
                product = 0.0
                for i in range(count):
                    product += weight[begin + i] * turns[a, i] * turns[b, i]
                slopes[q, a, b] = slopes[q, b, a] = product
            for b in range(views):
                product = 0.0
                for i in range(count):
                    product += weight[begin + i] * turns[a, i] * shades[b, i]
                mixed[q, a, b] = product
