"""Finds points of the subject that three neighbouring views or more show, to a fraction of a pixel, with cameras that
are nearly known.

Two views cannot show an error along the epipolar line; three can. SIFT keypoints are compared near that line only, so
that many more can be accepted than by their likeness alone (``scene_points``).

Enters: photographs, silhouettes and the rig. Leaves: pixels by point and view, and by how much their rays miss.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from pipeline.compute.threads import map_in_threads
from pipeline.imaging.silhouette import Silhouette
from pipeline.multiview.scene_points import neighbouring_pairs
from rig.camera import Camera
from rig.geometry import nearest_to_rays
from rig.image import ImageRgb
from rig.rig import Rig

MAX_KEYPOINTS = 2500  # of a subject
CONTRAST = 0.004  # of SIFT's peaks, a tenth of what is usual: skin has faint ones, and the cameras tell which are right
MAX_WIDTH = 1400  # px: larger pictures are reduced
INSET_PX = 4.0  # from the outline, where a keypoint is of the backdrop, too
BAND = 0.004  # of the picture's width beside the line that the other camera allows: 4 px
RATIO, MAX_DISTANCE = 0.85, 0.6  # of descriptors: to the second best, and at all
MIN_LIKENESS = 1.0 - 0.5 * (MAX_DISTANCE / RATIO) ** 2  # of a second best that could put the best one in doubt
MIN_VIEWS = 3  # of a point; with 2 there are more points, and each says less
MAX_MISS = 0.005  # of the picture's width: more is a wrong match


@dataclass(frozen=True, slots=True, eq=False)
class SceneTracks:
    """Holds n observations of points in several views: ``pixels[i]`` is where the camera of index ``cameras[i]`` in the
    rig sees the point of index ``points[i]``."""

    points: Int[np.ndarray, " n"]
    cameras: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    min_views: int = MIN_VIEWS

    @property
    def count(self) -> int:
        """Returns the number of points."""
        return int(self.points.max()) + 1 if len(self.points) else 0

    def chosen(self, good: Bool[np.ndarray, " n"]) -> "SceneTracks":
        """Returns the observations that are ``good``, without the points that then have fewer than ``min_views`` of
        them."""
        left = good & (np.bincount(self.points[good], minlength=self.count)[self.points] >= self.min_views)
        _, numbers = np.unique(self.points[left], return_inverse=True)
        return SceneTracks(numbers, self.cameras[left], self.pixels[left], self.min_views)


def find_tracks(
    images: Mapping[str, ImageRgb], silhouettes: Mapping[str, Silhouette], rig: Rig, *, min_views: int = MIN_VIEWS
) -> SceneTracks:
    """Finds points of the subject in all views of the rig, each in ``min_views`` views or more whose rays nearly
    meet."""
    names = rig.names
    seen = map_in_threads(lambda k: _keypoints(images[names[k]], silhouettes[names[k]]), len(rig))
    numbers = {name: k for k, name in enumerate(names)}
    pairs = [(numbers[a], numbers[b]) for a, b in neighbouring_pairs(rig)]

    def match(a: int, b: int) -> Int[np.ndarray, "_ 2"]:
        return _matches(rig.cameras[a], seen[a], rig.cameras[b], seen[b])

    matched = map_in_threads(lambda k: match(*pairs[k]), len(pairs))
    tracks = _joined(pairs, matched, seen, min_views)
    widths = np.array([camera.intrinsics.width for camera in rig], float)
    for factor in (2.0, 1.0):  # wrong matches move the point of right ones
        if tracks.count:
            miss = np.linalg.norm(misses_px(tracks, rig), axis=1)
            tracks = tracks.chosen(miss < factor * MAX_MISS * widths[tracks.cameras])
    return tracks


def misses_px(tracks: SceneTracks, rig: Rig) -> Float[np.ndarray, "n 2"]:
    """Returns the reprojection error of each observation, measured minus projected: each point is placed where it is
    nearest to all its rays. NaN where a pixel lies outside what the lens can show."""
    rays, weights = np.zeros((len(rig), tracks.count, 3)), np.zeros((len(rig), tracks.count))
    for number, camera in enumerate(rig):
        observed = tracks.cameras == number
        rays[number, tracks.points[observed]] = camera.rays_world(tracks.pixels[observed])
        weights[number, tracks.points[observed]] = 1.0
    centres = np.stack([camera.centre_world for camera in rig])
    points = nearest_to_rays(centres, rays, weights, ridge=0.0)[tracks.points]
    missed = np.zeros((len(tracks.points), 2))
    for number, camera in enumerate(rig):
        observed = tracks.cameras == number
        missed[observed] = tracks.pixels[observed] - camera.project(points[observed])
    return missed


Keypoints = tuple[Float[np.ndarray, "_ 2"], Float32[np.ndarray, "_ 128"]]


def _keypoints(image: ImageRgb, silhouette: Silhouette) -> Keypoints:
    """Returns the pixels of keypoints on the subject, and the roots of their descriptors."""
    inside = silhouette.distance < -INSET_PX
    if not inside.any():
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    rows, columns = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    grey, mask = cv2.cvtColor(image[part], cv2.COLOR_RGB2GRAY), inside[part].astype(np.uint8)
    scale = min(1.0, MAX_WIDTH / max(image.shape[:2]))
    if scale < 1.0:
        grey = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        mask = cv2.resize(mask, grey.shape[::-1], interpolation=cv2.INTER_NEAREST)
    finder = cv2.SIFT.create(nfeatures=MAX_KEYPOINTS, contrastThreshold=CONTRAST, enable_precise_upscale=True)
    found, descriptors = finder.detectAndCompute(grey, mask)
    if not len(found):
        return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
    pixels = (np.array([point.pt for point in found]) + 0.5) / scale - 0.5 + (columns[0], rows[0])
    return pixels, np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))


def _matches(one: Camera, first: Keypoints, two: Camera, second: Keypoints) -> Int[np.ndarray, "m 2"]:
    """Returns the numbers of keypoints that are each other's most alike near the epipolar lines."""
    if min(len(first[0]), len(second[0])) < 2:
        return np.zeros((0, 2), int)
    every = first[1] @ second[1].T
    rows, columns = np.nonzero((every > MIN_LIKENESS) & _near_lines(one, first[0], two, second[0]))
    likeness = every[rows, columns]
    order = np.lexsort((-likeness, rows))
    rows, columns, likeness = rows[order], columns[order], likeness[order]
    best = np.flatnonzero(np.diff(rows, prepend=-1))  # of each keypoint of the first view
    follows = np.minimum(best + 1, len(rows) - 1)
    next_best = np.where((rows[follows] == rows[best]) & (follows > best), likeness[follows], 0.0)
    top = np.full(len(second[0]), -1.0)
    np.maximum.at(top, columns, likeness)
    distance, next_distance = (np.sqrt(np.maximum(2.0 - 2.0 * of, 0.0)) for of in (likeness[best], next_best))
    good = (likeness[best] >= top[columns[best]]) & (distance < MAX_DISTANCE) & (distance < RATIO * next_distance)
    return np.stack([rows[best][good], columns[best][good]], axis=1)


