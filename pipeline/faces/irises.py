"""Finds irises and gaze directions: fits a circle in space, the border of the iris (limbus), to image edges.

The module takes the subject's face with the eye network's points, the photographs and the cameras. For each eye the
module returns centre and radius of the iris and the gaze, with standard deviations, or why the eye was not measured.
The gaze is the normal of the limbus, which is the eye's optical axis; the line of sight lies 5 degrees nearer to the
nose.

Each eye is fitted alone. If the two gazes differ, each eye is fitted again from the other eye's gaze and from the mean
gaze, and the fit with most supporting edges is retained. The prior of the radius is 5.85 mm (standard deviation 0.25;
Ruefer et al. 2005). The eyeball lies 10.5 mm behind the iris and 5 mm behind the corners of the eye, with 4 mm standard
deviation in each direction. The two eyes are assumed to look at the same point: their elevations are equal to 1 degree,
and the lines of sight meet half a metre away or farther. If the eyes clearly contradict this assumption (a squint),
each eye keeps its own result.

The fit iterates: it searches limbus edges and pupils near the circle, fits the circle to them, and narrows the search.
The pupil lies on the circle's axis. The pupil's distance in front of the limbus is fitted too, since the cornea's
refraction shifts the pupil's image. The pupil is the darkest disc in the iris, of the same size in all views. Pixels
with the reflection of a lamp are left out. The square root of the brightness is used, because its noise is the same in
bright and dark pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.faces.eyes import LIDS
from pipeline.faces.limbus import EyeView, eye_view, limbus_offsets
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
STEP_MM, HALF_MM, IRIS_MM = 0.2, 5.0, 4.5  # of the patch about the pupil, and the iris' inner part
REACH_MM = 2.4  # how far off the pupil may lie
RADII_MM = np.arange(1.0, 3.7, 0.3)
RING_MM, BETWEEN_MM = 0.9, 0.1  # a pupil is darker than the ring about it; neither has its edge
GLARE = 1.3  # by the iris' median: brighter than any of its fibres
MIN_DISC, MIN_RING = 0.5, 0.4  # shares that no highlight covers
MIN_CONTRAST = 0.2  # between ring and disc, by the iris' median; shade under lids has less
ALONG_MM = np.arange(-HALF_MM, HALF_MM + 1e-9, STEP_MM)
LACKING = -1.0  # contrast where there is none to be measured
Contrasts = Float32[np.ndarray, "r n n"]

RADIUS_MM, RADIUS_STD_MM = 5.85, 0.25
EYEBALL_MM = 12.0
BEHIND_MM = float(np.sqrt(EYEBALL_MM**2 - RADIUS_MM**2))  # from the iris' centre to the eyeball's
CENTRE_STD_MM = 4.0
AHEAD_MM, AHEAD_STD_MM = 1.0, 2.0  # of a pupil: 3 mm behind the cornea's apex, -0.4; painted on a cornea, 2.4
RAYS = 96
NEAR = 0.25  # reach of a search, by the circle's radius, that is near enough to look for pupils
MIN_FACING = 0.5  # cosine between gaze and view
CORNEA = np.array([0.656, 0.755])  # its normal at the limbus (7.8 mm of radius): along the gaze, and outwards
MIN_SEEN = 0.25  # cosine between that and the view: the cornea hides, or bends, the limbus behind it
MIN_VIEWS = 2
MIN_RAYS = 6  # with an edge, of a view that counts
ENDS = (0.2, 0.5)  # weights of an arc's last two rays: lids shade the white there and draw the edge inwards
ROBUST_PX, MIN_NOISE_PX = 0.4, 0.15
PUPIL_PX = 0.8  # deviation of a pupil in a view: highlights eat into it
SHARED = 9.0  # edges of a view err together (they are averaged, lids' shade, highlights): so many count as one
AGREED_PX = 0.35  # scale of an edge that speaks for a circle
MAX_NETWORK_OFF = 0.6  # between a view's network and the circle's centre, by the iris' radius


@dataclass(frozen=True, slots=True, eq=False)
class EyeSight:
    """Holds one view of an eye, and the network's position of the iris in it."""

    name: str
    view: EyeView
    network_px: Float[np.ndarray, " 2"]


