"""Finds irises and where the eyes look: a circle in space, the limbus, whose edges all views share.

Enters: the subject's face in the views with the points of the eyes' network, the photographs and the cameras. Leaves,
by eye: centre and radius of the iris, the direction of the gaze, each with its deviation; or why the eye is not seen.
The gaze is the limbus' normal, the eye's optical axis; the line of sight lies about 5 degrees nearer to the nose.

Edges are looked for about the circle, the circle is fitted to them, and so on, nearer and nearer. Priors: the radius is
5.85 mm (deviation 0.25; a visible iris of 11.7 mm, Ruefer et al. 2005). The eyeball's centre, 10.5 mm behind the iris,
lies 5 mm behind the corners of the eye, to 4 mm in each direction. Both eyes look at one point: elevations are the same
to 1 degree, and the lines meet as for a point half a metre away or farther; where the two eyes contradict that clearly
(a squint), each is left as it was found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.faces.detection import FaceDetection
from pipeline.faces.eyes import LIDS
from pipeline.faces.limbus import EyeView, eye_view, limbus_offsets
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS
from rig.geometry import cross_matrix, rotation_from_vector
from rig.image import ImageRgb
from rig.rig import Rig

RADIUS_MM, RADIUS_STD_MM = 5.85, 0.25
EYEBALL_MM = 12.0
BEHIND_MM = float(np.sqrt(EYEBALL_MM**2 - RADIUS_MM**2))  # from the iris' centre to the eyeball's
CENTRE_STD_MM = 4.0
FROM_CORNERS_MM = np.array([0.0, 1.0, -5.0])  # from the middle between an eye's corners to its eyeball, face frame
CORNERS = {"right": RIGHT_EYE_CORNERS, "left": LEFT_EYE_CORNERS}
VERGENCE_DEG = (3.0, 2.5)  # between both eyes: mean (a point 1.2 m away) and deviation
ELEVATIONS_DEG = 1.0
MAX_CONTRADICTION = 9.0  # squared deviations, of two
RAYS = 96
REACHES = (0.35, 0.35, 0.25, 0.25, 0.18, 0.18, 0.15, 0.15)  # of the search about the circle, by its radius
MIN_FACING = 0.5  # cosine between gaze and view
CORNEA = np.array([0.656, 0.755])  # its normal at the limbus (7.8 mm of radius): along the gaze, and outwards
MIN_SEEN = 0.25  # cosine between that and the view: the cornea hides, or bends, the limbus behind it
MIN_RADIUS_PX = 5.0  # of an iris in a view that counts
MIN_VIEWS = 2
MIN_RAYS = 6  # with an edge, of a view that counts
MIN_SIDE, ASIDE = 8, 0.5  # of rays over all views on each side of an iris: one side alone tells little; a cosine
ROBUST_PX, MIN_NOISE_PX = 0.7, 0.15
SHARED = 6.0  # edges of a view err together (lids' shade, highlights): so many count as one
MAX_NETWORK_OFF = 0.6  # between a view's network and the circle's centre, by the iris' radius
MAX_RMS = 0.09  # of the edges, by the iris' radius
MAX_RADIUS_OFF_MM = 0.75
MAX_GAZE_STD_DEG = 6.0
MAX_BETWEEN_DEG = 12.0  # of two gazes: a point 0.3 m away. More is a squint or, more often, an error of one
MAX_ALONE_DEG = 20.0  # off ahead, of an eye that the other does not confirm: whoever looks farther turns the head
Cause = Literal["closed", "few-views", "coarse", "unclear"]
IRISES = {"right": 0, "left": 5}  # rows of ``FaceDetection.irises_px``: the centre


@dataclass(frozen=True, slots=True, eq=False)
class Iris:
    """Holds an iris (world frame, mm). ``gaze`` is the unit vector along which the eye looks. ``covariance`` is that of
    the centre (mm), of a rotation of the gaze (rad, world axes; nothing about the gaze), and of the radius (mm)."""

    centre: Float[np.ndarray, " 3"]
    gaze: Float[np.ndarray, " 3"]
    radius_mm: float
    covariance: Float[np.ndarray, "7 7"]
    views: tuple[str, ...]
    rms_px: float

    @property
    def centre_std_mm(self) -> Float[np.ndarray, " 3"]:
        """Returns the standard deviation of each coordinate of the centre."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def gaze_std_deg(self) -> float:
        """Returns the standard deviation of the gaze, the mean of both directions across it (degrees)."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[3:6, 3:6]) / 2.0)))

    @property
    def eyeball(self) -> Float[np.ndarray, " 3"]:
        """Returns the centre of the eyeball, about which the eye turns."""
        return self.centre - BEHIND_MM * self.gaze

    @property
    def eyeball_jacobian(self) -> Float[np.ndarray, "3 7"]:
        """Returns the derivative of ``eyeball`` by what ``covariance`` is of."""
        return np.concatenate([np.eye(3), BEHIND_MM * cross_matrix(self.gaze), np.zeros((3, 1))], axis=1)


@dataclass(frozen=True, slots=True)
class UnseenEye:
    """Holds why an eye is not seen: its lids are closed, fewer than two views show it, no two show it large enough, or
    its limbus is not clear."""

    cause: Cause


def find_irises(
    face: MatchedFaces, images: Mapping[str, ImageRgb], rig: Rig, closed: frozenset[str]
) -> dict[str, Iris | UnseenEye]:
    """Finds both irises.

    Args:
        face: the subject's, with the eyes' points.
        images: sRGB, by camera.
        rig: the cameras.
        closed: the sides whose lids meet.
    """
    axes = face.world_from_face.rotation
    out: dict[str, Iris | UnseenEye] = {}
    for side, corners in CORNERS.items():
        eyeball = face.points_world[list(corners)].mean(axis=0) + axes @ FROM_CORNERS_MM
        seen = _candidates(face.detections, images, rig, side)
        out[side] = UnseenEye("closed") if side in closed else _found(seen, eyeball, axes)
    right, left = out["right"], out["left"]
    if isinstance(right, Iris) and isinstance(left, Iris):
        out["right"], out["left"] = looking_together(right, left, axes)
    return believed(out, axes[:, 2])


def believed(eyes: Mapping[str, Iris | UnseenEye], ahead: Float[np.ndarray, " 3"]) -> dict[str, Iris | UnseenEye]:
    """Returns the eyes without gazes that nobody has: two that differ by more than ``MAX_BETWEEN_DEG``, and one alone
    that is farther than ``MAX_ALONE_DEG`` from ``ahead``, where the face looks (a unit vector)."""
    gazes = [eye.gaze for eye in eyes.values() if isinstance(eye, Iris)]
    beside, limit_deg = (gazes[1], MAX_BETWEEN_DEG) if len(gazes) == len(eyes) else (ahead, MAX_ALONE_DEG)
    if not gazes or gazes[0] @ beside >= np.cos(np.radians(limit_deg)):
        return dict(eyes)
    return {side: UnseenEye("unclear") if isinstance(eye, Iris) else eye for side, eye in eyes.items()}


def looking_together(right: Iris, left: Iris, face_axes: Float[np.ndarray, "3 3"]) -> tuple[Iris, Iris]:
    """Returns both irises once they look at one point, as far as their deviations let them. ``face_axes`` has the
    face's axes as columns: to the subject's left, up, ahead."""
    across, up = face_axes[:, 0], face_axes[:, 1]
    covariance = np.zeros((14, 14))
    covariance[:7, :7], covariance[7:, 7:] = right.covariance, left.covariance
    slopes = np.zeros((2, 14))
    for row, axis in enumerate((across, up)):
        slopes[row, 3:6], slopes[row, 10:13] = np.cross(right.gaze, axis), -np.cross(left.gaze, axis)
    off = np.array([np.radians(VERGENCE_DEG[0]), 0.0]) - [(right.gaze - left.gaze) @ axis for axis in (across, up)]
    noise = np.diag(np.radians([VERGENCE_DEG[1], ELEVATIONS_DEG]) ** 2)
    spread = slopes @ covariance @ slopes.T + noise
    if off @ np.linalg.solve(spread, off) > MAX_CONTRADICTION:
        return right, left
    gain = covariance @ slopes.T @ np.linalg.inv(spread)
    step, covariance = gain @ off, covariance - gain @ slopes @ covariance
    return _moved(right, step[:7], covariance[:7, :7]), _moved(left, step[7:], covariance[7:, 7:])


def _moved(iris: Iris, step: Float[np.ndarray, " 7"], covariance: Float[np.ndarray, "7 7"]) -> Iris:
    gaze = rotation_from_vector(step[3:6]) @ iris.gaze
    radius_mm = iris.radius_mm + float(step[6])
    return replace(iris, centre=iris.centre + step[:3], gaze=gaze, radius_mm=radius_mm, covariance=covariance)


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """One view of an eye, and where the network puts the iris in it."""

    name: str
    view: EyeView
    network_px: Float[np.ndarray, " 2"]


@dataclass(frozen=True, slots=True, eq=False)
class _Circle:
    """A limbus. ``up`` is the face's, so that the result does not depend on the world's axes."""

    centre: Float[np.ndarray, " 3"]
    gaze: Float[np.ndarray, " 3"]
    radius: float
    up: Float[np.ndarray, " 3"]

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Returns two unit vectors across the gaze."""
        across = np.cross(self.up, self.gaze)
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.gaze, across)])

    def after(self, step: Float[np.ndarray, " 6"]) -> "_Circle":
        """Returns the circle after a step: of the centre, of the gaze about ``axes``, and of the radius."""
        turn = rotation_from_vector(step[3:5] @ self.axes())
        return _Circle(self.centre + step[:3], turn @ self.gaze, self.radius + float(step[5]), self.up)


