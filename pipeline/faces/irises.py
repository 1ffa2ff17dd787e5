"""Finds irises and where the eyes look: a circle in space, the limbus, whose edges all views share.

Enters: the subject's face in the views with the points of the eyes' network, the photographs and the cameras. Leaves,
by eye: centre and radius of the iris, the direction of the gaze, each with its deviation; or why the eye is not seen.
The gaze is the limbus' normal, the eye's optical axis; the line of sight lies about 5 degrees nearer to the nose.

Each eye is fitted alone (``limbus_fit``) and, where both do not look alike, again from where the other eye looks, and
from where both look; what most edges speak for is kept. Priors: the radius is 5.85 mm (deviation 0.25; a visible iris
of 11.7 mm, Ruefer et al. 2005). The eyeball lies 10.5 mm behind the iris and 5 mm behind the corners of the eye, to 4
mm in each direction. Both eyes look at one point: elevations are the same to 1 degree, and the lines meet as for a
point half a metre away or farther; where the two eyes contradict that clearly (a squint), each is left as it was found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float

from pipeline.faces.eyes import LIDS
from pipeline.faces.limbus import eye_view
from pipeline.faces.limbus_fit import (
    BEHIND_MM,
    CENTRE_STD_MM,
    MIN_VIEWS,
    RADIUS_MM,
    EyeSight,
    LimbusCircle,
    LimbusFit,
    fitted,
)
from pipeline.faces.matching import MatchedFaces
from pipeline.faces.points import LEFT_EYE_CORNERS, RIGHT_EYE_CORNERS
from rig.geometry import cross_matrix, nearest_to_rays, rotation_from_vector
from rig.image import ImageRgb
from rig.rig import Rig

FROM_CORNERS_MM = np.array([0.0, 1.0, -5.0])  # from the middle between an eye's corners to its eyeball, face frame
CORNERS = {"right": RIGHT_EYE_CORNERS, "left": LEFT_EYE_CORNERS}
VERGENCE_DEG = (3.0, 2.5)  # between both eyes: mean (a point 1.2 m away) and deviation
ELEVATIONS_DEG = 1.0
MAX_CONTRADICTION = 9.0  # squared deviations, of two
REACHES = (0.35, 0.35, 0.25, 0.25, 0.18, 0.18, 0.15, 0.15)  # of the search about the circle, by its radius
REACHES_AGAIN = (0.25, 0.18, 0.15, 0.15, 0.15)
LIFTS_MM = (0.0, 1.2, -1.2)  # of the network's irises, tried one after the other: on rendered heads they lie 1 mm low
ALIKE_DEG = 5.0  # between gazes that confirm each other
MORE_AGREED = 1.02  # edges that must speak for another gaze, by those for the first
MIN_RADIUS_PX = 5.0  # of an iris in a view that counts
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

    def widen_by_scale(self, sigma: float, origin: Float[np.ndarray, " 3"]) -> "Iris":
        """Returns the iris of a head whose size about ``origin`` (mm) is known to the share ``sigma``."""
        moved = sigma * np.concatenate([self.centre - origin, np.zeros(3), [self.radius_mm]])
        return replace(self, covariance=self.covariance + np.outer(moved, moved))

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
    eyes = {side: _eye(face, images, rig, side) for side in CORNERS if side not in closed}
    fits = _together({side: _first_fit(eye, axes[:, 2]) for side, eye in eyes.items()}, eyes)
    out: dict[str, Iris | UnseenEye] = {side: UnseenEye("closed") for side in CORNERS}
    for side, fit in fits.items():
        out[side] = fit if isinstance(fit, UnseenEye) else _iris(fit, eyes[side].seen)
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
class _Eye:
    """Holds the views of an eye, where its eyeball may lie, and the face's upward direction."""

    seen: Sequence[EyeSight]
    eyeball: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]


def _eye(face: MatchedFaces, images: Mapping[str, ImageRgb], rig: Rig, side: str) -> _Eye:
    axes = face.world_from_face.rotation
    eyeball = face.points_world[list(CORNERS[side])].mean(axis=0) + axes @ FROM_CORNERS_MM
    views = []
    for name, seen in face.detections.items():
        if seen.lids_px is None or seen.irises_px is None or name not in images:
            continue
        view = eye_view(rig[name], images[name], seen.lids_px[LIDS[side]])
        if view is not None:
            views.append(EyeSight(name, view, seen.irises_px[IRISES[side]]))
    return _Eye(views, eyeball, axes[:, 1])


