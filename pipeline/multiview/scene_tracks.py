"""Finds points of the subject in three or more neighbouring views with sub-pixel accuracy, when the cameras are nearly
known.

Two views cannot reveal an error along the epipolar line; three views can. SIFT keypoints are compared only near the
epipolar line, so many more matches are accepted than by similarity alone. (``find_scene_points`` uses similarity alone;
each of its points has two neighbouring views, and they separate near from far objects where colours do not.)

The input is photographs, silhouettes and the rig. The output is pixels by point and view, and the reprojection errors.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from pipeline.compute.threads import map_in_threads
from pipeline.imaging.silhouette import Silhouette
from rig.camera import Camera
from rig.geometry import nearest_to_rays
from rig.image import ImageRgb
from rig.rig import Rig

MAX_OF_PICTURE = 3000  # a view
NEIGHBOURS, MAX_ANGLE_DEG, MIN_ANGLE_DEG = 4, 50.0, 1.5  # of the rays at the subject; SIFT bears 30 degrees or so
MUTUAL_RATIO = 0.75  # of the best match's distance to the second's (Lowe 2004 has 0.8)
MAX_MISS_PX = 1.5  # of the reduced picture
MAX_KEYPOINTS = 2500  # of a subject
CONTRAST = 0.004  # of SIFT's peaks, a tenth of the usual: skin has faint peaks, and epipolar lines reject wrong ones
MAX_WIDTH = 1400  # px: larger pictures are reduced
INSET_PX = 4.0  # from the outline: nearer keypoints contain backdrop
BAND = 0.004  # of the picture's width beside the line that the other camera allows: 4 px
RATIO, MAX_DISTANCE = 0.85, 0.6  # of descriptors: to the second best, and at all
MIN_LIKENESS = 1.0 - 0.5 * (MAX_DISTANCE / RATIO) ** 2  # of a second match that makes the best one ambiguous
MIN_VIEWS = 3  # of a point; with 2 there are more but less informative points
MAX_MISS = 0.005  # of the picture's width: more is a wrong match


@dataclass(frozen=True, slots=True, eq=False)
class ScenePoints:
    """Holds points of the scene (world frame, mm) with their pixels. For each view, ``pixels`` holds the pixels of the
    visible points, and ``rows`` the indices of these points."""

    points: Float[np.ndarray, "n 3"]
    pixels: Mapping[str, Float[np.ndarray, "_ 2"]]
    rows: Mapping[str, np.ndarray]


def find_scene_points(
    images: Mapping[str, UInt8[np.ndarray, "_ _ 3"]], rig: Rig, *, report: Callable[[float], None] = lambda share: None
) -> ScenePoints:
    """Finds points of the scene by matching keypoints between all pairs of neighbouring views. ``images`` are RGB, by
    camera name; ``report`` is called with the finished fraction."""
    seen = {}
    for count, camera in enumerate(rig):
        report(0.5 * count / len(rig))
        seen[camera.name] = _all_keypoints(images[camera.name])
    points: list[np.ndarray] = []
    pixels: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    rows: dict[str, list[np.ndarray]] = {name: [] for name in rig.names}
    total = 0
    pairs = neighbouring_pairs(rig)
    for count, (a, b) in enumerate(pairs):
        report(0.5 + 0.5 * count / max(1, len(pairs)))
        first, second = _mutual_matches(seen[a], seen[b])
        found, good = _where_rays_pass(rig[a], first, rig[b], second)
        points.append(found[good])
        indices = np.arange(total, total + np.count_nonzero(good))
        total += len(indices)
        for name, at in ((a, first), (b, second)):
            pixels[name].append(at[good])
            rows[name].append(indices)
    return ScenePoints(
        np.concatenate(points) if points else np.zeros((0, 3)),
        {name: np.concatenate(at) if at else np.zeros((0, 2)) for name, at in pixels.items()},
        {name: np.concatenate(row) if row else np.zeros(0, int) for name, row in rows.items()},
    )


def neighbouring_pairs(rig: Rig) -> list[tuple[str, str]]:
    """Returns the pairs of cameras that see the subject from nearly the same side."""
    away = np.stack([camera.centre_world for camera in rig]) - rig.centre_world()
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip(away @ away.T, -1, 1)))
    np.fill_diagonal(angle, np.inf)
    pairs = {
        (min(i, int(j)), max(i, int(j)))
        for i in range(len(rig))
        for j in np.argsort(angle[i])[:NEIGHBOURS]
        if angle[i, j] < MAX_ANGLE_DEG
    }
    return [(rig.names[i], rig.names[j]) for i, j in sorted(pairs)]


def _all_keypoints(image: UInt8[np.ndarray, "h w 3"]) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels of keypoints in the whole image, and their descriptors."""
    scale = min(1.0, MAX_WIDTH / max(image.shape[:2]))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
    found, descriptors = cv2.SIFT.create(nfeatures=MAX_OF_PICTURE).detectAndCompute(
        cv2.cvtColor(small, cv2.COLOR_RGB2GRAY), None
    )
    at = np.array([point.pt for point in found]).reshape(-1, 2)
    descriptors = np.zeros((0, 128), np.float32) if descriptors is None else descriptors
    return (at + 0.5) / scale - 0.5, np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))