@dataclass(frozen=True, slots=True, eq=False)
class LimbusCircle:
    """Holds a limbus (world frame, mm), and the pupil's distance in front of it. ``up`` is the face's upward
    direction."""

    centre: Float[np.ndarray, " 3"]
    gaze: Float[np.ndarray, " 3"]
    up: Float[np.ndarray, " 3"]
    radius: float = RADIUS_MM
    ahead: float = AHEAD_MM

    def axes(self) -> Float[np.ndarray, "2 3"]:
        """Returns two unit vectors at right angles to the gaze."""
        across = np.cross(self.up, self.gaze)
        across /= np.linalg.norm(across)
        return np.stack([across, np.cross(self.gaze, across)])

    def after(self, step: Float[np.ndarray, " 7"]) -> "LimbusCircle":
        """Returns the circle after a solver step, which changes the centre, the gaze about ``axes``, the radius, and
        the pupil's distance."""
        turn = rotation_from_vector(step[3:5] @ self.axes())
        radius, ahead = self.radius + float(step[5]), self.ahead + float(step[6])
        return LimbusCircle(self.centre + step[:3], turn @ self.gaze, self.up, radius, ahead)

    def on_axis(self, ahead: float) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 7"]]:
        """Returns the point on the circle's axis ``ahead`` mm in front of the centre, and its derivative by a step."""
        slopes = np.zeros((3, 7))
        slopes[:, :3] = np.eye(3)
        slopes[:, 3:5] = ahead * np.stack([np.cross(axis, self.gaze) for axis in self.axes()], axis=1)
        return self.centre + ahead * self.gaze, slopes

    def radius_px(self, view: EyeView) -> float:
        """Returns the radius (px) of the limbus in a view's picture."""
        _, slopes = view.camera.project_with_jacobian(self.centre[None])
        return RADIUS_MM * float(np.linalg.svd(slopes[0], compute_uv=False)[0])

    def faces(self, seen: EyeSight) -> bool:
        """Returns True if the eye is turned towards a view's camera."""
        towards = seen.view.camera.centre_world - self.centre
        return bool(towards @ self.gaze > MIN_FACING * np.linalg.norm(towards))

    def agrees(self, seen: EyeSight) -> bool:
        """Returns True if the iris that the network found in a view agrees with the circle."""
        pixel = seen.view.camera.project(self.centre[None])[0]
        return bool(np.linalg.norm(pixel - seen.network_px) < MAX_NETWORK_OFF * self.radius_px(seen.view))


@dataclass(frozen=True, slots=True, eq=False)
class LimbusEdges:
    """Holds the image edges near a circle in one view, one on each ray: distances beyond the projected circle (px),
    derivatives of the projected circle by a step, weights, and standard deviation (px)."""

    offsets: Float[np.ndarray, " n"]
    slopes: Float[np.ndarray, "n 7"]
    weights: Float[np.ndarray, " n"]
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class LimbusFit:
    """Holds a fitted circle, the information matrix of a solver step, and the image edges used, by view."""

    circle: LimbusCircle
    information: Float[np.ndarray, "7 7"]
    edges: Mapping[str, LimbusEdges]

    @property
    def offsets(self) -> Float[np.ndarray, " n"]:
        """Returns the distances (px) of all image edges beyond the projected circle."""
        return np.concatenate([edges.offsets for edges in self.edges.values()])

    @property
    def agreement(self) -> float:
        """Returns the number of image edges that support the circle."""
        return float((1.0 / (1.0 + (self.offsets / AGREED_PX) ** 2) ** 2).sum())