def _near_lines(
    one: Camera, first: Float[np.ndarray, "n 2"], two: Camera, second: Float[np.ndarray, "m 2"]
) -> Bool[np.ndarray, "n m"]:
    """Tells which pixels of two views are within ``BAND`` of each other's epipolar lines."""
    relative = two.camera_from_world @ one.camera_from_world.inverse()
    x, y, z = relative.translation / np.linalg.norm(relative.translation)
    essential = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) @ relative.rotation
    straight, other = (np.insert(c.undistort(p), 2, 1.0, axis=1) for c, p in ((one, first), (two, second)))
    line, other_line = straight @ essential.T, other @ essential
    band = BAND * one.intrinsics.width / one.intrinsics.fx
    slopes, other_slopes = (band**2 * (of[:, :2] ** 2).sum(axis=1).astype(np.float32) for of in (line, other_line))
    missed = line.astype(np.float32) @ other.T.astype(np.float32)
    return np.square(missed, out=missed) < slopes[:, None] + other_slopes


def _joined(
    pairs: list[tuple[int, int]], matched: list[Int[np.ndarray, "_ 2"]], seen: list[Keypoints], min_views: int
) -> SceneTracks:
    """Returns chains of matches as points; chains that meet one view twice are left out."""
    from scipy.sparse import coo_array  # a tenth of a second
    from scipy.sparse.csgraph import connected_components

    starts = np.cumsum([0, *(len(pixels) for pixels, _ in seen)])
    links = [
        match + (starts[a], starts[b]) for (a, b), match in zip(pairs, matched, strict=True)
    ] or [np.zeros((0, 2), int)]  # fmt: skip
    ends = np.concatenate(links)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(starts[-1], starts[-1]))
    count, chain = connected_components(graph, directed=False)
    cameras = np.repeat(np.arange(len(seen)), np.diff(starts))
    times = np.zeros((count, len(seen)), int)
    np.add.at(times, (chain, cameras), 1)
    good = ((times.max(axis=1) == 1) & (times.sum(axis=1) >= min_views))[chain]
    _, numbers = np.unique(chain[good], return_inverse=True)
    return SceneTracks(numbers, cameras[good], np.concatenate([pixels for pixels, _ in seen])[good], min_views)