def _candidates(
    detections: Mapping[str, FaceDetection], images: Mapping[str, ImageRgb], rig: Rig, side: str
) -> list[_Seen]:
    out = []
    for name, seen in detections.items():
        if seen.lids_px is None or seen.irises_px is None or name not in images:
            continue
        view = eye_view(rig[name], images[name], seen.lids_px[LIDS[side]])
        if view is not None:
            out.append(_Seen(name, view, seen.irises_px[IRISES[side]]))
    return out


def _found(seen: Sequence[_Seen], eyeball: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "3 3"]) -> Iris | UnseenEye:
    """Returns the iris that views agree on, or why there is none."""
    if len(seen) < MIN_VIEWS:
        return UnseenEye("few-views")
    ahead = axes[:, 2]
    centre = _nearest_to_rays(seen, eyeball + BEHIND_MM * ahead)
    start = _Circle(centre, _towards(centre - eyeball, ahead), RADIUS_MM, axes[:, 1])
    facing = [each for each in seen if _faces(start, each)]
    if len(facing) < MIN_VIEWS:
        return UnseenEye("few-views")
    large = [each for each in facing if _radius_px(start, each.view) >= MIN_RADIUS_PX]
    if len(large) < MIN_VIEWS:
        return UnseenEye("coarse")
    return _fitted(large, start, eyeball)