def _first_fit(eye: _Eye, ahead: Float[np.ndarray, " 3"]) -> LimbusFit | UnseenEye:
    """Returns the limbus that an eye's views agree on, or why there is none."""
    if len(eye.seen) < MIN_VIEWS:
        return UnseenEye("few-views")
    centre = _nearest_to_rays(eye.seen, eye.eyeball + BEHIND_MM * ahead)
    start = LimbusCircle(centre, _towards(centre - eye.eyeball, ahead), eye.up)
    facing = [sight for sight in eye.seen if start.faces(sight)]
    if len(facing) < MIN_VIEWS:
        return UnseenEye("few-views")
    if len(_large(start, facing)) < MIN_VIEWS:
        return UnseenEye("coarse")
    starts = [replace(start, centre=centre + lift * eye.up) for lift in LIFTS_MM]
    fits = [fit for each in starts if (fit := fitted(_large(each, eye.seen), each, eye.eyeball, REACHES)) is not None]
    return max(fits, key=lambda fit: fit.agreement, default=UnseenEye("unclear"))


def _large(circle: LimbusCircle, seen: Sequence[EyeSight]) -> list[EyeSight]:
    return [sight for sight in seen if circle.radius_px(sight.view) >= MIN_RADIUS_PX]


def _together(fits: Mapping[str, LimbusFit | UnseenEye], eyes: Mapping[str, _Eye]) -> dict[str, LimbusFit | UnseenEye]:
    """Returns the fits once each was tried from where the other eye looks, and from where both look, if they differ."""
    out = dict(fits)
    for side, fit in fits.items():
        beside = next(
            (other.circle.gaze for name, other in fits.items() if name != side and isinstance(other, LimbusFit)), None
        )
        if isinstance(fit, UnseenEye) or beside is None or fit.circle.gaze @ beside > np.cos(np.radians(ALIKE_DEG)):
            continue
        best = fit
        for gaze, lift in product((beside, fit.circle.gaze + beside), LIFTS_MM):
            centre = fit.circle.centre + lift * eyes[side].up
            start = LimbusCircle(centre, gaze / np.linalg.norm(gaze), eyes[side].up)
            again = fitted(_large(start, eyes[side].seen), start, eyes[side].eyeball, REACHES_AGAIN)
            if again is not None and again.agreement > MORE_AGREED * best.agreement:
                best = again
        out[side] = best
    return out


def _iris(fit: LimbusFit, seen: Sequence[EyeSight]) -> Iris | UnseenEye:
    """Returns a fit's iris, or that it is no iris."""
    circle = fit.circle
    rms = float(1.4826 * np.median(np.abs(fit.offsets)))
    scale = float(np.mean([circle.radius_px(sight.view) for sight in seen if sight.name in fit.edges]))
    if rms > MAX_RMS * scale or abs(circle.radius - RADIUS_MM) > MAX_RADIUS_OFF_MM:
        return UnseenEye("unclear")
    spread = np.zeros((7, 7))
    spread[:3, :3], spread[3:6, 3:5], spread[6, 5] = np.eye(3), circle.axes().T, 1.0
    covariance = spread @ np.linalg.inv(fit.information) @ spread.T
    found = Iris(circle.centre, circle.gaze, circle.radius, covariance, tuple(fit.edges), rms)
    return found if found.gaze_std_deg < MAX_GAZE_STD_DEG else UnseenEye("unclear")


def _towards(gaze: Float[np.ndarray, " 3"], ahead: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Returns the direction from eyeball to iris, drawn towards straight ahead, since eyeballs are known roughly."""
    mixed = gaze / BEHIND_MM + ahead
    return mixed / np.linalg.norm(mixed)


def _nearest_to_rays(seen: Sequence[EyeSight], start: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Returns the place nearest to the rays through the network's irises, those far off it left aside; ``start`` to
    ``CENTRE_STD_MM``."""
    rays = np.concatenate([each.view.camera.rays_world(each.network_px[None]) for each in seen])
    centres = np.array([each.view.camera.centre_world for each in seen])
    point = start
    for _ in range(10):
        miss = np.linalg.norm(np.cross(rays, point - centres), axis=1)
        # About ``start`` the ridge is the prior.
        point = start + nearest_to_rays(centres - start, rays, 1.0 / (1.0 + miss**2), ridge=CENTRE_STD_MM**-2)
    return point