def fit_limbus(
    seen: Sequence[EyeSight], circle: LimbusCircle, eyeball: Float[np.ndarray, " 3"], reaches: Sequence[float]
) -> LimbusFit | None:
    """Fits a limbus to the edges in all views. Returns None if too few views agree.

    Args:
        seen: the views.
        circle: the one to begin with.
        eyeball: expected centre of the eyeball, with standard deviation ``CENTRE_STD_MM``.
        reaches: widths of the successive edge searches, relative to the radius.
    """
    out, pupils = None, None
    for reach in reaches:
        about = [sight for sight in seen if circle.faces(sight) and circle.agrees(sight)]
        edges = {sight.name: found for sight in about if (found := _edges(circle, sight.view, reach)) is not None}
        if len(edges) < MIN_VIEWS:
            return None
        if pupils is None and reach <= NEAR:
            pupils = _pupils(circle, about)
        matrix, right = _normal_equations(circle, edges, pupils or [], eyeball)
        circle = circle.after(np.linalg.solve(matrix, right))
        out = LimbusFit(circle, matrix, edges)
    return out


def _edges(circle: LimbusCircle, view: EyeView, reach: float) -> LimbusEdges | None:
    """Finds the edges of a limbus in a view. Returns None if there are too few edges."""
    angles = np.arange(RAYS) * 2.0 * np.pi / RAYS
    axes = circle.axes()
    spokes = np.stack([np.cos(angles), np.sin(angles)], axis=1) @ axes
    points, slopes = view.camera.project_with_jacobian(circle.centre + circle.radius * spokes)
    tangents = np.einsum("nij,nj->ni", slopes, np.cross(circle.gaze, spokes))
    outwards = np.stack([tangents[:, 1], -tangents[:, 0]], axis=1)
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    radial = np.einsum("nij,nj->ni", slopes, spokes)
    outwards *= np.sign((outwards * radial).sum(axis=1))[:, None]
    offsets = limbus_offsets(view, points, outwards, reach * circle.radius_px(view))
    towards = view.camera.centre_world - circle.centre
    bulge = CORNEA[0] * circle.gaze + CORNEA[1] * spokes
    there = np.isfinite(offsets) & (bulge @ towards > MIN_SEEN * np.linalg.norm(towards))
    if np.count_nonzero(there) < MIN_RAYS:
        return None
    by_point = np.einsum("ni,nij->nj", outwards, slopes)[there]
    turns = [np.cross(axis, circle.radius * spokes[there]) for axis in axes]
    columns = [by_point, *(np.einsum("ni,ni->n", by_point, turn)[:, None] for turn in turns)]
    columns += [np.einsum("ni,ni->n", by_point, spokes[there])[:, None], np.zeros((len(by_point), 1))]
    found = offsets[there]
    noise = max(1.4826 * float(np.median(np.abs(found))), MIN_NOISE_PX)
    return LimbusEdges(found, np.concatenate(columns, axis=1), _end_weights(there)[there], noise)