def _mutual_matches(
    first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the pixels in both images of keypoints that match mutually and pass the ratio test."""
    if min(len(first[0]), len(second[0])) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    likeness = first[1] @ second[1].T
    best = likeness.argmax(axis=1)
    row = np.arange(len(best))
    top = likeness[row, best]
    mutual = likeness.argmax(axis=0)[best] == row
    likeness[row, best] = -1
    next_best = likeness.max(axis=1)
    good = mutual & (2 - 2 * top < MUTUAL_RATIO**2 * (2 - 2 * next_best))
    return first[0][good], second[0][best[good]]


def _where_rays_pass(
    a: Camera, first: Float[np.ndarray, "n 2"], b: Camera, second: Float[np.ndarray, "n 2"]
) -> tuple[Float[np.ndarray, "n 3"], np.ndarray]:
    """Returns the points halfway between the rays of two matched pixels, and a mask of the points that project near
    both pixels."""
    if not len(first):
        return np.zeros((0, 3)), np.zeros(0, bool)
    u, v = a.rays_world(first), b.rays_world(second)
    base = b.centre_world - a.centre_world
    cosine = (u * v).sum(axis=1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_u = (u @ base - cosine * (v @ base)) / sine2
    along_v = (cosine * (u @ base) - v @ base) / sine2
    points = 0.5 * (a.centre_world + along_u[:, None] * u + b.centre_world + along_v[:, None] * v)
    limit = MAX_MISS_PX * max(1.0, max(a.intrinsics.width, a.intrinsics.height) / MAX_WIDTH)
    good = (sine2 > np.sin(np.radians(MIN_ANGLE_DEG)) ** 2) & (along_u > 0) & (along_v > 0)
    for camera, at in ((a, first), (b, second)):
        with np.errstate(invalid="ignore"):
            good &= np.linalg.norm(camera.project(points) - at, axis=1) < limit
    return points, good


@dataclass(frozen=True, slots=True, eq=False)
class SceneTracks:
    """Holds n observations of points in several views: camera ``cameras[i]`` (its index in the rig) sees point
    ``points[i]`` at ``pixels[i]``."""

    points: Int[np.ndarray, " n"]
    cameras: Int[np.ndarray, " n"]
    pixels: Float[np.ndarray, "n 2"]
    min_views: int = MIN_VIEWS

    @property
    def count(self) -> int:
        """Returns the number of points."""
        return int(self.points.max()) + 1 if len(self.points) else 0

    def chosen(self, good: Bool[np.ndarray, " n"]) -> "SceneTracks":
        """Returns only the observations marked ``good``; points with fewer than ``min_views`` of these are removed."""
        left = good & (np.bincount(self.points[good], minlength=self.count)[self.points] >= self.min_views)
        _, numbers = np.unique(self.points[left], return_inverse=True)
        return SceneTracks(numbers, self.cameras[left], self.pixels[left], self.min_views)


def find_tracks(
    images: Mapping[str, ImageRgb], silhouettes: Mapping[str, Silhouette], rig: Rig, *, min_views: int = MIN_VIEWS
) -> SceneTracks:
    """Finds points of the subject in all views of the rig; each point has at least ``min_views`` views, whose rays
    nearly meet."""
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
    """Returns the reprojection error of each observation (measured minus projected, px) for the point nearest to all
    its rays. The error is NaN for pixels outside the valid area of the lens model."""
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
    """Returns the pixels of keypoints on the subject, and the element-wise square roots of their descriptors."""
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
    """Returns pairs of keypoint indices that are each other's best match near the epipolar lines."""
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
    """Returns a matrix that marks which pixels of two views lie within ``BAND`` of each other's epipolar lines."""
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
    """Joins chains of pairwise matches to points; a chain with two pixels in one view is left out."""
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