def _towards(gaze: Float[np.ndarray, " 3"], ahead: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """The direction from the eyeball to the iris, drawn towards straight ahead: the head says its eyeballs roughly."""
    mixed = gaze / BEHIND_MM + ahead
    return mixed / np.linalg.norm(mixed)


def _nearest_to_rays(seen: Sequence[_Seen], start: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Returns the place nearest to the rays through the network's irises, those far off it left aside; ``start`` to
    ``CENTRE_STD_MM``."""
    rays = np.concatenate([each.view.camera.rays_world(each.network_px[None]) for each in seen])
    centres = np.array([each.view.camera.centre_world for each in seen])
    off = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    point = start
    for _ in range(10):
        miss = np.linalg.norm(np.einsum("nij,nj->ni", off, point - centres), axis=1)
        weights = 1.0 / (1.0 + (miss / 1.0) ** 2)
        matrix = np.einsum("n,nij->ij", weights, off) + np.eye(3) / CENTRE_STD_MM**2
        point = np.linalg.solve(matrix, np.einsum("n,nij,nj->i", weights, off, centres) + start / CENTRE_STD_MM**2)
    return point


def _faces(circle: _Circle, seen: _Seen) -> bool:
    """Tells whether an eye looks towards a view."""
    towards = seen.view.camera.centre_world - circle.centre
    return bool(towards @ circle.gaze > MIN_FACING * np.linalg.norm(towards))


def _radius_px(circle: _Circle, view: EyeView) -> float:
    _, slopes = view.camera.project_with_jacobian(circle.centre[None])
    return RADIUS_MM * float(np.linalg.svd(slopes[0], compute_uv=False)[0])


def _fitted(seen: Sequence[_Seen], circle: _Circle, eyeball: Float[np.ndarray, " 3"]) -> Iris | UnseenEye:
    matrix, evidence = np.zeros((6, 6)), dict[str, Rows]()
    for reach in REACHES:
        evidence = {}
        for each in seen:
            if _faces(circle, each) and _agrees(circle, each):
                rows = _edges(circle, each.view, reach)
                if rows is not None:
                    evidence[each.name] = rows
        if len(evidence) < MIN_VIEWS or np.sum([rows[-1] for rows in evidence.values()], axis=0).min() < MIN_SIDE:
            return UnseenEye("unclear")
        step, matrix = _step(circle, evidence, eyeball)
        circle = circle.after(step)
    offsets = np.concatenate([offsets for offsets, *_ in evidence.values()])
    rms = float(1.4826 * np.median(np.abs(offsets)))
    scale = float(np.mean([_radius_px(circle, each.view) for each in seen if each.name in evidence]))
    if rms > MAX_RMS * scale or abs(circle.radius - RADIUS_MM) > MAX_RADIUS_OFF_MM:
        return UnseenEye("unclear")
    spread = np.zeros((7, 6))
    spread[:3, :3], spread[3:6, 3:5], spread[6, 5] = np.eye(3), circle.axes().T, 1.0
    covariance = spread @ np.linalg.inv(matrix) @ spread.T
    found = Iris(circle.centre, circle.gaze, circle.radius, covariance, tuple(evidence), rms)
    return found if found.gaze_std_deg < MAX_GAZE_STD_DEG else UnseenEye("unclear")


def _agrees(circle: _Circle, seen: _Seen) -> bool:
    """Tells whether the network sees the iris where the circle is."""
    pixel, slopes = seen.view.camera.project_with_jacobian(circle.centre[None])
    limit = MAX_NETWORK_OFF * RADIUS_MM * float(np.linalg.svd(slopes[0], compute_uv=False)[0])
    return bool(np.linalg.norm(pixel[0] - seen.network_px) < limit)


Rows = tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n 6"], float, Int[np.ndarray, " 2"]]


def _edges(circle: _Circle, view: EyeView, reach: float) -> Rows | None:
    """Returns how far beyond the circle a view has its edges (px), the derivatives of the circle's image along these
    rays by a step, their deviation, and how many lie towards the subject's left and right. Returns None where there are
    too few."""
    angles = np.arange(RAYS) * 2.0 * np.pi / RAYS
    axes = circle.axes()
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes
    points, slopes = view.camera.project_with_jacobian(circle.centre + circle.radius * spokes)
    tangents = np.einsum("nij,nj->ni", slopes, np.cross(circle.gaze, spokes))
    outwards = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    radial = np.einsum("nij,nj->ni", slopes, spokes)
    outwards *= np.sign((outwards * radial).sum(axis=1))[:, None]
    offsets = limbus_offsets(view, points, outwards, reach * _radius_px(circle, view))
    towards = view.camera.centre_world - circle.centre
    bulge = CORNEA[0] * circle.gaze + CORNEA[1] * spokes
    there = np.isfinite(offsets) & (bulge @ towards > MIN_SEEN * np.linalg.norm(towards))
    if np.count_nonzero(there) < MIN_RAYS:
        return None
    sides = np.array([np.count_nonzero(there & (sign * np.cos(angles) > ASIDE)) for sign in (1.0, -1.0)])
    by_point = np.einsum("ni,nij->nj", outwards, slopes)[there]
    turns = [np.cross(axis, circle.radius * spokes[there]) for axis in axes]
    columns = [by_point, *(np.einsum("ni,ni->n", by_point, turn)[:, None] for turn in turns)]
    columns.append(np.einsum("ni,ni->n", by_point, spokes[there])[:, None])
    found = offsets[there]
    noise = max(1.4826 * float(np.median(np.abs(found))), MIN_NOISE_PX)
    return found, np.concatenate(columns, axis=1), noise, sides


def _step(
    circle: _Circle, evidence: Mapping[str, Rows], eyeball: Float[np.ndarray, " 3"]
) -> tuple[Float[np.ndarray, " 6"], Float[np.ndarray, "6 6"]]:
    """Returns the step of the circle that the edges and the priors ask for, and the inverse of its covariance."""
    matrix, right = np.zeros((6, 6)), np.zeros(6)
    for offsets, slopes, noise, _ in evidence.values():
        weights = 1.0 / (1.0 + (offsets / max(ROBUST_PX, 2.0 * noise)) ** 2) ** 2 / (SHARED * noise**2)
        matrix += slopes.T @ (weights[:, None] * slopes)
        right += slopes.T @ (weights * offsets)
    behind = np.zeros((3, 6))
    behind[:, :3] = np.eye(3)
    behind[:, 3:5] = -BEHIND_MM * np.stack([np.cross(axis, circle.gaze) for axis in circle.axes()], axis=1)
    off = eyeball - (circle.centre - BEHIND_MM * circle.gaze)
    matrix += behind.T @ behind / CENTRE_STD_MM**2
    right += behind.T @ off / CENTRE_STD_MM**2
    matrix[5, 5] += 1.0 / RADIUS_STD_MM**2
    right[5] += (RADIUS_MM - circle.radius) / RADIUS_STD_MM**2
    return np.linalg.solve(matrix, right), matrix