def _end_weights(there: Bool[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Returns weights for rays around the circle, reduced at the two rays at each end of a visible arc."""
    inner = there & np.roll(there, 1) & np.roll(there, -1)
    innermost = inner & np.roll(inner, 1) & np.roll(inner, -1)
    return np.where(innermost, 1.0, np.where(inner, ENDS[1], ENDS[0]))


def _pupils(circle: LimbusCircle, seen: Sequence[EyeSight]) -> list[tuple[EyeView, Float[np.ndarray, " 2"]]]:
    """Returns the views that show the pupil, each with the pupil's position."""
    centre, _ = circle.on_axis(AHEAD_MM)
    found = pupils_px([sight.view for sight in seen], centre, circle.axes())
    return [(sight.view, pixel) for sight, pixel in zip(seen, found, strict=True) if pixel is not None]


def _normal_equations(
    circle: LimbusCircle,
    edges: Mapping[str, LimbusEdges],
    pupils: Sequence[tuple[EyeView, Float[np.ndarray, " 2"]]],
    eyeball: Float[np.ndarray, " 3"],
) -> tuple[Float[np.ndarray, "7 7"], Float[np.ndarray, " 7"]]:
    """Returns the matrix and the right side of the normal equations of limbus edges, pupils and priors."""
    matrix, right = np.zeros((7, 7)), np.zeros(7)
    for view in edges.values():
        scale = max(ROBUST_PX, 2.0 * view.noise)
        weights = view.weights / (1.0 + (view.offsets / scale) ** 2) ** 2 / (SHARED * view.noise**2)
        matrix += view.slopes.T @ (weights[:, None] * view.slopes)
        right += view.slopes.T @ (weights * view.offsets)
    pupil, moves = circle.on_axis(circle.ahead)
    moves[:, 6] = circle.gaze
    for view, pixel in pupils:
        at, by_point = view.camera.project_with_jacobian(pupil[None])
        off, slopes = pixel - at[0], by_point[0] @ moves
        weight = 1.0 / (1.0 + off @ off / (2.0 * PUPIL_PX) ** 2) ** 2 / PUPIL_PX**2
        matrix += weight * slopes.T @ slopes
        right += weight * slopes.T @ off
    behind, moves = circle.on_axis(-BEHIND_MM)
    matrix += moves.T @ moves / CENTRE_STD_MM**2
    right += moves.T @ (eyeball - behind) / CENTRE_STD_MM**2
    priors = ((5, RADIUS_MM - circle.radius, RADIUS_STD_MM), (6, AHEAD_MM - circle.ahead, AHEAD_STD_MM))
    for row, off, std in priors:
        matrix[row, row] += 1.0 / std**2
        right[row] += off / std**2
    return matrix, right


def pupils_px(
    views: Sequence[EyeView], centre: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "2 3"]
) -> list[Float[np.ndarray, " 2"] | None]:
    """Returns the pupil's centre in each view (px of the picture); None where it is not clear.

    Args:
        views: of one eye.
        centre: centre of the search region (world frame, mm), whose half width is ``REACH_MM``.
        axes: two unit vectors in the pupil's plane.
    """
    contrasts = [_contrasts(view, centre, axes) for view in views]
    if not contrasts:
        return []
    size = int(np.sum([of.max(axis=(1, 2)) for of in contrasts], axis=0).argmax())
    out: list[Float[np.ndarray, " 2"] | None] = []
    for view, of in zip(views, contrasts, strict=True):
        place = _peak(of[size])
        out.append(None if place is None else view.camera.project((centre + place @ axes)[None])[0])
    return out


def _contrasts(view: EyeView, centre: Float[np.ndarray, " 3"], axes: Float[np.ndarray, "2 3"]) -> Contrasts:
    """Returns, for each disc radius and position, how much darker the disc is than the ring around it, relative to the
    brightness of the iris."""
    across, up = np.meshgrid(ALONG_MM, ALONG_MM)
    places = centre + across.reshape(-1, 1) * axes[0] + up.reshape(-1, 1) * axes[1]
    x, y = (view.camera.project(places) - view.origin_px).T.astype(np.float32).reshape(2, *across.shape)
    patch = cv2.remap(view.brightness, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    level = np.sqrt(np.maximum(patch, 0.0))
    off = np.hypot(across, up)
    iris = max(float(np.median(level[off < IRIS_MM])), 1e-3)
    glare = cv2.dilate((level > GLARE * iris).astype(np.uint8), np.ones((5, 5), np.uint8))
    plain = 1.0 - glare.astype(np.float32)
    out = np.full((len(RADII_MM), *off.shape), LACKING, np.float32)
    for number, (disc, ring) in enumerate(_kernels()):
        (dark, inside), (bright, around) = (
            [cv2.filter2D(of, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT) for of in (plain * level, plain)]
            for kernel in (disc, ring)
        )
        clear = (inside > MIN_DISC * disc.sum()) & (around > MIN_RING * ring.sum()) & (off <= REACH_MM)
        contrast = bright / np.maximum(around, 1.0) - dark / np.maximum(inside, 1.0)
        out[number][clear] = contrast[clear] / iris
    return out


@lru_cache(maxsize=1)
def _kernels() -> list[tuple[Float32[np.ndarray, "k k"], Float32[np.ndarray, "k k"]]]:
    """Returns the filter masks of a disc of each radius and of the ring around the disc."""
    out = []
    for radius in RADII_MM:
        count = int((radius + RING_MM) / STEP_MM) + 1
        off = np.hypot(*np.meshgrid(*[np.arange(-count, count + 1) * STEP_MM] * 2))
        ring = (off > radius + BETWEEN_MM) & (off <= radius + RING_MM)
        out.append(((off <= radius - BETWEEN_MM).astype(np.float32), ring.astype(np.float32)))
    return out


def _peak(contrast: Float32[np.ndarray, "n n"]) -> Float[np.ndarray, " 2"] | None:
    """Returns the position (mm along the two axes) of the highest contrast, interpolated between cells; None if the
    contrast is low or highest at the border."""
    row, column = np.unravel_index(contrast.argmax(), contrast.shape)
    about = contrast[row - 1 : row + 2, column - 1 : column + 2]
    if contrast[row, column] < MIN_CONTRAST or about.shape != (3, 3):
        return None
    lines = np.stack([about[1], about[:, 1]]).astype(float)
    bend = lines[:, 0] - 2.0 * lines[:, 1] + lines[:, 2]
    if (lines == LACKING).any() or (bend >= 0.0).any():
        return None
    shift = 0.5 * (lines[:, 0] - lines[:, 2]) / bend
    return ALONG_MM[[column, row]] + STEP_MM * shift


@dataclass(frozen=True, slots=True, eq=False)
class Iris:
    """Holds an iris (world frame, mm). ``gaze`` is the unit vector of the eye's optical axis. ``covariance`` is over
    the centre (mm), a rotation of the gaze (rad, world axes), and the radius (mm)."""

    centre: Float[np.ndarray, " 3"]
    gaze: Float[np.ndarray, " 3"]
    radius_mm: float
    covariance: Float[np.ndarray, "7 7"]
    views: tuple[str, ...]

    @property
    def centre_std_mm(self) -> Float[np.ndarray, " 3"]:
        """Returns the standard deviation of each coordinate of the centre."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def gaze_std_deg(self) -> float:
        """Returns the standard deviation of the gaze (degrees), the mean of two directions perpendicular to it."""
        return float(np.degrees(np.sqrt(np.trace(self.covariance[3:6, 3:6]) / 2.0)))

    @property
    def eyeball(self) -> Float[np.ndarray, " 3"]:
        """Returns the centre of the eyeball, about which the eye rotates."""
        return self.centre - BEHIND_MM * self.gaze

    def widen_by_scale(self, sigma: float, origin: Float[np.ndarray, " 3"]) -> "Iris":
        """Adds to the covariance the relative standard deviation ``sigma`` of the scale about ``origin`` (mm)."""
        moved = sigma * np.concatenate([self.centre - origin, np.zeros(3), [self.radius_mm]])
        return replace(self, covariance=self.covariance + np.outer(moved, moved))

    @property
    def eyeball_jacobian(self) -> Float[np.ndarray, "3 7"]:
        """Returns the derivative of the eyeball's centre by the seven parameters of ``covariance``."""
        return np.concatenate([np.eye(3), BEHIND_MM * cross_matrix(self.gaze), np.zeros((3, 1))], axis=1)


@dataclass(frozen=True, slots=True)
class UnseenEye:
    """Holds the reason why an eye was not measured: its lids are closed, too few views show it large enough, or its
    limbus is not clear."""

    cause: Cause


def find_irises(
    face: MatchedFaces, images: Mapping[str, ImageRgb], rig: Rig, closed: frozenset[str]
) -> dict[str, Iris | UnseenEye]:
    """Finds the irises of the right and the left eye.

    Args:
        face: the subject's face, with the points of the eyes.
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
    return reject_gazes(out, axes[:, 2])


def reject_gazes(eyes: Mapping[str, Iris | UnseenEye], ahead: Float[np.ndarray, " 3"]) -> dict[str, Iris | UnseenEye]:
    """Rejects impossible gazes: two gazes that differ by more than ``MAX_BETWEEN_DEG``, or a single gaze more than
    ``MAX_ALONE_DEG`` from the direction of the face, ``ahead`` (a unit vector)."""
    gazes = [eye.gaze for eye in eyes.values() if isinstance(eye, Iris)]
    beside, limit_deg = (gazes[1], MAX_BETWEEN_DEG) if len(gazes) == len(eyes) else (ahead, MAX_ALONE_DEG)
    if not gazes or gazes[0] @ beside >= np.cos(np.radians(limit_deg)):
        return dict(eyes)
    return {side: UnseenEye("unclear") if isinstance(eye, Iris) else eye for side, eye in eyes.items()}


def looking_together(right: Iris, left: Iris, face_axes: Float[np.ndarray, "3 3"]) -> tuple[Iris, Iris]:
    """Combines the measured irises with the prior that both eyes look at the same point. ``face_axes`` has the face's
    axes as columns: to the subject's left, up, ahead."""
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
    """Holds the views of one eye, the prior position of the eyeball, and the face's upward direction."""

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
    """Returns the limbus fitted to the views of one eye, or the reason why there is none."""
    if len(eye.seen) < MIN_VIEWS:
        return UnseenEye("few-views")
    centre = _nearest_to_rays(eye.seen, eye.eyeball + BEHIND_MM * ahead)
    gaze = (centre - eye.eyeball) / BEHIND_MM + ahead  # moved towards ahead, as eyeballs are known only roughly
    start = LimbusCircle(centre, gaze / np.linalg.norm(gaze), eye.up)
    facing = [sight for sight in eye.seen if start.faces(sight)]
    if len(facing) < MIN_VIEWS:
        return UnseenEye("few-views")
    if len(_large(start, facing)) < MIN_VIEWS:
        return UnseenEye("coarse")
    starts = [replace(start, centre=centre + lift * eye.up) for lift in LIFTS_MM]
    fits = [fit for one in starts if (fit := fit_limbus(_large(one, eye.seen), one, eye.eyeball, REACHES)) is not None]
    return max(fits, key=lambda fit: fit.agreement, default=UnseenEye("unclear"))


def _large(circle: LimbusCircle, seen: Sequence[EyeSight]) -> list[EyeSight]:
    return [sight for sight in seen if circle.radius_px(sight.view) >= MIN_RADIUS_PX]


def _together(fits: Mapping[str, LimbusFit | UnseenEye], eyes: Mapping[str, _Eye]) -> dict[str, LimbusFit | UnseenEye]:
    """Repeats the fits from the other eye's gaze and from the mean gaze if the two gazes differ, and keeps the best."""
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
            again = fit_limbus(_large(start, eyes[side].seen), start, eyes[side].eyeball, REACHES_AGAIN)
            if again is not None and again.agreement > MORE_AGREED * best.agreement:
                best = again
        out[side] = best
    return out


def _iris(fit: LimbusFit, seen: Sequence[EyeSight]) -> Iris | UnseenEye:
    """Returns the iris of a limbus fit, or the reason why the fit is rejected."""
    circle = fit.circle
    rms = float(1.4826 * np.median(np.abs(fit.offsets)))
    scale = float(np.mean([circle.radius_px(sight.view) for sight in seen if sight.name in fit.edges]))
    if rms > MAX_RMS * scale or abs(circle.radius - RADIUS_MM) > MAX_RADIUS_OFF_MM:
        return UnseenEye("unclear")
    spread = np.zeros((7, 7))
    spread[:3, :3], spread[3:6, 3:5], spread[6, 5] = np.eye(3), circle.axes().T, 1.0
    covariance = spread @ np.linalg.inv(fit.information) @ spread.T
    found = Iris(circle.centre, circle.gaze, circle.radius, covariance, tuple(fit.edges))
    return found if found.gaze_std_deg < MAX_GAZE_STD_DEG else UnseenEye("unclear")


def _nearest_to_rays(seen: Sequence[EyeSight], start: Float[np.ndarray, " 3"]) -> Float[np.ndarray, " 3"]:
    """Returns the point nearest to the viewing rays through the network's irises, without outliers. The prior is the
    point ``start`` with ``CENTRE_STD_MM``."""
    rays = np.concatenate([each.view.camera.rays_world(each.network_px[None]) for each in seen])
    centres = np.array([each.view.camera.centre_world for each in seen])
    point = start
    for _ in range(10):
        miss = np.linalg.norm(np.cross(rays, point - centres), axis=1)
        # About ``start`` the ridge is the prior.
        point = start + nearest_to_rays(centres - start, rays, 1.0 / (1.0 + miss**2), ridge=CENTRE_STD_MM**-2)
    return point
